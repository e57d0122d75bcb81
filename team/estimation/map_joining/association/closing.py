"""Whether a patch of landmarks lies at a place of another part of the map: map matching.

Pair voting proposes alignments; each is grown from two of its pairs under the real joint
covariance. The best one is taken only if no other alignment comes near it and most of what lies
there, on the side that has less, is matched; else it waits, and the test that failed is named.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from team.association import AssociationProfile
from team.estimation.map_joining.association.growing import Grown, Indices, Joint, Pair, grow
from team.estimation.map_joining.association.voting import Points, Vote, moved, voted

BEND = 8.0
"""So many radii of one object may two maps be bent against each other within a patch."""
WIDE = 3.0
"""So many spacings around a closure's places does an audit look."""
WEAK = 2
"""An alignment with so many times fewer votes than the best one has pairs is no rival of it."""
TRIED = 24
"""So many alignments are grown, those with the most matched points."""
SEEDS = 1
"""So many pairs of seeds are tried for each."""
NO_PAIRS: tuple[Pair, ...] = ()


class Side(NamedTuple):
    """Landmarks of one side: where they are in the joint Gaussian, their places and spreads.

    names: what they are called, for who asks. within: which of the whole side's they are.
    """

    at: Indices
    points: Points
    names: Indices
    within: Indices


class Closure(NamedTuple):
    """The best alignment with its figures. why: the test that failed; empty: it is accepted.

    rival_pairs, rival_llr: of the best other alignment. share: of the landmarks near the matched
    places, of the side that has fewer. sd: the largest one of the pairs' differences as they were
    taken [m]. motion: of the patch's centroid, as voted.
    """

    pairs: tuple[Pair, ...]
    llr: float
    rival_pairs: int
    rival_llr: float
    share: float
    sd: float
    motion: Float[np.ndarray, "3"]
    why: str


class Tests(NamedTuple):
    """What a closure needs: pairs, log-likelihood ratio, and `context` (islands only)."""

    pairs: int
    llr: float
    context: float = 0.0


def closure(
    patch: Side,
    target: Side,
    joint_of: Callable[[Vote], tuple[Joint, Side]],
    profile: AssociationProfile,
    tests: Tests,
    elsewhere: Sequence[Points] = (),
) -> Closure | None:
    """The best alignment of a patch with a target; None where there is none of two pairs.

    joint_of: the joint Gaussian of both given a proposed alignment, and what of the target is in
    it. elsewhere: places that the patch certainly does not lie at: what fits there as well is no
    sign of a place.
    """
    grown: list[tuple[Grown, Side, Vote]] = []
    most = 0
    for vote in voted(patch.points, target.points, tolerance(profile), reach(profile)):
        if len(grown) == TRIED or WEAK * len(vote.first) < most:
            break
        joint, there = joint_of(vote)
        found = _grown(patch, there, joint, vote, profile)
        if found is not None:
            grown.append((found, there, vote))
            most = max(most, len(found.pairs))
    if not grown:
        return None
    grown.sort(key=lambda each: -each[0].llr)
    best, target_there, vote = grown[0]
    mine = set(_named(best, target_there))
    others = [
        each
        for each, there, _ in grown[1:]
        if 2 * len(mine.intersection(_named(each, there))) < len(each.pairs)
    ]
    rival_pairs = max((len(each.pairs) for each in others), default=0)
    rival_llr = max((each.llr for each in others), default=0.0)
    for points in elsewhere:
        fitting = voted(patch.points, points, tolerance(profile), reach(profile))
        rival_pairs = max(rival_pairs, len(fitting[0].first) if fitting else 0)
    share = matched_share(
        best.joint.mean[patch.at],
        best.joint.mean[target_there.at],
        _places(best),
        len(best.pairs),
        profile,
    )
    closure = Closure(
        pairs=tuple(
            pair._replace(first=one, second=two)
            for pair, (one, two) in zip(best.pairs, _named(best, target_there), strict=True)
        ),
        llr=best.llr,
        rival_pairs=rival_pairs,
        rival_llr=rival_llr,
        share=share,
        sd=max(pair.sd for pair in best.pairs),
        motion=vote.motion,
        why="",
    )
    outside = len(target.at) - len(best.pairs)
    return closure._replace(why=failed(closure, outside, profile, tests))


def _named(grown: Grown, there: Side) -> list[tuple[int, int]]:
    """The pairs by their places among the patch and among the whole target."""
    of = dict(zip(there.at.tolist(), there.names.tolist(), strict=True))
    return [(pair.first, of[pair.second]) for pair in grown.pairs]


def failed(closure: Closure, outside: int, profile: AssociationProfile, tests: Tests) -> str:
    """The first test that a closure does not pass, in words; empty: it passes all."""
    pairs = len(closure.pairs)
    if pairs < tests.pairs:
        return f"pairs {pairs} < {tests.pairs}"
    if closure.llr < tests.llr:
        return f"log-likelihood ratio {closure.llr:.0f} < {tests.llr:g}"
    if closure.llr - closure.rival_llr < profile.margin:
        margin = closure.llr - closure.rival_llr
        return f"margin {margin:.0f} < {profile.margin:g} to another alignment"
    if pairs < profile.ratio * closure.rival_pairs:
        return (
            f"ratio {pairs / closure.rival_pairs:.2f} < {profile.ratio:g}: "
            f"another alignment has {closure.rival_pairs} pairs"
        )
    if closure.share < profile.share:
        return f"share {closure.share:.2f} < {profile.share:g} of what lies there is matched"
    if outside < tests.context * pairs:
        return f"context {outside} < {tests.context * pairs:.0f} landmarks: nothing to tell it from"
    return ""


