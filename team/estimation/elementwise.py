"""The functions of `team.estimation.elementary` for arrays of any shape; a number for a number."""

import math
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Float

from team.estimation import elementary
from team.estimation.compiled import compiled

Numbers = TypeVar("Numbers", float, Float[np.ndarray, "..."])
Flat = Float[np.ndarray, " n"]


def sin(angles: Numbers) -> Numbers:
    """The sine of each angle [rad]."""
    return _shaped(_sin_and_cos(_flat(angles))[0], angles)


def cos(angles: Numbers) -> Numbers:
    """The cosine of each angle [rad]."""
    return _shaped(_sin_and_cos(_flat(angles))[1], angles)


def sin_and_cos(angles: Numbers) -> tuple[Numbers, Numbers]:
    """Sine and cosine of each angle [rad]."""
    s, c = _sin_and_cos(_flat(angles))
    return _shaped(s, angles), _shaped(c, angles)


def atan2(y: Numbers, x: Numbers) -> Numbers:
    """The direction of each (x, y) in [−π, π]."""
    y, x = _alike(y, x)
    return _shaped(_atan2(_flat(y), _flat(x)), y)


def hypot(x: Numbers, y: Numbers) -> Numbers:
    """The length of each (x, y)."""
    x, y = _alike(x, y)
    return _shaped(_hypot(_flat(x), _flat(y)), x)


def exp(x: Numbers) -> Numbers:
    """E to the power of each x."""
    return _shaped(_exp(_flat(x)), x)


def expm1(x: Numbers) -> Numbers:
    """E to the power of each x, less 1."""
    return _shaped(_expm1(_flat(x)), x)


def log(x: Numbers) -> Numbers:
    """The natural logarithm of each x."""
    return _shaped(_log(_flat(x)), x)


def log1p(x: Numbers) -> Numbers:
    """The logarithm of each 1 + x."""
    return _shaped(_log1p(_flat(x)), x)


def _alike(one: Numbers, other: Numbers) -> tuple[Numbers, Numbers]:
    if np.shape(one) == np.shape(other):
        return one, other
    alike: Any = np.broadcast_arrays(one, other)
    return cast(Numbers, alike[0]), cast(Numbers, alike[1])


def _flat(values: Numbers) -> Flat:
    flat = np.asarray(values, np.float64).ravel()
    return flat if flat.flags.writeable else flat.copy()  # one form of each kernel


def _shaped(flat: Flat, like: Numbers) -> Numbers:
    shaped: Any = flat.reshape(np.shape(like))[()]
    return cast(Numbers, shaped)


@compiled
def _sin_and_cos(angles: Flat) -> tuple[Flat, Flat]:
    s, c = np.empty(len(angles)), np.empty(len(angles))
    for i in range(len(angles)):
        s[i], c[i] = elementary.sin_and_cos(angles[i])
    return s, c


@compiled
def _atan2(y: Flat, x: Flat) -> Flat:
    angles = np.empty(len(y))
    for i in range(len(y)):
        angles[i] = elementary.atan2(y[i], x[i])
    return angles


@compiled
def _hypot(x: Flat, y: Flat) -> Flat:
    lengths = np.empty(len(x))
    for i in range(len(x)):
        lengths[i] = elementary.hypot(x[i], y[i])
    return lengths


@compiled
def _exp(x: Flat) -> Flat:
    powers = np.empty(len(x))
    for i in range(len(x)):
        powers[i] = elementary.exp(x[i])
    return powers


@compiled
def _expm1(x: Flat) -> Flat:
    powers = np.empty(len(x))
    for i in range(len(x)):
        powers[i] = elementary.expm1(x[i])
    return powers


@compiled
def _log(x: Flat) -> Flat:
    logs = np.empty(len(x))
    for i in range(len(x)):
        logs[i] = elementary.log(x[i])
    return logs


@compiled
def _log1p(x: Flat) -> Flat:
    logs = np.empty(len(x))
    for i in range(len(x)):
        logs[i] = elementary.log1p(x[i])
    return logs


def normal_below(x: Numbers) -> Numbers:
    """The probability that a standard normal variable stays below each x, to 1e-15."""
    return _shaped(_normal_below(_flat(x)), x)


@compiled
def _normal_below(x: Flat) -> Flat:
    """½ + φ(x) (x + x³/3 + x⁵/15 + …), Marsaglia 2004; 0 and 1 beyond ±9."""
    shares = np.empty(len(x))
    for i in range(len(x)):
        if not abs(x[i]) < 9.0:
            shares[i] = x[i] if x[i] != x[i] else 1.0 if x[i] > 0.0 else 0.0
            continue
        term = total = x[i]
        k = 1.0
        while abs(term) > 1e-17 * abs(total):
            k += 2.0
            term *= x[i] * x[i] / k
            total += term
        density = elementary.exp(-0.5 * x[i] * x[i]) / math.sqrt(2.0 * math.pi)
        shares[i] = min(max(0.5 + density * total, 0.0), 1.0)
    return shares
