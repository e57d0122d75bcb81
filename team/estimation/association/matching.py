"""Matches one scan with landmarks: the best pair first, each detection and each landmark at most
once.
"""

import numpy as np
from jaxtyping import Float, Int64

from team.estimation import elementwise
from team.estimation.association.scans import NOBODY


def squared_distances(
    differences: Float[np.ndarray, "*n 2"], covariances: Float[np.ndarray, "*n 2 2"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """dᵀ S⁻¹ d and ln |S| of each."""
    a, b, c = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    x, y = differences[..., 0], differences[..., 1]
    determinant = np.maximum(a * c - b * b, 1e-300)
    squared = (c * x * x - 2.0 * b * x * y + a * y * y) / determinant
    return squared, elementwise.log(determinant)


def best_pairs_first(
    squared: Float[np.ndarray, "n L"], costs: Float[np.ndarray, "n L"], gate: float
) -> Int64[np.ndarray, " n"]:
    """Assign a landmark to each detection; NOBODY where none is left within the gate.

    The pair with the least cost within the gate is taken, then the next one whose detection and
    landmark are both free. Equal costs are taken in their order.
    """
    found = np.full(len(squared), NOBODY)
    rows, columns = np.nonzero(squared < gate)
    taken = np.zeros(squared.shape[1], np.bool_)
    for index in np.argsort(costs[rows, columns], kind="stable"):
        row, column = rows[index], columns[index]
        if found[row] == NOBODY and not taken[column]:
            found[row], taken[column] = column, True
    return found
