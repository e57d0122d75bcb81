"""Nonlinear least squares: shortening and damping of steps, and narrowing of robust scales.

Robust losses enter by iterated re-weighting: a point's cost is quadratic in the residuals, with the
weights of that point. A robust scale narrows with the iterations since its factor was added, so
that a residual that is large at first is not taken for an outlier.
"""

import math
from functools import lru_cache

import numpy as np

from teamslam.team.shapes import Float, Int64

Values = Float[np.ndarray, " _"]
HALVINGS = 4
"""Number of times that an undamped step is halved before damping: in the long curved valleys of
odometry damped steps are very short.
"""
MOST_DAMPING = 1e8
STUCK = math.inf
"""Damping of a point from which no step lowers the cost."""


def _powers(base: float, exponents: Int64[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Compute powers by repeated squares: a C library's differ from processor to processor."""
    powers, rest = np.ones(len(exponents)), exponents
    while rest.any():
        powers = np.where(rest & 1, powers * base, powers)
        base, rest = base * base, rest >> 1
    return powers


def robust_scale(
    age: Int64[np.ndarray, " k"], start: float, decay: float
) -> Float[np.ndarray, " k"]:
    """Widening of the gates of factors after `age` iterations: max(1, start · decay^age)."""
    if decay >= 1.0:  # it never narrows
        return np.maximum(1.0, start * _powers(decay, age))
    narrowing = _narrowing(start, decay)
    scale: Float[np.ndarray, " k"] = narrowing[np.minimum(age, len(narrowing) - 1)]
    return scale


@lru_cache
def _narrowing(start: float, decay: float) -> Float[np.ndarray, " k"]:
    """max(1, start · decay^age) of each age, up to the first one at which it is 1."""
    count = 1
    while start * _powers(decay, np.array([count - 1]))[0] > 1.0:
        count += 1
    factors: Float[np.ndarray, " k"] = np.maximum(1.0, start * _powers(decay, np.arange(count)))
    return factors
