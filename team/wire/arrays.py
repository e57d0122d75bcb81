"""Arrays on the wire: little-endian `bin` fields, and the checks of their contents.

NumPy (14 MB) is imported at the first array; router and recorder receive none.
"""

import math
import struct
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from team.config import UNNAMED

if TYPE_CHECKING:
    import numpy as np
else:

    class _NumPy:
        def __getattr__(self, name: str) -> object:
            global np
            import numpy as np  # in place of this object

            return getattr(np, name)

    np = _NumPy()

Floats = bytes
"""float64, little-endian."""
Ids = bytes
"""uint32, little-endian."""
Stamps = bytes
"""int64 nanoseconds, little-endian."""

EPSILON = sys.float_info.epsilon
_SIZES = {"<f8": 8, "<u4": 4, "<i8": 8, "u1": 1}
FEW = 16
"""Largest number of floats that are checked one by one, faster than as an array."""
_NUMBERS = tuple(struct.Struct(f"<{count}d") for count in range(FEW + 1))
_POSE = _NUMBERS[9]
_SMALL = 128
"""Largest number of rows for which the indices of a packed triangle are cached."""
LARGEST_JOINT = 4096
"""Largest number of rows of a covariance."""


def _array(data: bytes, dtype: str, what: str) -> "np.typing.NDArray[Any]":
    size = _SIZES[dtype]
    if len(data) % size:
        raise ValueError(f"wrong length: {what} has {len(data)} bytes, not a multiple of {size}")
    return np.frombuffer(data, dtype=dtype)


def floats(data: Floats, what: str) -> "np.typing.NDArray[np.float64]":
    """Return a read-only float64 view."""
    return _array(data, "<f8", what)


def ids(data: Ids, what: str) -> "np.typing.NDArray[np.uint32]":
    """Return a read-only uint32 view."""
    return _array(data, "<u4", what)


def stamps(data: Stamps, what: str) -> "np.typing.NDArray[np.int64]":
    """Return a read-only int64 view."""
    return _array(data, "<i8", what)


def octets(data: bytes, what: str) -> "np.typing.NDArray[np.uint8]":
    """Return a read-only uint8 view."""
    return _array(data, "u1", what)


