"""Arrays on the wire: little-endian `bin` fields, and the checks of what they hold."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = bytes
"""float64, little-endian."""
Ids = bytes
"""uint32, little-endian."""
Stamps = bytes
"""int64 nanoseconds, little-endian."""

LARGEST_JOINT = 4096
"""Rows of the largest covariance that is accepted."""


def _array(data: bytes, dtype: str, what: str) -> NDArray[Any]:
    size = np.dtype(dtype).itemsize
    if len(data) % size:
        raise ValueError(f"wrong length: {what} has {len(data)} bytes, not a multiple of {size}")
    return np.frombuffer(data, dtype=dtype)


def floats(data: Floats, what: str) -> NDArray[np.float64]:
    """A read-only float64 view."""
    return _array(data, "<f8", what)


def ids(data: Ids, what: str) -> NDArray[np.uint32]:
    """A read-only uint32 view."""
    return _array(data, "<u4", what)


def stamps(data: Stamps, what: str) -> NDArray[np.int64]:
    """A read-only int64 view."""
    return _array(data, "<i8", what)


def from_floats(values: Any) -> Floats:
    """Little-endian float64 bytes, C order."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def from_ids(values: Any) -> Ids:
    """Little-endian uint32 bytes."""
    return np.ascontiguousarray(values, dtype="<u4").tobytes()


def from_stamps(values: Any) -> Stamps:
    """Little-endian int64 bytes."""
    return np.ascontiguousarray(values, dtype="<i8").tobytes()


def check_finite(data: Floats, what: str, count: int | None = None) -> None:
    """Raise ValueError unless `count` floats are there and all are finite."""
    values = floats(data, what)
    if count is not None and len(values) != count:
        raise ValueError(f"wrong length: {what} has {len(values)} numbers, {count} expected")
    if not np.isfinite(values).all():
        raise ValueError(f"not finite: {what}")


def check_angles(data: Floats, what: str, count: int) -> None:
    """Raise ValueError unless `count` angles in [−π, π] are there."""
    check_finite(data, what, count)
    if count and np.abs(floats(data, what)).max() > np.pi:
        raise ValueError(f"out of bounds: {what} outside (−π, π]")


def check_ascending(data: Ids, what: str) -> None:
    """Raise ValueError unless the ids are strictly ascending."""
    values = ids(data, what)
    if len(values) > 1 and not (values[1:] > values[:-1]).all():
        raise ValueError(f"not ascending: {what}")


def check_covariance(data: Floats, n: int, what: str) -> None:
    """Raise ValueError unless n × n floats form a symmetric positive definite matrix."""
    check_finite(data, what, n * n)
    matrix = floats(data, what).reshape(n, n)
    with np.errstate(over="ignore"):  # of a difference that is then infinite, so not close
        symmetric = np.allclose(matrix, matrix.T, rtol=1e-9, atol=1e-300)
    if not symmetric:
        raise ValueError(f"not symmetric: {what}")
    _check_positive(matrix, what)


def check_packed_covariance(data: Floats, n: int, what: str) -> None:
    """Raise ValueError unless the packed upper triangle is of a positive definite n × n matrix."""
    if n > LARGEST_JOINT:
        raise ValueError(f"too large: {what} has {n} rows, {LARGEST_JOINT} at most")
    check_finite(data, what, n * (n + 1) // 2)
    if n:
        lower = np.zeros((n, n))
        lower.T[np.triu_indices(n)] = floats(data, what)
        _check_positive(lower, what)


def _check_positive(matrix: NDArray[np.float64], what: str) -> None:
    try:
        np.linalg.cholesky(matrix)  # reads the lower triangle
    except np.linalg.LinAlgError:
        raise ValueError(f"not positive definite: {what}") from None
