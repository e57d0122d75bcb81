"""Products and solutions of dense matrices with the same bits on every processor.

An entry of a product is one sum in the order of its index; a BLAS orders sums by processor. Arrays
of three and more axes are stacks of matrices, as in NumPy.
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
