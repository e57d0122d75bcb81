"""Tests of a closure, at its proposal and during its audit, and of a map's landmarks."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.association import AssociationProfile
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.gating import Indices, Pair
from teamslam.team.estimation.association.island_view import IslandView
from teamslam.team.shapes import Float

WIDE = 3.0  # radius around a closure's places that an audit considers, in spacings
MOST_REPEATED = 40
"""Largest number of landmarks that another place is expected to repeat (36 lamps of a corridor),
which limits the required context.
"""
NO_CONTEXT = (
    "too few others to exclude a like place. Give starts, tags on some landmarks or a verdict, "
    "or if all robots are in one place central.association.context = 0"
)
"""Reason and remedy of a closure without context."""


class Closure(NamedTuple):
    """The best alignment of a patch with its figures.

    why: the failed test; empty if accepted. llr: log-likelihood ratio of its pairs. absent: number
    of landmarks of one side that the other side viewed without having one. rival_pairs, rival_llr:
    of the best other alignment. share: matched share of the landmarks near the matched places, of
    the side with fewer. sd: largest standard deviation [m] of a pair's difference. motion: (x, y,
    θ) from patch to target; zero within one map.
    """

    pairs: tuple[Pair, ...]
    llr: float
    share: float
    sd: float
    motion: Float[np.ndarray, "3"]
    absent: int = 0
    rival_pairs: int = 0
    rival_llr: float = 0.0
    why: str = ""


class ClosureTests(NamedTuple):
    """Least pairs, evidence, and context of a closure.

    context: least landmarks outside the matched place over the pairs, of the `known` ones of both
    sides (two islands only; 0: not tested).
    """

    pairs: int
    llr: float
    context: float = 0.0
    known: int = 0


def find_failed_test(closure: Closure, profile: AssociationProfile, tests: ClosureTests) -> str:
    """Return the first test that a closure fails, in words; empty if it passes all."""
    pairs = len(closure.pairs)
    evidence = closure.llr - profile.absent * closure.absent
    if pairs < tests.pairs:
        return f"pairs {pairs} < {tests.pairs}"
    if evidence < tests.llr:
        absent = f" ({closure.absent} landmarks are absent)" if closure.absent else ""
        return f"evidence {evidence:.0f} < {tests.llr:g}{absent}"
    if evidence - closure.rival_llr < profile.margin:
        margin = evidence - closure.rival_llr
        return f"margin {margin:.0f} < {profile.margin:g} to another alignment"
    if evidence < profile.ratio * closure.rival_llr:
        return (
            f"ratio {evidence / closure.rival_llr:.2f} < {profile.ratio:g}: "
            f"another alignment has {closure.rival_pairs} pairs"
        )
    if closure.share < profile.share:
        return f"share {closure.share:.2f} < {profile.share:g} of what lies there is matched"
    outside = tests.known - 2 * pairs
    least = tests.context * min(pairs, MOST_REPEATED)
    if tests.context and outside < least:
        return f"context {outside} < {least:.0f} landmarks: {NO_CONTEXT}"
    return ""


def is_ambiguous(closure: Closure, profile: AssociationProfile) -> bool:
    """Return whether another alignment, with enough pairs for a merge, is nearly as likely."""
    evidence = closure.llr - profile.absent * closure.absent
    is_rivalled = (
        evidence - closure.rival_llr < profile.margin
        or evidence < profile.ratio * closure.rival_llr
    )
    return is_rivalled and closure.rival_pairs >= profile.island_pairs


def matched_share(
    one: Float[np.ndarray, "n 2"],
    two: Float[np.ndarray, "m 2"],
    places: Float[np.ndarray, "k 2"],
    profile: AssociationProfile,
) -> float:
    """Compute matched places over the number of points near them, of the side with fewer.

    Near: within the median distance between neighbouring places.
    """
    if len(places) < 2:
        return 0.0
    radius = 0.5 * spacing(places, profile)
    counts = [int((nearest_distance(side, places) <= radius).sum()) for side in (one, two)]
    return len(places) / max(min(counts), 1)


def overlap_share(
    one: Float[np.ndarray, "n 2"],
    two: Float[np.ndarray, "m 2"],
    places: Float[np.ndarray, "k 2"],
    profile: AssociationProfile,
) -> float:
    """Compute matched places over the number of points in view of both sides, of the side with
    fewer.

    one, two: all points of either side. A point counts within WIDE spacings of a matched place and
    one spacing of a point of the other side.
    """
    if len(places) < 2 or not len(one) or not len(two):
        return 0.0
    radius = spacing(places, profile)
    counts = [
        int(
            (
                (nearest_distance(a, places) <= WIDE * radius) & (nearest_distance(a, b) <= radius)
            ).sum()
        )
        for a, b in ((one, two), (two, one))
    ]
    return len(places) / max(min(counts), 1)


def spacing(places: Float[np.ndarray, "k 2"], profile: AssociationProfile) -> float:
    """Compute twice the median distance [m] between neighbouring places, at least twice `same`."""
    away = core.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    np.fill_diagonal(away, np.inf)
    return max(2.0 * float(np.median(away.min(axis=0))), 2.0 * profile.same)


def nearest_distance(
    points: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " n"]:
    """Compute the distance [m] from each point to the nearest one of `others`."""
    away: Float[np.ndarray, " n"] = core.hypot(
        *(points[:, None] - others[None]).transpose(2, 0, 1)
    ).min(axis=1)
    return away


def find_possible_duplicates(
    view: IslandView, ids: Collection[int], parts: Mapping[int, int]
) -> dict[int, int]:
    """Map each landmark that may be one with another of them to the likeliest, which stays.

    Such a pair is within the gate and has the evidence of a merge, lies in a density in which no
    pair has it, or joins two `parts` that no common landmark ties, whose pairs have one common
    error. The landmark of the smallest covariance ellipse stays.
    """
    profile, joint = view.profile, view.joint
    own: Indices = np.array([view.place_of[id_] for id_ in sorted(ids)], np.int64)
    one, two = (own[each] for each in np.triu_indices(len(own), 1))
    at = joint.evaluate(one, two)
    decidable = at.llr + 0.5 * at.chi2 >= profile.llr_tight
    part = np.array([parts.get(id_, 0) for id_ in sorted(ids)], np.int64)
    by_odometry = np.not_equal(*(part[each] for each in np.triu_indices(len(own), 1)))
    maybe = (at.chi2 < profile.gate) & ((at.llr >= profile.llr_tight) | ~decidable | by_odometry)
    maybe &= ~joint.apart[one, two]
    llr: dict[int, dict[int, float]] = {}
    for a, b, ratio in zip(
        one[maybe].tolist(), two[maybe].tolist(), at.llr[maybe].tolist(), strict=True
    ):
        llr.setdefault(a, {})[b] = llr.setdefault(b, {})[a] = ratio
    xx, xy, _, yy = dense.diagonal_blocks(joint.covariance).reshape(-1, 4).T
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
