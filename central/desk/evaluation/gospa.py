"""GOSPA: one distance between two sets of points that counts misplaced, missed and false ones.

Rahmathullah, García-Fernández and Svensson 2017, with p = 2 and α = 2: over the best assignment of
pairs nearer than the cut-off c,

    GOSPA² = Σ d² + c²/2 · (missed + false).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment


@dataclass(frozen=True)
class Gospa:
    """The distance, its cut-off c, and its parts: RMS of the assigned pairs, and the numbers of
    missed and false points.
    """

    distance_m: float
    cut_off_m: float
    localisation_m: float | None
    missed: int
    false: int


def gospa(
    found: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "m 2"], cut_off_m: float
) -> Gospa:
    """GOSPA of the found points, in the frame of the true ones."""
    squared = np.minimum(((found[:, None] - true[None]) ** 2).sum(axis=2), cut_off_m**2)
    rows, columns = linear_sum_assignment(squared)
    near = squared[rows, columns] < cut_off_m**2
    assigned = squared[rows, columns][near]
    missed, false = len(true) - len(assigned), len(found) - len(assigned)
    total = float(assigned.sum()) + 0.5 * cut_off_m**2 * (missed + false)
    rms = float(np.sqrt(assigned.mean())) if len(assigned) else None
    return Gospa(float(np.sqrt(total)), cut_off_m, rms, missed, false)


def half_spacing(true: Float[np.ndarray, "m 2"]) -> float | None:
    """Half the median distance of a true landmark from its nearest neighbour: the cut-off."""
    if len(true) < 2:
        return None
    apart = np.hypot(*(true[:, None] - true[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    return 0.5 * float(np.median(apart.min(axis=1)))
