"""Nonlinear least squares: one iteration of Gauss-Newton, shortened or damped where the cost rises.

Robust losses enter by iterated re-weighting: a point's cost is quadratic in the residuals, with the
weights of that same point. A robust scale begins wide and narrows with the number of iterations
since its factor was added, so that a residual that is large at first is not taken for an outlier.
"""

import math
from abc import ABC, abstractmethod
from functools import cached_property, lru_cache
from typing import NamedTuple, Self, TypeVar

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.sparse_cholesky import sparse

Values = Float[np.ndarray, " _"]
SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)
"""Shares of an undamped step that are tried before damping: odometry makes long curved valleys, in
which damped steps are very short.
"""
LEAST_DAMPING = 1e-4
MOST_DAMPING = 1e8
STUCK = math.inf
"""The damping of a point from which no step lowers the cost."""
ROUNDING = 1e-10
"""Relative rise of the cost that is accepted: rounding near the minimum is no reason to damp."""


class Iterate(ABC):
    """An estimate of all unknowns, with the quadratic approximation of the cost there."""

    @property
    @abstractmethod
    def normal_equations(self) -> tuple[Values, Values]:
        """A = Σ w JᵀP⁻¹J in the layout of a block pattern, and the gradient Σ w JᵀP⁻¹r."""

    @property
    @abstractmethod
    def diagonal(self) -> Int64[np.ndarray, " n"]:
        """Indices of A's diagonal entries among its values."""

    @property
    @abstractmethod
    def posterior(self) -> sparse.Cholesky:
        """Cholesky factor of A."""

    @cached_property
    def step(self) -> Values:
        """The full step, −A⁻¹g."""
        return -sparse.solved(self.posterior, self.normal_equations[1][:, None])[:, 0]

    @abstractmethod
    def factorised(self, values: Values) -> sparse.Cholesky:
        """Cholesky factor of another matrix in A's layout."""

    @abstractmethod
    def cost_of(self, other: Self) -> float:
        """Σ w χ² of another point with this one's weights and noise: the quantity that a step
        lowers.

        Where it falls the robust cost falls too, since each loss lies below its parabola.
        """

    @abstractmethod
    def moved(self, step: Values) -> Self:
        """The point with `step` added to its unknowns."""


P = TypeVar("P", bound=Iterate)


class Iteration(NamedTuple):
    """The outcome of one step: the damping for the next one (or STUCK), the full step's largest
    change.
    """

    damping: float
    change: float


def iterated(point: P, damping: float) -> tuple[P, Iteration]:
    """Takes one step: returns the next point and the outcome of the step.

    The step −(A + damping · diag A)⁻¹g is taken if it lowers the cost; else, if undamped, a share
    of it; else a more damped one. Where no damping helps the point is returned unchanged, with the
    change of the first step.
    """
    values, gradient = point.normal_equations
    before = point.cost_of(point)
    refused = None
    while damping < MOST_DAMPING:
        if damping:
            damped = values.copy()
            damped[point.diagonal] *= 1.0 + damping
            step = -sparse.solved(point.factorised(damped), gradient[:, None])[:, 0]
        else:
            step = point.step
        for share in (1.0,) if damping else SHARES:
            moved = point.moved(share * step)
            if point.cost_of(moved) <= before * (1.0 + ROUNDING) + ROUNDING:
                eased = damping / 10.0 if damping > LEAST_DAMPING else 0.0
                return moved, Iteration(eased, _largest(step))
        refused = _largest(step) if refused is None else refused
        damping = max(10.0 * damping, LEAST_DAMPING)
    return point, Iteration(STUCK, math.inf if refused is None else refused)


def _largest(step: Values) -> float:
    return float(np.abs(step).max(initial=0.0))


def _powers(base: float, exponents: Int64[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Powers by products of repeated squares: a C library's differ from processor to processor."""
    powers, rest = np.ones(len(exponents)), exponents
    while rest.any():
        powers = np.where(rest & 1, powers * base, powers)
        base, rest = base * base, rest >> 1
    return powers


def robust_scale(
    age: Int64[np.ndarray, " k"], robust_c: float | None, start: float, decay: float
) -> Float[np.ndarray, " k"]:
    """Cauchy's scale c of factors after `age` iterations: robust_c · max(1, start · decay^age).

    Infinite without a robust loss.
    """
    if robust_c is None:
        return np.full(len(age), math.inf)
    if decay >= 1.0:  # it never narrows
        return robust_c * np.maximum(1.0, start * _powers(decay, age))
    narrowing = _narrowing(start, decay)
    scale: Float[np.ndarray, " k"] = robust_c * narrowing[np.minimum(age, len(narrowing) - 1)]
    return scale


@lru_cache
def _narrowing(start: float, decay: float) -> Float[np.ndarray, " k"]:
    """max(1, start · decay^age) of each age, up to the first one at which it is 1."""
    count = 1
    while start * _powers(decay, np.array([count - 1]))[0] > 1.0:
        count += 1
    factors: Float[np.ndarray, " k"] = np.maximum(1.0, start * _powers(decay, np.arange(count)))
    return factors
