"""Map matching: decides whether a patch of landmarks lies at a place of another part of the map.

Pair voting proposes alignments; each is grown from two of its pairs under the real joint
covariance. The evidence for it is the log-likelihood ratio of its pairs less a penalty for absent
landmarks: those that one side has where the other side observed and has none. The best alignment is
accepted only if no other one comes close to it and most of the landmarks there, of the side with
fewer, are matched; else it is deferred, with the name of the test that failed.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from team.association import AssociationProfile
from team.estimation import dense, elementary, elementwise
from team.estimation.map_joining.association.absence import SeenTogether, covered, renumbered
from team.estimation.map_joining.association.growing import Grown, Indices, Joint, Pair, grow
from team.estimation.map_joining.association.shares import distance, matched_share
from team.estimation.map_joining.association.voting import PointSet, Vote, moved, voted

BEND = 8.0
"""Largest distortion of two maps against each other within a patch, in radii of one object."""
WEAK = 2
"""An alignment with this many times fewer votes than the best one has pairs is no rival of it."""
EXAMINED = 120
"""Number of alignments that are examined: those with the most matched points."""
TRIED = 8
"""Number of them that are grown: those with the fewest absent landmarks for their matched ones."""
WORTH = 3.0
"""About what a matched point adds to the log-likelihood ratio; it decides which alignments are
grown.
"""
SEEDS = 3
"""Number of pairs of seeds that are tried for each."""


class Side(NamedTuple):
    """Landmarks of one side: their indices in the joint Gaussian, their positions and spreads.

    names: the caller's numbers of them.
    within: their indices in the whole side.
    views: which landmarks of the whole side were observed together.
    parts: groups of neighbours in the whole side.
    """

    at: Indices
    points: PointSet
    names: Indices
    within: Indices
    views: SeenTogether
    parts: tuple[Indices, ...] = ()


class Placement(NamedTuple):
    """A placement of the patch on the target: its pairs, and the part of the target that it was
    grown on.

    absent: number of landmarks that one side has where the other side observed and has none.
    evidence: log-likelihood ratio of the pairs less the penalty for the absent landmarks.
    as_rival: the same where a landmark is absent only if the other side has none at all beside it,
        matched or not. Where maps are bent, few of the pairs of a place are found, and what they
        leave over is no evidence against it.
    """

    grown: Grown
    there: Side
    motion: Float[np.ndarray, "3"]
    absent: int
    evidence: float
    as_rival: float


class Closure(NamedTuple):
    """The best alignment with its figures.

    why: the test that failed; empty: it is accepted.
    llr: log-likelihood ratio of its pairs.
    absent: number of absent landmarks.
    rival_pairs, rival_llr: pairs and evidence of the best other alignment.
    share: share of the landmarks near the matched places that are matched, of the side with fewer.
    sd: largest standard deviation [m] of a pair's difference when the pair was accepted.
    motion: of the patch's centroid, as voted.
    """

    pairs: tuple[Pair, ...]
    llr: float
    absent: int
    rival_pairs: int
    rival_llr: float
    share: float
    sd: float
    motion: Float[np.ndarray, "3"]
    why: str


class Tests(NamedTuple):
    """Requirements of a closure: pairs, evidence, and `context` of what both sides know (islands
    only).
    """

    pairs: int
    llr: float
    context: float = 0.0
    known: int = 0


def aligned(
    patch: Side,
    target: Side,
    joint_of: Callable[[Vote], tuple[Joint, Side]],
    profile: AssociationProfile,
) -> list[Placement]:
    """The alignments of a patch with a target, the one with the most evidence first.

    joint_of: returns the joint Gaussian of both for a proposed alignment, and the part of the
        target that is in it.
    """
    votes = voted(patch.points, target.points, tolerance(profile), reach(profile), patch.parts)[
        :EXAMINED
    ]
    votes.sort(key=lambda vote: -_promise(vote, patch, target, profile))
    found: list[Placement] = []
    most = 0
    for vote in votes[:TRIED]:
        if WEAK * len(vote.first) < most:
            continue
        joint, there = joint_of(vote)
        grown = _grown(patch, there, joint, vote, profile)
        if grown is not None:
            absent, surely = _absent(grown, patch, there, profile)
            found.append(
                Placement(
                    grown=grown,
                    there=there,
                    motion=vote.motion,
                    absent=absent,
                    evidence=grown.llr - profile.absent * absent,
                    as_rival=grown.llr - profile.absent * surely,
                )
            )
            most = max(most, len(grown.pairs))
    return sorted(found, key=lambda each: -each.evidence)


def closure(
    patch: Side,
    target: Side,
    joint_of: Callable[[Vote], tuple[Joint, Side]],
    profile: AssociationProfile,
    tests: Tests,
    aliases: Callable[[], Sequence[Placement]] = tuple,
) -> Closure | None:
    """The best alignment of a patch with a target; None where no alignment has two pairs.

    aliases: returns alignments of the patch that are certainly wrong: evidence as strong as theirs
        does not prove a place. Called only for an alignment that passes all other tests.
    """
    found = aligned(patch, target, joint_of, profile)
    if not found:
        return None
    best = found[0]
    mine = set(_named(best.grown, best.there))
    others = [
        each
        for each in found[1:]
        if 2 * len(mine.intersection(_named(each.grown, each.there))) < len(each.grown.pairs)
    ]
    share = matched_share(
        best.grown.joint.mean[patch.at],
        best.grown.joint.mean[best.there.at],
        _places(best.grown),
        len(best.grown.pairs),
        profile,
    )
    closure = Closure(
        pairs=tuple(
            pair._replace(first=one, second=two)
            for pair, (one, two) in zip(
                best.grown.pairs, _named(best.grown, best.there), strict=True
            )
        ),
        llr=best.grown.llr,
        absent=best.absent,
        rival_pairs=0,
        rival_llr=0.0,
        share=share,
        sd=max(pair.sd for pair in best.grown.pairs),
        motion=best.motion,
        why="",
    )
    closure = _against(closure, others)
    closure = closure._replace(why=failed(closure, profile, tests))
    if closure.why:
        return closure
    closure = _against(closure, aliases())
    return closure._replace(why=failed(closure, profile, tests))


def _against(closure: Closure, others: Sequence[Placement]) -> Closure:
    """The closure with the figures of the best rival, if one of `others` is better than its present
    one.
    """
    best = max(others, key=lambda each: each.as_rival, default=None)
    if best is None or best.as_rival <= closure.rival_llr:
        return closure
    return closure._replace(rival_pairs=len(best.grown.pairs), rival_llr=best.as_rival)


def _promise(vote: Vote, patch: Side, target: Side, profile: AssociationProfile) -> float:
    """Estimated evidence for an alignment, from where the points lie as it is voted."""
    local = patch.points.mean - patch.points.mean.mean(axis=0)
    sides = (moved(vote.motion, local), vote.first), (target.points.mean, vote.second)
    absent, _ = _missing(*sides, (patch.views, target.views), profile)
    return WORTH * len(vote.first) - profile.absent * absent


def _absent(grown: Grown, patch: Side, there: Side, profile: AssociationProfile) -> tuple[int, int]:
    """Number of landmarks of either side that are not matched where the other side observed, and of
    those of them beside which it has none.
    """
    mean = grown.joint.mean
    here = np.full(int(max(there.views.max(initial=-1), there.within.max())) + 1, -1)
    here[there.within] = np.arange(len(there.within))
    first, second = np.array([(pair.first, pair.second) for pair in grown.pairs]).T
    return _missing(
        (mean[patch.at], np.flatnonzero(np.isin(patch.at, first))),
        (mean[there.at], np.flatnonzero(np.isin(there.at, second))),
        (patch.views, renumbered(there.views, here)),
        profile,
    )


def _missing(
    one: tuple[Float[np.ndarray, "n 2"], Indices],
    two: tuple[Float[np.ndarray, "m 2"], Indices],
    views: tuple[SeenTogether, SeenTogether],
    profile: AssociationProfile,
) -> tuple[int, int]:
    """Number of unmatched points of two sides, given with the matched ones' indices, inside the
    other side's views, and of those of them that no point of the other side is close to.

    A point close to a matched place may be a split-off part of that landmark, and is not counted.
    """
    count = surely = 0
    for (points, matched), (own, theirs), seen in ((one, two, views[1]), (two, one, views[0])):
        left = np.delete(points, matched, axis=0)
        if len(left):
            left = left[distance(left, own[theirs]) >= profile.same]
        if len(left):
            left = left[covered(left, own, seen)]
            count += len(left)
        if len(left):
            surely += int((distance(left, own) >= profile.same).sum())
    return count, surely


def _named(grown: Grown, there: Side) -> list[tuple[int, int]]:
    """The pairs by their indices in the patch and in the whole target."""
    of = dict(zip(there.at.tolist(), there.names.tolist(), strict=True))
    return [(pair.first, of[pair.second]) for pair in grown.pairs]


def failed(closure: Closure, profile: AssociationProfile, tests: Tests) -> str:
    """The first test that a closure fails, in words; empty if it passes all."""
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
    if tests.context and outside < tests.context * pairs:
        return f"context {outside} < {tests.context * pairs:.0f} landmarks: nothing to tell it from"
    return ""


def tolerance(profile: AssociationProfile) -> float:
    """Largest distance [m] of matched points in a proposal."""
    return 0.4 * profile.same


def reach(profile: AssociationProfile) -> float:
    """Largest distance [m] of two points that vote together."""
    return 30.0 * profile.same


def free_joint(
    patch: Joint, target: Joint, side: Side, vote: Vote, profile: AssociationProfile
) -> tuple[Joint, Side]:
    """Two maps in the target's frame, with the patch as voted and free to lie anywhere; and what is
    in it.

    The motion is N(voted, diag(extent², extent², π²)) about the patch's centroid, with the larger
    map's extent. Of the target only the landmarks near the patch as voted are in it, which are all
    that can be paired.
    """
    n = len(patch.mean)
    extent = float(max(np.ptp(each.mean, axis=0).max() for each in (patch, target)))
    local = patch.mean - patch.mean.mean(axis=0)
    away = elementwise.hypot(
        *(moved(vote.motion, local)[:, None] - target.mean[None]).transpose(2, 0, 1)
    )
    near = away.min(axis=0) < BEND * profile.same
    near[vote.second] = True
    nearby = np.flatnonzero(near)
    target = Joint(
        target.mean[nearby],
        target.covariance.reshape(len(near), 2, len(near), 2)[nearby][:, :, nearby].reshape(
            2 * len(nearby), 2 * len(nearby)
        ),
        target.apart[np.ix_(nearby, nearby)],
        target.crowd,
    )
    m = len(nearby)
    s, c = elementwise.sin_and_cos(vote.motion[2])
    R = np.kron(np.eye(n), np.array([[c, -s], [s, c]]))
    there = moved(vote.motion, local)
    lever = there - vote.motion[:2]
    J = np.zeros((2 * n, 3))
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[0::2, 2], J[1::2, 2] = -lever[:, 1], lever[:, 0]
    covariance = np.zeros((2 * (n + m), 2 * (n + m)))
    spread = np.array(
        [elementary.squared(extent), elementary.squared(extent), elementary.squared(np.pi)]
    )
    covariance[: 2 * n, : 2 * n] = dense.product(
        dense.product(R, patch.covariance), R.T
    ) + dense.product(J * spread, J.T)
    covariance[2 * n :, 2 * n :] = target.covariance
    apart = np.zeros((n + m, n + m), np.bool_)
    apart[:n, :n], apart[n:, n:] = patch.apart, target.apart
    both = Joint(np.concatenate([there, target.mean]), covariance, apart, target.crowd)
    return both, Side(n + np.arange(m), side.points, side.names[nearby], nearby, side.views)


def _grown(
    patch: Side,
    target: Side,
    joint: Joint,
    vote: Vote,
    profile: AssociationProfile,
) -> Grown | None:
    """The largest alignment that grows from one of a few pairs of seeds; None where all seeds
    fail.
    """
    place = dict(zip(target.within.tolist(), target.at.tolist(), strict=True))
    first = patch.at[vote.first]
    second = np.array([place[k] for k in vote.second.tolist()], np.int64)
    one, two = np.meshgrid(patch.at, target.at, indexing="ij")
    points = patch.points.mean[vote.first]
    i, j = np.triu_indices(len(points), 1)
    far = np.argsort(-elementwise.hypot(*(points[i] - points[j]).T), kind="stable")
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
