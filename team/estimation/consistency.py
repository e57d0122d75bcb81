"""Does a covariance tell the truth? Normalised squared errors and the intervals they belong in.

Bar-Shalom, Li and Kirubarajan 2001, section 5.4.
"""

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular
from scipy.stats import chi2

from team.estimation.gaussian import cholesky_factor


def state_error(
    estimate: Float[np.ndarray, " n"], truth: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """The error of a state (x [m], y [m], theta [rad], …), theta's wrapped to (−π, π]."""
    error: Float[np.ndarray, " n"] = estimate - truth
    error[2] += 2.0 * np.pi * np.floor((np.pi - error[2]) / (2.0 * np.pi))
    return error


def nees(error: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"]) -> float:
    """Normalised estimation error squared, eᵀ P⁻¹ e: χ² with n degrees of freedom, mean n.

    Raises NotACovarianceError if P is not a covariance.
    """
    L = cholesky_factor(covariance, "an estimation error")
    whitened = solve_triangular(L, error, lower=True)
    return float(whitened @ whitened)


def chi2_interval(dof: int, probability: float, runs: int) -> tuple[float, float]:
    """The two-sided interval that holds the mean over `runs` of NEES/dof with this probability.

    The sum of `runs` independent χ² of `dof` degrees of freedom is χ² with dof·runs of them.
    """
    tail = 0.5 * (1.0 - probability)
    total = dof * runs
    return float(chi2.ppf(tail, total)) / total, float(chi2.isf(tail, total)) / total


def coverage(
    nees_values: Float[np.ndarray, " runs"], dof: Float[np.ndarray, " runs"], probability: float
) -> float:
    """The share of runs whose NEES lies in the ellipsoid that should hold `probability` of them."""
    return float(np.mean(nees_values <= chi2.ppf(probability, dof)))
