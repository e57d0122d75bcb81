"""Landmarks that a final map leaves out: placed by an uncertain heading, or missed by most submaps
that look there; and streams that were lost.

`teamslam.team.estimation.association.verification.find_possible_duplicates` finds duplicates.
"""

import math
from collections.abc import Collection

import numpy as np

from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.memory import MOST
from teamslam.team.estimation.map_joining.nonlinearity import heading_sigma


def find_weakly_placed(island: Island, ids: Collection[int]) -> list[int]:
    """Find the landmarks among these that only submaps of an uncertain heading have, ascending.

    A covariance is linear in the heading. A point at distance d turned by an error θ moves by d (1
    − cos θ) in a direction that the linearised covariance takes as certain: d/3 at the limit for a
    rigid alignment (`alignment_heading_sigma`) and three standard deviations.
    """
    best: dict[int, float] = {}
    for submap in island.graph.submaps:
        sigma = min(heading_sigma(island, node) for node in submap.nodes[:2].tolist())
        for node in submap.landmarks[submap.landmarks >= 0].tolist():
            best[node] = min(sigma, best.get(node, math.inf))
    limit, node_of = island.settings.alignment_heading_sigma, island.graph.landmarks
    return [id_ for id_ in sorted(ids) if best.get(node_of.get(id_, -1), 0.0) > limit]


def find_missed(fold: Fold, ids: Collection[int]) -> list[int]:
    """Find the landmarks among these that nearly all submaps miss which look at their place,
    ascending; none that an operator has judged. All are of the main island.

    A landmark of n < MOST submaps is missed where each landmark of MOST or more that any of these
    has beside it has been observed by MOST n, and at least half of these have one. (A running map
    drops a landmark that is not found again: `memory`.) The number of false landmarks that two
    submaps agree on grows with the number of submaps; the share of submaps that find them does not.
    """
    graph = fold.main.graph
    counts = np.zeros(len(graph.fixed), np.int64)
    before = {} if graph.condensed is None else graph.condensed.departed.believed
    for id_, node in graph.landmarks.items():
        counts[node] = before.get(id_, 0)
    for submap in graph.submaps:
        counts[submap.landmarks[submap.landmarks >= 0]] += 1
    observed = np.full(len(counts), np.iinfo(np.int64).max)
    having, knowing = np.zeros_like(counts), np.zeros_like(counts)
    for each in graph.observed:
        beside = counts[each.known]
        well_known = beside[beside >= MOST]
        having[each.known] += 1
        if len(well_known):
            knowing[each.known] += 1
            observed[each.known] = np.minimum(observed[each.known], well_known.min())
    missing = (counts < MOST) & (observed >= MOST * counts) & (2 * knowing >= having) & (having > 0)
    gone = {*np.flatnonzero(missing).tolist()}
    judged = fold.landmarks.judged()
    return [id_ for id_ in sorted({*ids} - judged) if graph.landmarks.get(id_) in gone]


def find_lost_streams(island: Island) -> dict[Stream, float]:
    """Find the streams with a heading standard deviation above `alignment_heading_sigma`; return
    the largest one [rad] of each.
    """
    worst = {
        stream: max(heading_sigma(island, node) for node in nodes)
        for stream, nodes in island.graph.streams.items()
    }
    limit = island.settings.alignment_heading_sigma
    return {stream: sigma for stream, sigma in worst.items() if sigma > limit}
