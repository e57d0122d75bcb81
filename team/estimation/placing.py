"""Write parts of arrays in loops within kernels.

An assignment `A[i:j, k:l] = B` checks the shapes, and its message makes the compiler compile
NumPy's and Python's number formatting with the kernel: seconds for each process.
"""

import numpy as np
from jaxtyping import Num

from team.estimation.compiled import compiled


@compiled
def put(row: Num[np.ndarray, " n"], begin: int, values: Num[np.ndarray, " k"]) -> None:
    """row[begin : begin + k] = values."""
    for i in range(len(values)):
        row[begin + i] = values[i]


@compiled
def put_block(
    A: Num[np.ndarray, "n m"], row: int, column: int, block: Num[np.ndarray, "k l"]
) -> None:
    """A[row : row + k, column : column + l] = block."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            A[row + i, column + j] = block[i, j]
