"""Closures: a patch of landmarks found at a place of another part of the map, or of another map.

The patch, the landmarks of a stream's last submaps, is compared with the rest of its island or with
another island. Pair voting proposes alignments; each is grown from two of its pairs under the joint
covariance. Its evidence is the log-likelihood ratio of its pairs less a penalty for absent
landmarks: those of one side in view of the other side but not observed by it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.association import AssociationProfile
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.gating import (
    Indices,
    Joint,
    list_pairs,
    stack_classes,
)
from teamslam.team.estimation.association.island_view import (
    IslandView,
    join_indices,
    select_comparisons,
)
from teamslam.team.estimation.association.joint_compatibility import (
    SURE_AFTER,
    Alignment,
    assign_jointly,
    grow_alignment,
)
from teamslam.team.estimation.association.verification import (
    Closure,
    ClosureTests,
    find_failed_test,
    matched_share,
    nearest_distance,
    overlap_share,
)
from teamslam.team.estimation.association.visibility import (
    Views,
    mark_visible,
    pad_views,
    renumber_views,
)
from teamslam.team.estimation.association.voting import (
    PointSet,
    Vote,
    apply_motion,
    propose_alignments,
)
from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.se2 import compose, rotation
from teamslam.team.shapes import Float

BEND = 8.0
"""Largest distortion of two maps against each other within a patch, in radii of one object."""
WEAK = 2  # an alignment with fewer votes than the best one's pairs / WEAK is no rival
EXAMINED = 120  # most examined alignments, those with the most matched points
TRIED = 8  # most grown alignments, those with the fewest absent landmarks for their matched ones
WORTH = 3.0  # approximate log-likelihood ratio of a matched point, to select the alignments to grow
SEEDS = 3  # pairs of seeds tried for each alignment
PART = 15  # number of neighbouring landmarks in a part of the patch that votes by itself
LARGE = 150  # number of landmarks from which a patch is halved into parts
TOLERANCE, REACH = 0.4, 30.0
"""Largest distance of matched points in a proposal, and of two points that vote together, in radii
of one object.
"""
NEARLY = 2.0
"""Largest standard deviation of a pair's difference in `assign_nearby`, in radii of one object."""


class Side(NamedTuple):
    """Landmarks of one side: indices in the joint Gaussian, positions and spreads.

    ids: indices in the caller's map. views: landmarks observed together. parts: groups of
    neighbours.
    """

    at: Indices
    points: PointSet
    ids: Indices
    views: Views
    parts: tuple[Indices, ...] = ()


class Placement(NamedTuple):
    """A placement of the patch on a part of the target.

    absent: number of absent landmarks. evidence: log-likelihood ratio of the pairs less their
    penalty. as_rival: the same, where a landmark beside another one is not absent, since few pairs
    are found in bent maps.
    """

    merged: Alignment
    target: Side
    motion: Float[np.ndarray, "3"]
    absent: int
    evidence: float
    as_rival: float

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Pairs by their indices in the patch and in the target's map."""
        of = dict(zip(self.target.at.tolist(), self.target.ids.tolist(), strict=True))
        return [(pair.first, of[pair.second]) for pair in self.merged.pairs]


JointOf = Callable[[Vote], tuple[Joint, Side, Vote]]
"""Return the joint Gaussian of both sides for a proposed alignment, the target's part in it, and
the alignment with the part's indices.
"""


def align(
    patch: Side,
    target: Side,
    joint_of: JointOf,
    profile: AssociationProfile,
    least: int,
    *,
    is_own: bool = False,
) -> list[Placement]:
    """Find the alignments of a patch with a target, by decreasing evidence, without those of fewer
    votes than least / WEAK.
    """
    tolerance, reach = TOLERANCE * profile.same, REACH * profile.same
    votes = propose_alignments(patch.points, target.points, tolerance, reach, patch.parts)
    votes = [vote for vote in votes[:EXAMINED] if WEAK * len(vote.first) >= least]
    votes.sort(key=lambda vote: -_estimate_evidence(vote, patch, target, profile))
    found: list[Placement] = []
    most = 0
    for vote in votes[:TRIED]:
        if WEAK * len(vote.first) < most:
            continue
        if is_own and _is_identity(patch.ids[vote.first], target.ids[vote.second]):
            most = max(most, len(vote.first))
            continue
        joint, part, vote = joint_of(vote)
        merged = _grow_alignment(patch, part, joint, vote)
        if merged is not None:
            absent, surely = _count_absent(merged, patch, part, profile)
            found.append(
                Placement(
                    merged=merged,
                    target=part,
                    motion=vote.motion,
                    absent=absent,
                    evidence=merged.llr - profile.absent * absent,
                    as_rival=merged.llr - profile.absent * surely,
                )
            )
            most = max(most, len(merged.pairs))
    return sorted(found, key=lambda each: -each.evidence)


