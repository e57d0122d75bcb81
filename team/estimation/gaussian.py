"""Gaussians as (mean, covariance), and the checks and packings of covariance matrices."""

import numpy as np
from jaxtyping import Float, Int64
from scipy.linalg.lapack import dpotri

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]


class NotACovarianceError(ValueError):
    """A matrix used as a covariance is not finite, not symmetric or not positive definite."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"the covariance of {what} is {why}")
        self.what = what
        self.why = why


def cholesky_factor(covariance: Matrix, what: str) -> Matrix:
    """Lower L with L Lᵀ = covariance; `what` names the matrix in the error if there is none."""
    if not np.isfinite(covariance).all():
        raise NotACovarianceError(what, "not finite")
    scale = np.sqrt(np.abs(np.outer(np.diag(covariance), np.diag(covariance))))
    if (np.abs(covariance - covariance.T) > 1e-9 * scale + 1e-300).any():
        raise NotACovarianceError(what, "not symmetric")
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise NotACovarianceError(what, "not positive definite") from None


def information(covariance: Matrix, what: str) -> Matrix:
    """P⁻¹ = L⁻ᵀL⁻¹ from the Cholesky factor of P, exactly symmetric."""
    if not len(covariance):
        return np.zeros((0, 0))
    lower, _ = dpotri(cholesky_factor(covariance, what), lower=1)
    triangle = np.tril(lower)
    return np.asarray(triangle + np.tril(triangle, -1).T)


def with_marginal(
    mean: Vector,
    covariance: Matrix,
    index: Int64[np.ndarray, " k"],
    marginal_mean: Float[np.ndarray, " k"],
    marginal_covariance: Float[np.ndarray, "k k"],
) -> tuple[Vector, Matrix]:
    """N(mean, covariance) with the marginal of its entries s = `index` replaced by N(m, C).

    The conditional of the others stays (Jeffrey's rule), they follow by regression:
    K = P_os P_ss⁻¹, x_o + K (m − x_s), P_oo − K P_so + K C Kᵀ, and K C between them.
    """
    if not len(index):
        return mean.copy(), covariance.copy()
    own = covariance[np.ix_(index, index)]
    gain = covariance[:, index] @ information(own, "the marginal to replace")
    gain[index] = np.eye(len(index))
    change = marginal_covariance - own
    replaced = covariance + gain @ change @ gain.T
    replaced[np.ix_(index, index)] = marginal_covariance
    moved = mean + gain @ (marginal_mean - mean[index])
    moved[index] = marginal_mean
    return moved, 0.5 * (replaced + replaced.T)


def packed(covariance: Matrix) -> Float[np.ndarray, " m"]:
    """The upper triangle row by row: n(n+1)/2 numbers."""
    return np.ascontiguousarray(covariance[np.triu_indices(len(covariance))])


def unpacked(triangle: Float[np.ndarray, " m"], n: int) -> Matrix:
    """The symmetric n × n matrix of a packed upper triangle."""
    upper = np.zeros((n, n))
    upper[np.triu_indices(n)] = triangle
    return upper + np.triu(upper, 1).T