def tolerance(profile: AssociationProfile) -> float:
    """How far matched points may lie apart in a proposal [m]."""
    return 0.4 * profile.same


def reach(profile: AssociationProfile) -> float:
    """How far apart two points may lie that vote together [m]."""
    return 30.0 * profile.same


def free_joint(
    patch: Joint, target: Joint, side: Side, vote: Vote, profile: AssociationProfile
) -> tuple[Joint, Side]:
    """Two maps in the target's frame, the patch as voted and free to lie anywhere; who is in it.

    The motion is N(voted, diag(extent², extent², π²)) about the patch's centroid, with the larger
    map's extent. Of the target what lies near the patch as voted, which is all that can be paired.
    """
    n = len(patch.mean)
    extent = float(max(np.ptp(each.mean, axis=0).max() for each in (patch, target)))
    local = patch.mean - patch.mean.mean(axis=0)
    away = np.hypot(*(moved(vote.motion, local)[:, None] - target.mean[None]).transpose(2, 0, 1))
    near = away.min(axis=0) < BEND * profile.same
    near[vote.second] = True
    kept = np.flatnonzero(near)
    target = Joint(
        target.mean[kept],
        target.covariance.reshape(len(near), 2, len(near), 2)[kept][:, :, kept].reshape(
            2 * len(kept), 2 * len(kept)
        ),
        target.apart[np.ix_(kept, kept)],
    )
    m = len(kept)
    c, s = np.cos(vote.motion[2]), np.sin(vote.motion[2])
    R = np.kron(np.eye(n), np.array([[c, -s], [s, c]]))
    there = moved(vote.motion, local)
    lever = there - vote.motion[:2]
    J = np.zeros((2 * n, 3))
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[0::2, 2], J[1::2, 2] = -lever[:, 1], lever[:, 0]
    covariance = np.zeros((2 * (n + m), 2 * (n + m)))
    spread = np.array([extent**2, extent**2, np.pi**2])
    covariance[: 2 * n, : 2 * n] = R @ patch.covariance @ R.T + (J * spread) @ J.T
    covariance[2 * n :, 2 * n :] = target.covariance
    apart = np.zeros((n + m, n + m), np.bool_)
    apart[:n, :n], apart[n:, n:] = patch.apart, target.apart
    both = Joint(np.concatenate([there, target.mean]), covariance, apart)
    return both, Side(n + np.arange(m), side.points, side.names[kept], kept)


def _grown(
    patch: Side,
    target: Side,
    joint: Joint,
    vote: Vote,
    profile: AssociationProfile,
) -> Grown | None:
    """The largest that grows from one of a few pairs of seeds; None where all seeds fail."""
    place = dict(zip(target.within.tolist(), target.at.tolist(), strict=True))
    first = patch.at[vote.first]
    second = np.array([place[k] for k in vote.second.tolist()], np.int64)
    one, two = np.meshgrid(patch.at, target.at, indexing="ij")
    points = patch.points.mean[vote.first]
    i, j = np.triu_indices(len(points), 1)
    far = np.argsort(-np.hypot(*(points[i] - points[j]).T), kind="stable")
    used: set[int] = set()
    best: Grown | None = None
    for k in far:
        if {int(i[k]), int(j[k])} & used:
            continue
        used |= {int(i[k]), int(j[k])}
        seeds = [(int(first[at]), int(second[at])) for at in (i[k], j[k])]
        found = grow(
            joint,
            (one.ravel(), two.ravel()),
            profile,
            seeds=seeds,
            sure_sd=profile.near,
        )
        if found is not None and (best is None or found.llr > best.llr):
            best = found
        if len(used) >= 2 * SEEDS or (best is not None and len(best.pairs) >= len(first)):
            break
    return best


def _places(grown: Grown) -> Float[np.ndarray, "k 2"]:
    return grown.joint.mean[[pair.second for pair in grown.pairs]]


def matched_share(
    one: Float[np.ndarray, "n 2"],
    two: Float[np.ndarray, "m 2"],
    places: Float[np.ndarray, "k 2"],
    pairs: int,
    profile: AssociationProfile,
) -> float:
    """Pairs / the fewer of the points of the two sides near the matched places.

    Near: not farther from one than the median distance between neighbouring places.
    """
    if len(places) < 2:
        return 0.0
    radius = 0.5 * spacing(places, profile)
    counts = [int((_distance(side, places) <= radius).sum()) for side in (one, two)]
    return pairs / max(min(counts), 1)


def overlap_share(
    one: Float[np.ndarray, "n 2"],
    two: Float[np.ndarray, "m 2"],
    places: Float[np.ndarray, "k 2"],
    profile: AssociationProfile,
) -> float:
    """Matched places / the fewer of the points of the two sides where both sides know the area.

    one, two: all points of either side, the matched ones among them. That is within WIDE spacings
    of a matched place, with a point of the other side within one: where two robots have been at
    different places their maps go on differently.
    """
    if len(places) < 2 or not len(one) or not len(two):
        return 0.0
    radius = spacing(places, profile)
    counts = [
        int(((_distance(a, places) <= WIDE * radius) & (_distance(a, b) <= radius)).sum())
        for a, b in ((one, two), (two, one))
    ]
    return len(places) / max(min(counts), 1)


def spacing(places: Float[np.ndarray, "k 2"], profile: AssociationProfile) -> float:
    """Twice the median distance between neighbouring places, and twice `same` at least [m]."""
    away = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    np.fill_diagonal(away, np.inf)
    return max(2.0 * float(np.median(away.min(axis=0))), 2.0 * profile.same)


def _distance(
    points: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " n"]:
    away: Float[np.ndarray, " n"] = np.hypot(
        *(points[:, None] - others[None]).transpose(2, 0, 1)
    ).min(axis=1)
    return away
