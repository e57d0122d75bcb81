"""The core's elementary functions for arrays of any shape; a number for a number."""

from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Float

from team import core

Numbers = TypeVar("Numbers", float, Float[np.ndarray, "..."])
Flat = Float[np.ndarray, " n"]


def sin(angles: Numbers) -> Numbers:
    """The sine of each angle [rad]."""
    return _shaped(core.sin_and_cos(_flat(angles))[0], angles)


def cos(angles: Numbers) -> Numbers:
    """The cosine of each angle [rad]."""
    return _shaped(core.sin_and_cos(_flat(angles))[1], angles)


def sin_and_cos(angles: Numbers) -> tuple[Numbers, Numbers]:
    """Sine and cosine of each angle [rad]."""
    s, c = core.sin_and_cos(_flat(angles))
    return _shaped(s, angles), _shaped(c, angles)


def atan2(y: Numbers, x: Numbers) -> Numbers:
    """The direction of each (x, y) in [−π, π]."""
    y, x = _alike(y, x)
    return _shaped(core.atan2(_flat(y), _flat(x)), y)


def hypot(x: Numbers, y: Numbers) -> Numbers:
    """The length of each (x, y)."""
    x, y = _alike(x, y)
    return _shaped(core.hypot(_flat(x), _flat(y)), x)


def exp(x: Numbers) -> Numbers:
    """E to the power of each x."""
    return _shaped(core.exp(_flat(x)), x)


def expm1(x: Numbers) -> Numbers:
    """E to the power of each x, less 1."""
    return _shaped(core.expm1(_flat(x)), x)


def log(x: Numbers) -> Numbers:
    """The natural logarithm of each x."""
    return _shaped(core.log(_flat(x)), x)


def log1p(x: Numbers) -> Numbers:
    """The logarithm of each 1 + x."""
    return _shaped(core.log1p(_flat(x)), x)


def _alike(one: Numbers, other: Numbers) -> tuple[Numbers, Numbers]:
    if np.shape(one) == np.shape(other):
        return one, other
    alike: Any = np.broadcast_arrays(one, other)
    return cast(Numbers, alike[0]), cast(Numbers, alike[1])


def _flat(values: Numbers) -> Flat:
    return np.asarray(values, np.float64).ravel()


def _shaped(flat: Flat, like: Numbers) -> Numbers:
    shaped: Any = flat.reshape(np.shape(like))[()]
    return cast(Numbers, shaped)


def normal_below(x: Numbers) -> Numbers:
    """The probability that a standard normal variable stays below each x, to 1e-15."""
    return _shaped(core.normal_below(_flat(x)), x)
