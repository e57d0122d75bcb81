"""Landmarks of a saved map that today's robots should have observed and have not.

The probability p(d) to observe a landmark at distance d from a submap's path is learnt from today's
landmarks, at most that of a window beside it (`visibility.OVERLOOKED`). A landmark at distances d_s
is expected Σ p(d_s) times and missed by all with probability Π (1 − p(d_s)).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation.association.visibility import OVERLOOKED
from teamslam.team.estimation.contribution import is_map
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.submap_graph import Joined
from teamslam.team.shapes import Float

BINS = 8
"""Number of distances at which the probability of an observation is learnt."""
REACH = 0.95
"""Share of today's observations that are nearer than the farthest distance."""
STEPS = 4
"""Points of a path between two poses."""


class Absence(NamedTuple):
    """Expected number of observations of a landmark, and the probability of none."""

    expected: float
    chance: float


def absences(island: Island, points: Float[np.ndarray, "n 2"]) -> list[Absence]:
    """Compute the expected observations of places at which nothing was observed."""
    submaps = [each for each in island.graph.submaps if not is_map(each.contribution.stream)]
    nodes = sorted({node for each in submaps for node in each.landmarks.tolist()})
    if not nodes:
        return [Absence(0.0, 1.0)] * len(points)
    at = island.graph.offset[nodes]
    own = np.column_stack([island.state[at], island.state[at + 1]])
    paths = [_path(island, each) for each in submaps]
    away = np.array([_distances(path, own) for path in paths])
    seen = np.array([np.isin(nodes, each.landmarks) for each in submaps])
    edges = np.quantile(away[seen], REACH * np.arange(1, BINS + 1) / BINS)
    of = np.searchsorted(edges, away)
    total = np.bincount(of.ravel(), minlength=BINS + 1)[:BINS]
    found = np.bincount(of.ravel(), seen.ravel(), minlength=BINS + 1)[:BINS]
    rate = np.append(np.minimum(found / np.maximum(total, 1), 1.0 - OVERLOOKED), 0.0)
    p = rate[np.searchsorted(edges, np.array([_distances(path, points) for path in paths]))]
    expected, missed = p.sum(axis=0), core.exp(core.log(1.0 - p).sum(axis=0))
    return [Absence(*each) for each in zip(expected.tolist(), missed.tolist(), strict=True)]


def _path(island: Island, submap: Joined) -> Float[np.ndarray, "K 2"]:
    poses = len(submap.contribution.local.node_stamps)
    start, end, *between = submap.nodes[: 2 + poses].tolist()
    at = island.graph.offset[[start, *between, end]]
    corners = np.column_stack([island.state[at], island.state[at + 1]])
    share = (np.arange(STEPS) / STEPS)[:, None]
    parts: Sequence[Float[np.ndarray, "_ 2"]] = [a + share * (b - a) for a, b in pairwise(corners)]
    return np.concatenate([*parts, corners[-1:]])


def _distances(
    path: Float[np.ndarray, "K 2"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    x, y = (points[:, None] - path).transpose(2, 0, 1)
    nearest: Float[np.ndarray, " n"] = core.hypot(x, y).min(axis=1)
    return nearest