def find_closure(
    patch: Side,
    target: Side,
    joint_of: JointOf,
    profile: AssociationProfile,
    tests: ClosureTests,
    aliases: Callable[[], Sequence[Placement]] = tuple,
) -> Closure | None:
    """Find and test the best alignment of a patch with a target; None if none has two pairs.

    aliases: returns alignments that are certainly wrong, with whose evidence a closure must
    compete.
    """
    found = align(patch, target, joint_of, profile, tests.pairs)
    if not found:
        return None
    best = found[0]
    pairs = best.pairs
    mine = set(pairs)
    others = [
        each
        for each in found[1:]
        if 2 * len(mine.intersection(each.pairs)) < len(each.merged.pairs)
    ]
    mean = best.merged.mean
    places = mean[[pair.second for pair in best.merged.pairs]]
    closure = Closure(
        pairs=tuple(
            pair._replace(first=one, second=two)
            for pair, (one, two) in zip(best.merged.pairs, pairs, strict=True)
        ),
        llr=best.merged.llr,
        absent=best.absent,
        share=matched_share(mean[patch.at], mean[best.target.at], places, profile),
        sd=max(pair.sd for pair in best.merged.pairs),
        motion=best.motion,
    )
    for rivals in (lambda: others, aliases):
        closure = _compare_with_rivals(closure, rivals())
        closure = closure._replace(why=find_failed_test(closure, profile, tests))
        if closure.why:
            break
    return closure


def _compare_with_rivals(closure: Closure, others: Sequence[Placement]) -> Closure:
    best = max(others, key=lambda each: each.as_rival, default=None)
    if best is None or best.as_rival <= closure.rival_llr:
        return closure
    return closure._replace(rival_pairs=len(best.merged.pairs), rival_llr=best.as_rival)


def _estimate_evidence(vote: Vote, patch: Side, target: Side, profile: AssociationProfile) -> float:
    local = patch.points.mean - patch.points.mean.mean(axis=0)
    sides = (apply_motion(vote.motion, local), vote.first), (target.points.mean, vote.second)
    absent, _ = _count_missing(*sides, (patch.views, target.views), profile)
    return WORTH * len(vote.first) - profile.absent * absent


def _count_absent(
    merged: Alignment, patch: Side, target: Side, profile: AssociationProfile
) -> tuple[int, int]:
    first, second = np.array([(pair.first, pair.second) for pair in merged.pairs]).T
    return _count_missing(
        (merged.mean[patch.at], np.flatnonzero(np.isin(patch.at, first))),
        (merged.mean[target.at], np.flatnonzero(np.isin(target.at, second))),
        (patch.views, target.views),
        profile,
    )


def _count_missing(
    one: tuple[Float[np.ndarray, "n 2"], Indices],
    two: tuple[Float[np.ndarray, "m 2"], Indices],
    views: tuple[Views, Views],
    profile: AssociationProfile,
) -> tuple[int, int]:
    """Return the number of absent points of two sides, and of those far from the other side.

    A side is its points and the matched indices. Points close to a matched place may be fragments
    and are not counted.
    """
    count = surely = 0
    for (points, matched), (own, theirs), seen in ((one, two, views[1]), (two, one, views[0])):
        left = np.delete(points, matched, axis=0)
        if len(left):
            left = left[nearest_distance(left, own[theirs]) >= profile.same]
        if len(left):
            left = left[mark_visible(left, own, seen)]
            count += len(left)
        if len(left):
            surely += int((nearest_distance(left, own) >= profile.same).sum())
    return count, surely


def combine_maps(patch: Joint, target: Joint, side: Side, vote: Vote) -> tuple[Joint, Side, Vote]:
    """Combine two maps in the target's frame: the joint map of the patch and the target near it.

    The motion is N(voted, diag(extent², extent², π²)) about the patch's centroid, with the larger
    map's extent.
    """
    n = len(patch.mean)
    extent = float(max(np.ptp(each.mean, axis=0).max() for each in (patch, target)))
    placed = apply_motion(vote.motion, patch.mean - patch.mean.mean(axis=0))
    away = core.hypot(*(placed[:, None] - target.mean[None]).transpose(2, 0, 1))
    near = away.min(axis=0) < BEND * patch.profile.same
    near[vote.second] = True
    nearby = np.flatnonzero(near)
    target = target.select(nearby)
    m = len(nearby)
    R = np.kron(np.eye(n), rotation(vote.motion[2]))
    lever = placed - vote.motion[:2]
    J = np.zeros((2 * n, 3))
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[0::2, 2], J[1::2, 2] = -lever[:, 1], lever[:, 0]
    covariance = np.zeros((2 * (n + m), 2 * (n + m)))
    spread = core.squared(np.array([extent, extent, np.pi]))
    covariance[: 2 * n, : 2 * n] = dense.congruent(R, patch.covariance) + dense.product(
        J * spread, J.T
    )
    covariance[2 * n :, 2 * n :] = target.covariance
    apart = np.zeros((n + m, n + m), np.bool_)
    apart[:n, :n], apart[n:, n:] = patch.apart, target.apart
    both = Joint(
        np.concatenate([placed, target.mean]),
        covariance,
        apart,
        patch.profile,
        target.density,
        classes=stack_classes([(n, patch.classes), (m, target.classes)]),
    )
    place = np.full(len(near), -1)
    place[nearby] = np.arange(m)
    part = Side(
        n + np.arange(m),
        side.points.select(nearby),
        side.ids[nearby],
        renumber_views(side.views, place),
    )
    return both, part, vote._replace(second=place[vote.second])


