"""Products and solutions of dense matrices with the same bits on every processor.

Sums run in index order. Further leading axes are stacks, as in NumPy.
"""

import numpy as np

from teamslam.team.core import (
    cholesky,
    forward,
    inverse_matrix as inverse,
    inverse_of_factored,
    product,
    solve,
    solve_factored,
)
from teamslam.team.shapes import Float

__all__ = [
    "add_to_blocks",
    "cholesky",
    "congruent",
    "diagonal_blocks",
    "forward",
    "inverse",
    "inverse_of_factored",
    "product",
    "quadratic",
    "solve",
    "solve_factored",
]


def congruent(
    A: Float[np.ndarray, "*a n k"], P: Float[np.ndarray, "*b k k"]
) -> Float[np.ndarray, "*c n n"]:
    """Compute A P Aᵀ."""
    return product(product(A, P), A.swapaxes(-1, -2))


def quadratic(W: Float[np.ndarray, "n n"], x: Float[np.ndarray, " n"]) -> float:
    """Compute xᵀ W x."""
    return float(product(product(x, W), x))


def diagonal_blocks(P: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "L 2 2"]:
    """Return the 2 × 2 blocks on the diagonal."""
    at = np.arange(len(P) // 2)
    blocks: Float[np.ndarray, "L 2 2"] = P.reshape(len(at), 2, len(at), 2)[at, :, at]
    return blocks


def add_to_blocks(P: Float[np.ndarray, "n n"], blocks: Float[np.ndarray, "L 2 2"]) -> None:
    """Add to the 2 × 2 blocks on the diagonal, in place."""
    at = np.arange(len(blocks))
    P.reshape(len(at), 2, len(at), 2)[at, :, at] += blocks
