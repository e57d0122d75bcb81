"""Expected observations of landmarks that robots have not observed.

The probability p(d) ≤ 1 − `visibility.OVERLOOKED` to observe a landmark at distance d from a
submap's path is estimated from the robots' own landmarks. A landmark at distances d_s is expected
Σ p(d_s) times, and missed by all submaps with probability Π (1 − p(d_s)).
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
from teamslam.team.shapes import Bool, Float

BINS = 8  # bins of distance in which the probability of an observation is estimated
REACH = 0.95  # share of today's observations that are nearer than the farthest distance
STEPS = 4  # points between two poses of a path


class Absence(NamedTuple):
    """Expected number of observations, and the probability of none."""

    expected: float
    chance: float


def absences(island: Island, points: Float[np.ndarray, "n 2"]) -> list[Absence]:
    """Compute the expected observations of places without any."""
    submaps = [each for each in island.graph.submaps if not is_map(each.contribution.stream)]
    nodes = sorted({node for each in submaps for node in each.landmarks.tolist()})
    if not nodes:
        return [Absence(0.0, 1.0)] * len(points)
    own = island.points(nodes)
    paths = [path_of(island, each) for each in submaps]
    away = np.array([distances(path, own) for path in paths])
    seen = np.array([np.isin(nodes, each.landmarks) for each in submaps])
    rate = learn_rate(away.ravel(), seen.ravel())
    p = np.array([rate.at(distances(path, points)) for path in paths])
    p = np.minimum(p, 1.0 - OVERLOOKED)
    expected, missed = p.sum(axis=0), core.exp(core.log(1.0 - p).sum(axis=0))
    return [Absence(*each) for each in zip(expected.tolist(), missed.tolist(), strict=True)]


class DetectionRate(NamedTuple):
    """Probability to observe a landmark in each bin of distance [m] from a path; 0 beyond the last
    edge.
    """

    edges: Float[np.ndarray, " bins"]
    rates: Float[np.ndarray, " _"]

    def at(self, away: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the probability at each distance [m]."""
        return np.asarray(self.rates[np.searchsorted(self.edges, away)])


def learn_rate(
    away: Float[np.ndarray, " N"], seen: Bool[np.ndarray, " N"], unseen: float = 0.0
) -> DetectionRate:
    """Estimate the rate from distances [m] of landmarks and whether each was observed.

    unseen: missed landmarks added to each bin.
    """
    edges = np.quantile(away[seen], REACH * np.arange(1, BINS + 1) / BINS)
    of = np.searchsorted(edges, away)
    total = np.bincount(of, minlength=BINS + 1)[:BINS]
    found = np.bincount(of, seen, minlength=BINS + 1)[:BINS]
    return DetectionRate(edges, np.append(found / np.maximum(total + unseen, 1.0), 0.0))


def path_of(island: Island, submap: Joined) -> Float[np.ndarray, "K 2"]:
    """Sample points [m] of a submap's path."""
    poses = len(submap.contribution.local.node_stamps)
    start, end, *between = submap.nodes[: 2 + poses].tolist()
    corners = island.points([start, *between, end])
    share = (np.arange(STEPS) / STEPS)[:, None]
    parts: Sequence[Float[np.ndarray, "_ 2"]] = [a + share * (b - a) for a, b in pairwise(corners)]
    return np.concatenate([*parts, corners[-1:]])


def distances(
    path: Float[np.ndarray, "K 2"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Compute the distance [m] of each point from the nearest point of a path."""
    x, y = (points[:, None] - path).transpose(2, 0, 1)
    nearest: Float[np.ndarray, " n"] = core.hypot(x, y).min(axis=1)
    return nearest
