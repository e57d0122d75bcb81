"""Products and solutions of dense matrices with the same bits on every processor.

Sums run in index order. Further leading axes are stacks, as in NumPy.
"""

from teamslam.team.core import (
    cholesky,
    forward,
    inverse_of_factored,
    product,
    solve,
    solve_factored,
)
from teamslam.team.core import inverse_matrix as inverse

__all__ = [
    "cholesky",
    "forward",
    "inverse",
    "inverse_of_factored",
    "product",
    "solve",
    "solve_factored",
]
