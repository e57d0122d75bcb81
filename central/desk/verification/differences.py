"""Find the first differing field of two messages."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from teamslam.team.wire import arrays
from teamslam.team.wire import messages as m

RELATIVE = 1e-6
ABSOLUTE = 1e-9
"""Elsewhere: |a − b| ≤ ABSOLUTE·s + RELATIVE·|b|, s the array's largest magnitude (at least 1)."""
_IDS: dict[str, Callable[[bytes, str], NDArray[Any]]] = {
    "ids": arrays.ids,
    "stamps": arrays.stamps,
    "nodes": arrays.stamps,
    "counts": arrays.ids,
    "rows": arrays.ids,
    "landmarks": arrays.ids,
    "seen": arrays.octets,
}
_FLOATS = (
    "pose",
    "poses",
    "mean",
    "means",
    "covariance",
    "covariances",
    "classes",
    "sensitivity",
    "curvature",
    "weights",
    "start",
    "start_covariance",
    "crosses",
    "point",
)
ARRAYS = frozenset({*_IDS, *_FLOATS})
"""Fields compared number by number."""


@dataclass(frozen=True)
class FieldDifference:
    """First differing field, with both values as text."""

    field: str
    recorded: str
    recomputed: str


def first_difference(
    recorded: m.Message, recomputed: m.Message, *, exact: bool
) -> FieldDifference | None:
    """Find the first differing field, within the tolerance unless `exact`."""
    for name in recorded.__struct_fields__:
        a, b = getattr(recorded, name), getattr(recomputed, name)
        if a == b:
            continue
        if name in _IDS or name in _FLOATS:
            found = _array_difference(name, _values(name, a), _values(name, b), exact=exact)
            if found is not None:
                return found
        elif exact or not _close(a, b):
            return FieldDifference(name, _text(a), _text(b))
    return None


def _values(name: str, data: bytes) -> NDArray[Any]:
    return _IDS[name](data, name) if name in _IDS else arrays.floats(data, name)


def _array_difference(
    name: str, a: NDArray[Any], b: NDArray[Any], *, exact: bool
) -> FieldDifference | None:
    if len(a) != len(b):
        return FieldDifference(name, f"{len(a)} numbers", f"{len(b)} numbers")
    tolerant = not exact and name in _FLOATS
    scale = max(1.0, float(np.abs(b).max(initial=0.0))) if tolerant else 0.0
    bits = f"u{a.itemsize}"
    same = (
        np.isclose(a, b, RELATIVE, ABSOLUTE * scale) if tolerant else a.view(bits) == b.view(bits)
    )
    if same.all():
        return None
    k = int(np.argmin(same))
    return FieldDifference(f"{name}[{k}]", repr(a[k].item()), repr(b[k].item()))


def _close(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=RELATIVE, abs_tol=ABSOLUTE)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_close, a, b))
    if isinstance(a, msgspec.Struct) and type(a) is type(b):
        return _close(msgspec.structs.astuple(a), msgspec.structs.astuple(b))
    return a == b


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, msgspec.Struct | tuple):
        return str(msgspec.to_builtins(value))[:200]
    return repr(value)[:200]
