"""Find the landmark that its submaps place most differently: moved, or two of one name."""

from typing import NamedTuple

import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.estimation.map_joining.gauss_newton import Island

LEAST_SUBMAPS = 4
"""Least number of submaps of a landmark to be judged."""
BEYOND = 5.0
"""Least cost per degree of freedom of a misfit, and least multiple of the landmarks' median.

The mean of LEAST_SUBMAPS sound submaps exceeds it with probability P(χ²₈ ≥ 40) = 3·10⁻⁶.
"""
FAR = 30.0
"""χ² of two numbers from which a submap has the landmark elsewhere, in units of the median cost
where that is above 1: P(χ²₂ ≥ 30) = 3·10⁻⁷.
"""
LEAST_FAR = 2
STRAY = 0.1
"""Share of a misfit's submaps, LEAST_FAR at least, that have it elsewhere. With fewer a misread
detection is likelier, and the landmark's place is right: markers that are misread easily have up to
6 of 177 submaps elsewhere (UTIAS set 2, landmark 15, whose place is right to 2 mm).
"""


class Misfit(NamedTuple):
    """A landmark, its cost per degree of freedom over all submaps, and the landmarks' median."""

    landmark: int
    cost: float
    median: float


def worst_landmark(island: Island) -> Misfit | None:
    """Find the named landmark with the largest cost per degree of freedom, where it stands out.

    The cost of landmark l is the mean over its submaps of rᵀ(f P_ll)⁻¹r/2, without discounting.
    Landmarks that all misfit alike point to the sensor's noise. A share of its submaps must have it
    elsewhere (FAR), to exclude a misread detection, which costs as much.
    """
    graph = island.graph
    if not graph.submaps:
        return None
    factor = island.settings.covariance_factor
    chi2 = graph.factors.landmark_chi2(island.state, factor)
    nodes = np.concatenate([each.landmarks for each in graph.submaps])
    count = np.bincount(nodes, minlength=len(graph.fixed))
    total = np.bincount(nodes, chi2, minlength=len(graph.fixed))
    judged = [
        (float(total[node]) / (2.0 * float(count[node])), id_, node)
        for id_, node in sorted(graph.landmarks.items())
        if id_ < UNNAMED and count[node] >= LEAST_SUBMAPS
    ]
    if len(judged) < LEAST_SUBMAPS:
        return None
    median = float(np.median([cost for cost, *_ in judged]))
    scale = max(1.0, median)
    far = np.bincount(nodes[chi2 >= FAR * scale], minlength=len(graph.fixed))
    beyond = [
        (cost, id_)
        for cost, id_, node in judged
        if cost >= BEYOND * scale and far[node] >= max(LEAST_FAR, STRAY * count[node])
    ]
    if not beyond:
        return None
    cost, landmark = max(beyond)
    return Misfit(landmark, cost, median)
