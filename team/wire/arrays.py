"""Arrays on the wire: little-endian `bin` fields, whose contents the core checks.

NumPy (14 MB) is imported at the first array; router and recorder receive none.
"""

from typing import TYPE_CHECKING, Any

from teamslam.team.core import check_derivatives, check_finite

if TYPE_CHECKING:
    import numpy as np
else:

    class _NumPy:
        def __getattr__(self, name: str) -> object:
            global np
            import numpy as np  # in place of this object

            return getattr(np, name)

    np = _NumPy()

Floats = bytes  # float64, little-endian
Ids = bytes  # uint32, little-endian
Stamps = bytes  # int64 nanoseconds, little-endian


def _array(data: bytes, dtype: str, what: str) -> "np.typing.NDArray[Any]":
    try:
        return np.frombuffer(data, dtype=dtype)
    except ValueError:
        size = np.dtype(dtype).itemsize
        wrong = f"wrong length: {what} has {len(data)} bytes, not a multiple of {size}"
        raise ValueError(wrong) from None


def floats(data: Floats, what: str) -> "np.typing.NDArray[np.float64]":
    """View as float64, read-only."""
    return _array(data, "<f8", what)


def derivatives(data: bytes, count: int, what: str) -> "np.typing.NDArray[np.float64]":
    """Read `count` derivatives: float32 on the wire, float64 in older logs."""
    check_derivatives(data, count, what)
    return _array(data, "<f8" if len(data) == 8 * count else "<f4", what).astype(np.float64)


def ids(data: Ids, what: str) -> "np.typing.NDArray[np.uint32]":
    """View as uint32, read-only."""
    return _array(data, "<u4", what)


def stamps(data: Stamps, what: str) -> "np.typing.NDArray[np.int64]":
    """View as int64, read-only."""
    return _array(data, "<i8", what)


def octets(data: bytes, what: str) -> "np.typing.NDArray[np.uint8]":
    """View as uint8, read-only."""
    return _array(data, "u1", what)


def from_floats(values: Any) -> Floats:
    """Encode as float64, C order."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def from_derivatives(values: Any) -> bytes:
    """Encode as float32, C order."""
    return np.ascontiguousarray(values, dtype="<f4").tobytes()


def from_ids(values: Any) -> Ids:
    """Encode as uint32."""
    return np.ascontiguousarray(values, dtype="<u4").tobytes()


def from_stamps(values: Any) -> Stamps:
    """Encode as int64."""
    return np.ascontiguousarray(values, dtype="<i8").tobytes()


def check_semidefinite(data: Floats, n: int, what: str) -> None:
    """Raise ValueError unless n × n floats are symmetric and positive semi-definite, of any rank.

    The row of an exact number (variance 0) is zero.
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


def landmark_blocks(covariance: bytes, count: int, *, joint: bool) -> "np.ndarray":
    """Extract the 2 × 2 covariances of landmarks [m²] from a packed joint triangle, or blocks."""
    values = floats(covariance, "covariance").astype(np.float64)
    if joint:  # row i of a packed upper triangle of n rows begins at i·n − i(i − 1)/2
        n = 2 * count
        rows = np.arange(0, n, 2)
        first, second = (i * n - i * (i - 1) // 2 for i in (rows, rows + 1))
        xx, xy, yy = values[first], values[first + 1], values[second]
    else:
        xx, xy, yy = values.reshape(-1, 3).T
    return np.stack((xx, xy, xy, yy), axis=1).reshape(-1, 2, 2)
