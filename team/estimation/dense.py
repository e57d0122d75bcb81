"""Products and solutions of dense matrices with the same bits on every processor.

Sums run in index order. Further leading axes are stacks, as in NumPy.
"""

import numpy as np

from teamslam.team.core import (
    cholesky,
    forward,
    inverse_of_factored,
    product,
    solve,
    solve_factored,
)
from teamslam.team.core import inverse_matrix as inverse
from teamslam.team.shapes import Float

__all__ = [
    "cholesky",
    "congruent",
    "forward",
    "inverse",
    "inverse_of_factored",
    "product",
    "quadratic",
    "solve",
    "solve_factored",
]


def congruent(A: Float[np.ndarray, "n k"], P: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "n n"]:
    """Compute A P Aᵀ."""
    return product(product(A, P), A.T)


def quadratic(W: Float[np.ndarray, "n n"], x: Float[np.ndarray, " n"]) -> float:
    """Compute xᵀ W x."""
    return float(product(product(x, W), x))
