"""Gaussians as (mean, covariance), and the checks and packings of covariance matrices."""

import numpy as np
from jaxtyping import Float

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


def packed(covariance: Matrix) -> Float[np.ndarray, " m"]:
    """The upper triangle row by row: n(n+1)/2 numbers."""
    return np.ascontiguousarray(covariance[np.triu_indices(len(covariance))])


def unpacked(triangle: Float[np.ndarray, " m"], n: int) -> Matrix:
    """The symmetric n × n matrix of a packed upper triangle."""
    upper = np.zeros((n, n))
    upper[np.triu_indices(n)] = triangle
    return upper + np.triu(upper, 1).T