def from_floats(values: Any) -> Floats:
    """Encode as little-endian float64 bytes, C order."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def from_numbers(values: Sequence[float]) -> Floats:
    """Encode at most FEW plain floats as `from_floats` does, without an array."""
    return _NUMBERS[len(values)].pack(*values)


def from_ids(values: Any) -> Ids:
    """Encode as little-endian uint32 bytes."""
    return np.ascontiguousarray(values, dtype="<u4").tobytes()


def from_stamps(values: Any) -> Stamps:
    """Encode as little-endian int64 bytes."""
    return np.ascontiguousarray(values, dtype="<i8").tobytes()


def _few(data: Floats) -> tuple[float, ...] | None:
    """Return at most FEW numbers as plain floats, else None; their check is five times as fast."""
    count, rest = divmod(len(data), 8)
    return None if rest or count > FEW else _NUMBERS[count].unpack(data)


def check_finite(data: Floats, what: str, count: int | None = None) -> None:
    """Raise ValueError unless there are `count` floats, all finite."""
    few = _few(data)
    values = floats(data, what) if few is None else few
    if count is not None and len(values) != count:
        raise ValueError(f"wrong length: {what} has {len(values)} numbers, {count} expected")
    if not (np.isfinite(values).all() if few is None else all(map(math.isfinite, few))):
        raise ValueError(f"not finite: {what}")


def check_angles(data: Floats, what: str, count: int) -> None:
    """Raise ValueError unless there are `count` angles in [−π, π]."""
    check_finite(data, what, count)
    few = _few(data)
    values = np.abs(floats(data, what)).tolist() if few is None else map(abs, few)
    if max(values, default=0.0) > math.pi:
        raise ValueError(f"out of bounds: {what} outside (−π, π]")


def check_ranges(data: Floats, what: str, count: int | None = None) -> None:
    """Raise ValueError unless there are `count` finite floats, none negative."""
    check_finite(data, what, count)
    few = _few(data)
    if min(floats(data, what).tolist() if few is None else few, default=0.0) < 0.0:
        raise ValueError("out of bounds: a range is negative")


def check_named(data: Ids, what: str) -> None:
    """Raise ValueError if an id is that of a landmark without identity, 2³¹ or larger.

    A window assigns these numbers itself, so they would collide.
    """
    if ids(data, what).max(initial=0) >= UNNAMED:
        raise ValueError(f"out of bounds: {what} from 2³¹ on are of landmarks without identities")


def check_ascending(data: Ids, what: str) -> None:
    """Raise ValueError unless the ids are strictly ascending."""
    values = ids(data, what)
    if len(values) > 1 and not (values[1:] > values[:-1]).all():
        raise ValueError(f"not ascending: {what}")


def check_pose_covariance(data: Floats, what: str) -> None:
    """Raise ValueError unless nine floats form a symmetric positive definite 3 × 3 matrix.

    Symmetry is judged by the standard deviations, |Pᵢⱼ − Pⱼᵢ| ≤ 1e-9 σᵢ σⱼ; a pivot by the rounding
    error of a matrix with a unit diagonal. Plain floats take a tenth of the time of arrays of nine
    numbers.
    """
    if len(data) != _POSE.size:
        check_finite(data, what, 9)
    xx, xy, xt, yx, yy, yt, tx, ty, tt = _POSE.unpack(data)
    if not math.isfinite(xx + xy + xt + yx + yy + yt + tx + ty + tt):
        check_finite(data, what, 9)
    if not (xx > 0.0 and yy > 0.0 and tt > 0.0):
        raise ValueError(f"not positive definite: {what}")
    x, y, t = math.sqrt(xx), math.sqrt(yy), math.sqrt(tt)
    a, b, c = _clipped(yx / x / y), _clipped(tx / x / t), _clipped(ty / y / t)
    above = _clipped(xy / y / x), _clipped(xt / t / x), _clipped(yt / t / y)
    if max(abs(a - above[0]), abs(b - above[1]), abs(c - above[2])) > 1e-9:
        raise ValueError(f"not symmetric: {what}")
    of_y = 1.0 - a * a
    if of_y > 3.0 * EPSILON:
        rest = c - a * b
        if 1.0 - b * b - rest * rest / of_y > 3.0 * EPSILON:
            return
    raise ValueError(f"not positive definite: {what}")


def _clipped(value: float) -> float:
    return -2.0 if value < -2.0 else 2.0 if value > 2.0 else value


def check_semidefinite(data: Floats, n: int, what: str) -> None:
    """Raise ValueError unless n × n floats are symmetric and positive semi-definite, of any rank.

    A variance of zero belongs to an exact number; its row is then zero.
    """
    check_finite(data, what, n * n)
    matrix = floats(data, what).reshape(n, n)
    variances = np.diag(matrix)
    if not (variances >= 0.0).all() or matrix[variances == 0.0].any():
        raise ValueError(f"not positive definite: {what}")
    sigmas = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    with np.errstate(over="ignore"):  # beyond ±2 either way
        scaled = np.clip(matrix / sigmas / sigmas[:, None], -2.0, 2.0)
    if np.abs(scaled - scaled.T).max(initial=0.0) > 1e-9:
        raise ValueError(f"not symmetric: {what}")
    if np.linalg.eigvalsh(scaled).min(initial=0.0) < -1e-9:
        raise ValueError(f"not positive definite: {what}")


def check_packed_covariance(data: Floats, n: int, what: str) -> None:
    """Raise ValueError unless a packed upper triangle is a positive definite n × n matrix."""
    if n > LARGEST_JOINT:
        raise ValueError(f"too large: {what} has {n} rows, {LARGEST_JOINT} at most")
    check_finite(data, what, n * (n + 1) // 2)
    if n:
        _check_positive(_unit_diagonal(floats(data, what), n, what), what)


def check_blocks(data: Floats, count: int, what: str) -> None:
    """Raise ValueError unless there are `count` packed 2 × 2 covariances (3 floats each)."""
    check_finite(data, what, 3 * count)
    a, b, c = floats(data, what).reshape(count, 3).T
    root = np.sqrt(np.maximum(a, 0.0)) * np.sqrt(np.maximum(c, 0.0))  # a·c could overflow
    if not np.all(np.abs(b) < root):
        raise ValueError(f"not positive definite: {what}")


def _unit_diagonal(
    packed: "np.typing.NDArray[np.float64]", n: int, what: str
) -> "np.typing.NDArray[np.float64]":
    """Return the lower triangle of D⁻¹ P D⁻¹, D = √diag P, with zeros above it.

    Units and scale then do not influence the conditioning.
    """
    rows, columns, places, diagonal = _triangle(n) if n <= _SMALL else _triangle.__wrapped__(n)
    with np.errstate(over="ignore", invalid="ignore"):  # negative variances are refused below
        sigmas = np.sqrt(packed[diagonal])
        if not (sigmas > 0.0).all():
            raise ValueError(f"not positive definite: {what}")
        scaled = packed / sigmas[rows] / sigmas[columns]
    lower = np.zeros(n * n)
    lower[places] = np.minimum(np.maximum(scaled, -2.0), 2.0)
    return lower.reshape(n, n)


@lru_cache(maxsize=16)
def _triangle(n: int) -> "tuple[np.typing.NDArray[np.intp], ...]":
    """Return the indices of a packed upper triangle of n rows.

    They are the row and the column of each number, its index in the transposed matrix, row by row,
    and the indices of the diagonal in the triangle.
    """
    rows, columns = np.triu_indices(n)
    return rows, columns, columns * n + rows, np.flatnonzero(rows == columns)


def _check_positive(scaled: "np.typing.NDArray[np.float64]", what: str) -> None:
    """Raise ValueError unless each pivot of a matrix with a unit diagonal exceeds n ε."""
    try:
        factor = np.linalg.cholesky(scaled)  # reads the lower triangle
    except np.linalg.LinAlgError:
        raise ValueError(f"not positive definite: {what}") from None
    if factor.diagonal().min() ** 2 <= len(scaled) * EPSILON:
        raise ValueError(f"not positive definite: {what}")


def landmark_blocks(covariance: bytes, count: int, *, joint: bool) -> "np.ndarray":
    """The 2 × 2 covariance of each landmark [m²], (count, 2, 2).

    joint: the bytes are the packed upper triangle of all landmarks, else the packed blocks.
    """
    values = floats(covariance, "covariance").astype(np.float64)
    if joint:  # row i of a packed upper triangle of n rows begins at i·n − i(i − 1)/2
        n = 2 * count
        rows = np.arange(0, n, 2)
        first, second = (i * n - i * (i - 1) // 2 for i in (rows, rows + 1))
        xx, xy, yy = values[first], values[first + 1], values[second]
    else:
        xx, xy, yy = values.reshape(-1, 3).T
    return np.stack((xx, xy, xy, yy), axis=1).reshape(-1, 2, 2)