def _grow_alignment(patch: Side, target: Side, joint: Joint, vote: Vote) -> Alignment | None:
    first, second = patch.at[vote.first], target.at[vote.second]
    candidates = list_pairs(patch.at, target.at)
    points = patch.points.mean[vote.first]
    i, j = np.triu_indices(len(points), 1)
    far = np.argsort(-core.hypot(*(points[i] - points[j]).T), kind="stable")
    used: set[int] = set()
    best: Alignment | None = None
    for ends in np.column_stack((i, j))[far].tolist():
        if used.intersection(ends):
            continue
        used.update(ends)
        seeds = [(int(first[at]), int(second[at])) for at in ends]
        found = grow_alignment(joint, candidates, seeds, joint.profile.near)
        if found is not None and (best is None or found.llr > best.llr):
            best = found
        if len(used) >= 2 * SEEDS or (best is not None and len(best.pairs) >= len(first)):
            break
    return best


def patch_step(profile: AssociationProfile) -> int:
    """Return the number of submaps between successive patches of a stream."""
    return max(1, profile.recent // 2)


def search_island(view: IslandView, stream: Stream, last: int) -> Closure | None:
    """Search an island for a closure of a stream's submaps up to `last`; pairs are indices in the
    view.
    """
    profile = view.profile
    submaps = view.find_latest(stream, last)
    patch = _find_patch(view, submaps)
    target = _find_reachable(view, patch)
    if not len(target):
        return None
    found = assign_nearby(view, submaps[-patch_step(profile) :])
    if found is not None or min(len(patch), len(target)) < profile.closure_pairs:
        return found
    others = sorted({*range(len(view.seen_by))}.difference(submaps))
    side = _make_side(view, target, others)
    return find_closure(
        _make_patch(view, patch, submaps),
        side,
        lambda vote: (view.joint, side, vote),
        profile,
        ClosureTests(profile.closure_pairs, profile.closure_llr),
    )


def search_other_island(
    mine: IslandView, theirs: IslandView, stream: Stream, last: int
) -> Closure | None:
    """Search another island for a stream's submaps up to `last`.

    The context is not required with a verdict on a pair, or with a saved map of which most of the
    overlap is matched. Pairs are indices in the two views; the motion maps the first island's frame
    into the second's.
    """
    profile = mine.profile
    submaps = mine.find_latest(stream, last)
    patch = _find_patch(mine, submaps)
    if min(len(patch), len(theirs.ids)) < profile.island_pairs:
        return None
    own = mine.joint.select(patch)
    of_patch = _make_patch(mine, patch, submaps)._replace(at=np.arange(len(patch)))

    def target_of(view: IslandView) -> tuple[Side, JointOf]:
        at = np.flatnonzero(~view.missed)
        side, joint = _make_side(view, at, range(len(view.seen_by))), view.joint.select(at)
        return side, lambda vote: combine_maps(own, joint, side, vote)

    def aliases() -> list[Placement]:
        return align(of_patch, *target_of(mine), profile, profile.island_pairs, is_own=True)

    tests = ClosureTests(
        profile.island_pairs,
        profile.island_llr,
        profile.context,
        len(mine.ids) + len(theirs.ids),
    )
    has_saved = bool(len(mine.saved) or len(theirs.saved))
    declared = mine.find_declared(theirs)
    found = find_closure(
        of_patch,
        *target_of(theirs),
        profile,
        tests._replace(context=0.0) if has_saved or declared else tests,
        aliases,
    )
    if found is None:
        return None
    centroid = own.mean.mean(axis=0)
    found = found._replace(
        pairs=tuple(pair._replace(first=int(patch[pair.first])) for pair in found.pairs),
        motion=compose(found.motion, np.array([*-centroid, 0.0])),
    )
    if found.why or declared.intersection((pair.first, pair.second) for pair in found.pairs):
        return found
    why = find_failed_test(found, profile, tests)
    if why and has_saved:
        share = _saved_share(mine, theirs, found)
        words = f"share {share:.2f} < {profile.share:g} of the overlap with a saved map is matched"
        why = words if share < profile.share else ""
    return found._replace(why=why)


def _saved_share(mine: IslandView, theirs: IslandView, found: Closure) -> float:
    first, second = np.array([(pair.first, pair.second) for pair in found.pairs]).T
    sides = [
        (mine, apply_motion(found.motion, mine.joint.mean), first),
        (theirs, theirs.joint.mean, second),
    ]
    if not len(theirs.saved):
        sides.reverse()
    (day, others, _), (site, points, at) = sides
    places = points[at[np.isin(at, site.saved)]]
    return overlap_share(others[~day.missed], points[site.saved], places, mine.profile)


def assign_nearby(view: IslandView, submaps: Sequence[int]) -> Closure | None:
    """Find the newest of these submaps whose landmarks are assigned to others, a few metres off.

    This needs SURE_AFTER pairs, one of them with a standard deviation above `near`, the joint
    evidence of `assign_jointly`, and the share of a closure.
    """
    profile = view.profile
    most_sd = NEARLY * profile.same
    others = view.sees & ~view.missed
    others[submaps] = False
    patch = _find_patch(view, submaps)
    target = np.flatnonzero(others.any(axis=0))
    for k in reversed(submaps):
        own = np.intersect1d(view.submaps[k].unnamed, patch)
        for candidates in select_comparisons(view.joint, own, others, most_sd):
            found = assign_jointly(view.joint, *list_pairs(own, candidates), most_sd)
            sd = max((pair.sd for pair in found.pairs), default=0.0)
            if len(found.pairs) < SURE_AFTER or sd <= profile.near:
                continue
            mean = found.joint.mean
            places = mean[[pair.second for pair in found.pairs]]
            share = matched_share(mean[patch], mean[target], places, profile)
            if share < profile.share:
                continue
            return Closure(
                pairs=found.pairs,
                llr=sum(pair.llr for pair in found.pairs),
                share=share,
                sd=sd,
                motion=np.zeros(3),
            )
    return None


def _find_patch(view: IslandView, submaps: Sequence[int]) -> Indices:
    patch = join_indices(view.seen_by[k] for k in submaps)
    found: Indices = patch[~view.missed[patch]]
    return found


def _find_reachable(view: IslandView, patch: Indices) -> Indices:
    """Find the landmarks that may coincide with the patch's; none if all are certain."""
    others = np.setdiff1d(np.flatnonzero(~view.missed), patch)
    one, two = list_pairs(patch, others)
    at = view.joint.evaluate(one, two)
    fits = at.chi2 < view.profile.gate
    if not (fits & (at.sd > view.profile.near)).any():
        return others[:0]
    return np.unique(two[fits])


def _make_side(view: IslandView, at: Indices, submaps: Sequence[int]) -> Side:
    own = dense.diagonal_blocks(view.joint.covariance)[at]
    sd = np.sqrt(np.maximum(own[:, 0, 0] + own[:, 1, 1], 0.0))
    classes = view.joint.classes
    points = PointSet(
        view.joint.mean[at],
        np.minimum(sd, view.profile.tight),
        None if classes is None else classes[at],
    )
    place = np.full(len(view.ids), -1)
    place[at] = np.arange(len(at))
    seen = pad_views(each for k in submaps for each in view.submaps[k].views)
    return Side(at, points, at, renumber_views(seen, place))


def _make_patch(view: IslandView, patch: Indices, submaps: Sequence[int]) -> Side:
    parts = []
    for first in range(len(submaps)):
        part = join_indices([])
        for k in submaps[first:]:
            part = np.union1d(part, np.intersect1d(view.seen_by[k], patch))
            if len(part) >= PART:
                parts.append(np.searchsorted(patch, part))
                break
    if len(patch) >= LARGE:
        parts += _halve(view.joint.mean[patch], np.arange(len(patch)))
    return _make_side(view, patch, submaps)._replace(parts=tuple(parts))


def _halve(points: Float[np.ndarray, "n 2"], part: Indices) -> list[Indices]:
    if len(part) < 2 * PART:
        return [part]
    own = points[part]
    order = part[np.argsort(own[:, int(np.argmax(np.ptp(own, axis=0)))], kind="stable")]
    middle = len(order) // 2
    return _halve(points, np.sort(order[:middle])) + _halve(points, np.sort(order[middle:]))


def _is_identity(first: Indices, second: Indices) -> bool:
    return bool(3 * np.count_nonzero(first == second) >= len(first))
