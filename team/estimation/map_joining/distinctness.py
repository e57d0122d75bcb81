"""Which landmarks of a map are known to be different ones, which are placed by a known heading, and
which most submaps miss that look there.

Association merges two landmarks only where no rival comes near, and otherwise waits. Until it is
decided they may be one: a map that shows both may show one landmark twice.
"""

import math
from collections.abc import Collection

import numpy as np

from team.estimation.contribution import Stream
from team.estimation.map_joining.associating import IslandView
from team.estimation.map_joining.association.growing import Indices, likelihoods
from team.estimation.map_joining.gauss_newton import Island
from team.estimation.map_joining.joining import Fold
from team.estimation.map_joining.memory import MOST
from team.estimation.map_joining.nonlinearity import heading_sigma


def maybe_the_same(view: IslandView, ids: Collection[int]) -> dict[int, int]:
    """Of these landmarks, those that may be one with another one, each with the likeliest other
    one, which stays.

    They may be one where they are within the gate, and have the log-likelihood ratio (`growing`)
    with which a pair is merged that has no rival, or would not have it even at one place: where
    more landmarks may lie in the gate than there is evidence for, nothing is known. The landmark
    whose position is known best stays, by the area of its covariance's ellipse.
    """
    profile, joint = view.profile, view.joint
    own: Indices = np.array([view.place_of[id_] for id_ in sorted(ids)], np.int64)
    one, two = (own[each] for each in np.triu_indices(len(own), 1))
    at = likelihoods(joint, one, two, profile)
    decidable = at.llr + 0.5 * at.chi2 >= profile.llr_tight
    maybe = (at.chi2 < profile.gate) & ((at.llr >= profile.llr_tight) | ~decidable)
    maybe &= ~joint.apart[one, two]
    llr: dict[int, dict[int, float]] = {}
    for a, b, ratio in zip(
        one[maybe].tolist(), two[maybe].tolist(), at.llr[maybe].tolist(), strict=True
    ):
        llr.setdefault(a, {})[b] = llr.setdefault(b, {})[a] = ratio
    n = len(joint.mean)
    xx, xy, _, yy = (
        joint.covariance.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)].reshape(n, 4).T
    )
    area = xx * yy - xy * xy
    stays: set[int] = set()
    out: dict[int, int] = {}
    for each in sorted(llr, key=lambda k: (float(area[k]), view.ids[k])):
        others = [other for other in llr[each] if other in stays]
        if others:
            likeliest = max(others, key=lambda other: (llr[each][other], -view.ids[other]))
            out[view.ids[each]] = view.ids[likeliest]
        else:
            stays.add(each)
    return out


def weakly_placed(island: Island, ids: Collection[int]) -> list[int]:
    """Of these landmarks, those that only submaps of a poorly known heading have, ascending.

    A covariance is linear in the heading: of a place at a distance d that turns by an error θ it
    leaves out d (1 − cos θ), which at the limit for a rigid alignment (`alignment_heading_sigma`)
    and three standard deviations is d/3, in a direction that it takes for known.
    """
    best: dict[int, float] = {}
    for submap in island.graph.submaps:
        sigma = min(heading_sigma(island, node) for node in submap.nodes[:2].tolist())
        for node in submap.landmarks[submap.landmarks >= 0].tolist():
            best[node] = min(sigma, best.get(node, math.inf))
    limit, node_of = island.settings.alignment_heading_sigma, island.graph.landmarks
    return [id_ for id_ in sorted(ids) if best.get(node_of.get(id_, -1), 0.0) > limit]


def missed(fold: Fold, ids: Collection[int]) -> list[int]:
    """Of these landmarks of the main island, those that nearly all submaps miss which look at their
    place, ascending; none that an operator has judged.

    A landmark of n < MOST submaps is missed where each landmark of MOST or more that any of these
    has beside it has been observed by MOST n, and at least half of these have one. (A running map
    gives up what is not found since it was observed last: `memory`.) How many false landmarks two
    submaps agree on grows with the number of submaps; the share of those that find them does not.
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


def lost(island: Island) -> dict[Stream, float]:
    """The largest standard deviation [rad] of a heading of each stream where it exceeds
    `alignment_heading_sigma`.
    """
    worst = {
        stream: max(heading_sigma(island, node) for node in nodes)
        for stream, nodes in island.graph.streams.items()
    }
    limit = island.settings.alignment_heading_sigma
    return {stream: sigma for stream, sigma in worst.items() if sigma > limit}
