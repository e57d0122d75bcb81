"""Consistency of covariances: normalised squared errors and their intervals.

Bar-Shalom, Li and Kirubarajan 2001, section 5.4.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import cholesky_factor
from teamslam.team.shapes import Float

MEDIAN_PRICE = 1.3
"""Ratio of the scatter of a χ² median of a few degrees of freedom to that of its mean."""


def nees(error: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"]) -> float:
    """Compute eᵀ P⁻¹ e, χ² with n degrees of freedom. Raises NotACovarianceError."""
    L = cholesky_factor(covariance, "an estimation error")
    whitened = dense.forward(L, error)
    return float(dense.product(whitened, whitened))


@lru_cache
def chi2_limit(dof: int, tail: float) -> float:
    """Return the value that χ² of `dof` degrees of freedom exceeds with the probability `tail`.

    Rounded to twelve digits.
    """
    return float(f"{core.chi2_quantiles(1.0 - tail, tail, np.array([float(dof)]))[0]:.12g}")


def chi2_quantile(
    probability: float, dof: Float[np.ndarray, " n"] | float | int
) -> Float[np.ndarray, " n"] | float:
    """Return the value that χ² of `dof` degrees of freedom does not exceed with this probability.

    NaN for dof < 1. Rounded to 36 bits.
    """
    exact = core.chi2_quantiles(
        probability, 1.0 - probability, np.atleast_1d(np.asarray(dof, float))
    )
    mantissa, exponent = np.frexp(exact)
    quantile = np.ldexp(np.rint(mantissa * 2.0**36) * 2.0**-36, exponent)
    return quantile if np.ndim(dof) else float(quantile[0])


def chi2_interval(dof: int, probability: float, runs: int) -> tuple[float, float]:
    """Compute the two-sided interval of the mean of NEES/dof over `runs`: χ² of
    dof·runs degrees.
    """
    tail = 0.5 * (1.0 - probability)
    total = dof * runs
    return float(chi2_quantile(tail, total)) / total, chi2_limit(total, tail) / total


def coverage(
    nees_values: Float[np.ndarray, " runs"], dof: Float[np.ndarray, " runs"], probability: float
) -> float:
    """Return the share of runs with a NEES in the ellipsoid of this probability."""
    return float(np.mean(nees_values <= chi2_quantile(probability, dof)))


class Scale(NamedTuple):
    """Factor by which the covariances must grow to agree with the errors.

    log_sigma: about one standard deviation of its logarithm.
    """

    value: float
    log_sigma: float


def covariance_scale(
    squared: Float[np.ndarray, " K"],
    dof: Float[np.ndarray, " K"],
    medians: Float[np.ndarray, " K"] | None = None,
) -> Scale | None:
    """Estimate the scale s of terms s χ²(dof): the weighted median of squared_k / median χ²(dof_k).

    Terms with dof < 1 are left out; None where none is left. medians: of χ²(dof), if available.
    """
    if medians is None:
        medians = np.atleast_1d(chi2_quantile(0.5, dof))
    found = core.chi2_scale(squared, dof, medians)
    return None if found is None else Scale(found[0], MEDIAN_PRICE * math.sqrt(2.0 / found[1]))
