"""Find the landmarks, or the whole submap, that contradict a robot's prior.

The prior and the submaps are the graph of one stream, solved with the centre's robust losses.
"""

import math
from collections.abc import Sequence

import numpy as np

from teamslam.team.core import WholeMap
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    JoinSettings,
    empty_island,
    extend_island,
    joint_marginal,
    solve_island,
)
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Bool

STREAM = ("self", 0)  # the stream of the prior and of the submaps


def find_beyond(
    whole: WholeMap, submaps: Sequence[LocalMap], gate: float
) -> list[Bool[np.ndarray, " L"]]:
    """Find each submap's landmarks of χ² beyond the gate, with a robust loss on landmarks alone."""
    island = _solve(whole, submaps, JoinSettings(submap_gate=math.inf, landmark_gate=gate))
    beyond = island.graph.factors.landmark_chi2(island.state, 1.0) > gate
    return np.split(beyond, island.graph.landmark_start[1:-1])[1:]


def join_robustly(whole: WholeMap, submaps: Sequence[LocalMap], gate: float) -> WholeMap:
    """Join the submaps with Cauchy's loss on the prior and on each submap as a whole."""
    island = _solve(whole, submaps, JoinSettings(submap_gate=0.5, landmark_gate=gate))
    graph = island.graph
    ids = sorted(graph.landmarks)
    nodes = [graph.streams[STREAM][-1], *(graph.landmarks[id_] for id_ in ids)]
    return WholeMap(np.array(ids, dtype=np.uint32), *joint_marginal(island, nodes))


def _solve(whole: WholeMap, submaps: Sequence[LocalMap], settings: JoinSettings) -> Island:
    chain = [LocalMap(whole.ids, whole.mean, whole.covariance), *submaps]
    taken = [Contribution(*STREAM, k, k, each) for k, each in enumerate(chain)]
    return solve_island(extend_island(empty_island(settings), taken, {}))[0]
