"""Closures and merges by map matching: finds a robot's last submaps elsewhere in the map.

A patch, the landmarks of a stream's last submaps, is compared with the rest of its island, and with
every other island, in which its place is unknown. An alignment that passes all tests merges the
landmarks (and the islands); one that fails is deferred, and its record names the test that failed.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from team.association import AssociationProfile
from team.estimation.contribution import Contribution, Stream
from team.estimation.geometry import compose, inverse
from team.estimation.map_joining.assigning import assigned
from team.estimation.map_joining.associating import IslandView, applied, associated, union
from team.estimation.map_joining.association.absence import renumbered, rows
from team.estimation.map_joining.association.closing import (
    Closure,
    Placement,
    Side,
    Tests,
    aligned,
    closure,
    free_joint,
)
from team.estimation.map_joining.association.growing import (
    Indices,
    Joint,
    Pair,
    likelihoods,
)
from team.estimation.map_joining.association.landmarks import (
    OPEN,
    Decision,
    Landmarks,
    LocalLandmark,
    MergeRecord,
    Opened,
    between,
    united,
)
from team.estimation.map_joining.association.voting import PointSet, Vote
from team.estimation.map_joining.gauss_newton import UNSOLVABLE, is_solvable, settled
from team.estimation.map_joining.joining import Fold, merged_islands
from team.estimation.map_joining.merging import Merge, placed
from team.estimation.map_joining.minima import minimum
from team.estimation.map_joining.submap_graph import tied

PART = 15
"""Number of neighbouring landmarks in a part of the patch that votes for an alignment of its
own.
"""


def recognised(fold: Fold, contributions: Sequence[Contribution]) -> Fold:
    """The fold after data association of a tick's submaps; unchanged where no landmark is
    unnamed.
    """
    if not fold.landmarks.are_there:
        return fold
    fold = replace(fold, landmarks=replace(fold.landmarks, opened=()))
    return matched(associated(fold, contributions), contributions)


def matched(fold: Fold, contributions: Sequence[Contribution]) -> Fold:
    """The fold after the closures and the merges that a tick's submaps make possible."""
    last: dict[Stream, int] = {}
    for each in contributions:
        if len(each.local.unnamed.counts):
            last[each.stream] = each.sequence
    views = IslandViews()
    for stream in sorted(last):
        fold = _closed(fold, stream, last[stream], views)
    for stream in sorted(last):
        for key in sorted(fold.islands):
            if key in fold.islands and key != fold.home[stream]:
                fold = _joined(fold, stream, last[stream], key, views)
    return fold


class IslandViews:
    """The views of the islands, each computed once for as long as its island does not change."""

    def __init__(self) -> None:
        self._of: dict[Stream, IslandView] = {}

    def of(self, fold: Fold, key: Stream) -> IslandView:
        """The view of the island with this key."""
        known = self._of.get(key)
        if known is None or known.island is not fold.islands[key]:
            known = self._of[key] = IslandView(fold.islands[key], fold.landmarks)
        return known


def _patch(view: IslandView, stream: Stream, last: int) -> list[int]:
    """Indices in the graph of the stream's submaps up to `last` that make up the patch."""
    first = last - view.profile.recent
    return [
        k
        for k, submap in enumerate(view.island.graph.observed)
        if submap.observation.stream == stream and first < submap.observation.sequence <= last
    ]


def _closed(fold: Fold, stream: Stream, last: int, views: IslandViews) -> Fold:
    """The fold with a closure of the stream's last submaps inside their island, if there is one."""
    key = fold.home[stream]
    view = views.of(fold, key)
    profile = view.profile
    submaps = _patch(view, stream, last)
    patch = union(view.seen_by[k] for k in submaps)
    target = _reachable(view, patch)
    found = assigned(view, submaps[-_step(fold, key) :]) if len(target) else None
    if found is None and min(len(patch), len(target)) >= profile.closure_pairs:
        others = sorted({*range(len(view.seen_by))}.difference(submaps))
        sides = _patch_side(view, patch, submaps), _side(view, target, others)
        found = closure(
            *sides,
            lambda _: (view.joint, sides[1]),
            profile,
            Tests(profile.closure_pairs, profile.closure_llr),
        )
    if found is None:
        return fold
    pairs = [(view.ids[pair.first], view.ids[pair.second]) for pair in found.pairs]
    found = _not_undone(found, fold.landmarks, pairs)
    decision = _decision(view, found, "waits" if found.why else "closure", between(stream, stream))
    if found.why:
        return _waiting(fold, (stream, stream), decision)
    newest = fold.next_sequence(stream) - 1
    newer = ((stream, last - profile.recent + 1, OPEN if last == newest else last),)
    fold = _opened(fold, Opened(decision, _by_members(fold.landmarks, pairs), newer))
    return _made(fold, key, view, found, decision)


def _not_undone(found: Closure, landmarks: Landmarks, pairs: Sequence[tuple[int, int]]) -> Closure:
    """Rejects a closure that was undone before; returns every other one as it is."""
    if found.why or not landmarks.was_undone(pairs):
        return found
    return found._replace(why="it was undone before")


def _waiting(fold: Fold, of: tuple[Stream, Stream], decision: Decision) -> Fold:
    waits = {**fold.landmarks.waits, of: decision}
    return replace(fold, landmarks=replace(fold.landmarks, waits=waits))


def _opened(fold: Fold, opened: Opened) -> Fold:
    """The fold with a closure that is to be audited; its deferred decisions are removed."""
    waits = {
        of: each for of, each in fold.landmarks.waits.items() if each.about != opened.decision.about
    }
    landmarks = replace(fold.landmarks, waits=waits, opened=(*fold.landmarks.opened, opened))
    return replace(fold, landmarks=landmarks)


def _by_members(
    landmarks: Landmarks, pairs: Sequence[tuple[int, int]]
) -> tuple[tuple[LocalLandmark, LocalLandmark], ...]:
    """Pairs of landmarks by their smallest members; pairs with one named landmark are left out."""
    of = landmarks.present
    return tuple(
        (of[one].first.name, of[two].first.name) for one, two in pairs if one in of and two in of
    )


def _reachable(view: IslandView, patch: Indices) -> Indices:
    """Landmarks with which those of the patch may coincide by the joint covariance; empty where all
    are well known.

    An alignment with any other landmark is no rival: `grow` would reject its seeds.
    """
    others = np.setdiff1d(np.arange(len(view.ids)), patch)
    one, two = (each.ravel() for each in np.meshgrid(patch, others, indexing="ij"))
    at = likelihoods(view.joint, one, two, view.profile)
    fits = at.chi2 < view.profile.gate
    if not (fits & (at.sd > view.profile.near)).any():
        return others[:0]
    return np.unique(two[fits])


def _made(fold: Fold, key: Stream, view: IslandView, found: Closure, decision: Decision) -> Fold:
    """The fold with a closure, solved anew, and with nearby landmarks merged afterwards."""
    view.take(found.pairs, view.joint, decision.kind)
    fold = applied(fold, key, view)
    fold = replace(fold, landmarks=fold.landmarks.decided(decision))
    return _tidied(_solved(fold, key), key)


def _solved(fold: Fold, key: Stream) -> Fold:
    island, iterations, change = settled(fold.islands[key])
    islands = {**fold.islands, key: island}
    return replace(fold, islands=islands, iterations=iterations, change=change)


def _tidied(fold: Fold, key: Stream) -> Fold:
    """Merges the landmarks that a closure has brought close to each other: all against all."""
    view = IslandView(fold.islands[key], fold.landmarks)
    everything = np.arange(len(view.ids))
    view.step("near", everything, everything, view.profile.near)
    view.sweep()
    return applied(fold, key, view)


def _side(view: IslandView, at: Indices, submaps: Sequence[int]) -> Side:
    """Landmarks of an island, with the observations of them by keyframes of some of its submaps."""
    P = view.joint.covariance.reshape(len(view.ids), 2, len(view.ids), 2)
    own = P[at, :, at]
    sd = np.sqrt(np.maximum(own[:, 0, 0] + own[:, 1, 1], 0.0))
    points = PointSet(view.joint.mean[at], np.minimum(sd, view.profile.tight))
    place = np.full(len(view.ids), -1)
    place[at] = np.arange(len(at))
    seen = rows(each for k in submaps for each in view.views(k))
    return Side(at, points, at, np.arange(len(at)), renumbered(seen, place))


def _patch_side(view: IslandView, patch: Indices, submaps: Sequence[int]) -> Side:
    """A patch of at least PART landmarks where possible: those of its submaps from the last one
    backwards.
    """
    parts = []
    for first in range(len(submaps)):
        part = union([])
        for k in submaps[first:]:
            part = np.union1d(part, view.seen_by[k])
            if len(part) >= PART:
                parts.append(np.searchsorted(patch, part))
                break
    return _side(view, patch, submaps)._replace(parts=tuple(parts))


def _decision(view: IslandView, found: Closure, kind: str, about: str) -> Decision:
    return Decision(
        stamp_ns=view.stamp_ns,
        kind=kind,
        about=about,
        pairs=len(found.pairs),
        llr=found.llr,
        rival_pairs=found.rival_pairs,
        rival_llr=found.rival_llr,
        share=found.share,
        sd=found.sd,
        why=found.why,
        absent=found.absent,
    )


def _joined(fold: Fold, stream: Stream, last: int, other_key: Stream, views: IslandViews) -> Fold:
    """Merges the stream's island with another one, if the stream's last submaps are found there."""
    key = fold.home[stream]
    mine, theirs = (views.of(fold, at) for at in (key, other_key))
    profile = mine.profile
    submaps = _patch(mine, stream, last)
    patch = union(mine.seen_by[k] for k in submaps)
    if min(len(patch), len(theirs.ids)) < profile.island_pairs:
        return fold
    n = len(patch)
    own = Joint(
        mine.joint.mean[patch],
        mine.joint.covariance.reshape(len(mine.ids), 2, -1, 2)[patch][:, :, patch].reshape(
            2 * n, 2 * n
        ),
        mine.joint.apart[np.ix_(patch, patch)],
        mine.joint.crowd,
    )
    of_patch = _patch_side(mine, patch, submaps)._replace(at=np.arange(n))

    def laid_on(view: IslandView) -> tuple[Side, Callable[[Vote], tuple[Joint, Side]]]:
        side = _side(view, np.arange(len(view.ids)), range(len(view.seen_by)))
        return side, lambda vote: free_joint(own, view.joint, side, vote, profile)

    def aliases() -> list[Placement]:
        found = aligned(of_patch, *laid_on(mine), profile)
        return [each for each in found if not _is_identity(each, patch)]

    known = len(mine.ids) + len(theirs.ids)
    found = closure(
        of_patch,
        *laid_on(theirs),
        profile,
        Tests(profile.island_pairs, profile.island_llr, profile.context, known),
        aliases,
    )
    if found is None:
        return fold
    about = between(min(mine.island.graph.streams), min(theirs.island.graph.streams))
    pairs = [
        pair._replace(first=int(patch[pair.first]), second=pair.second) for pair in found.pairs
    ]
    named = [(mine.ids[pair.first], theirs.ids[pair.second]) for pair in pairs]
    found = _not_undone(found, fold.landmarks, named)
    decision = _decision(mine, found, "waits" if found.why else "merge", about)
    if found.why:
        return _waiting(fold, (stream, other_key), decision)
    newer = tuple((each, 0, OPEN) for each in sorted(mine.island.graph.streams))
    fold = _opened(fold, Opened(decision, _by_members(fold.landmarks, named), newer))
    centroid = own.mean.mean(axis=0)
    their_from_mine = compose(found.motion, np.array([*-centroid, 0.0]))
    return _merged(fold, (key, mine), (other_key, theirs), pairs, their_from_mine, decision)


def _is_identity(found: Placement, patch: Indices) -> bool:
    """Whether an alignment of a patch with its own map places a third of its landmarks on
    themselves.
    """
    of = dict(zip(found.there.at.tolist(), found.there.names.tolist(), strict=True))
    pairs = found.grown.pairs
    same = sum(of[pair.second] == int(patch[pair.first]) for pair in pairs)
    return bool(3 * same >= len(pairs))


def _merged(
    fold: Fold,
    one: tuple[Stream, IslandView],
    two: tuple[Stream, IslandView],
    pairs: Sequence[Pair],
    two_from_one: Float[np.ndarray, "3"],
    decision: Decision,
) -> Fold:
    """Two islands as one, in the team's frame if one of them has it, else in that of the smallest
    stream.
    """
    (key, mine), (other_key, theirs) = one, two
    landmarks, becomes = united(
        fold.landmarks,
        [
            (
                mine.ids[pair.first],
                MergeRecord(
                    "merge", theirs.ids[pair.second], pair.llr, pair.rival, pair.sd, mine.stamp_ns
                ),
            )
            for pair in pairs
        ],
    )
    renamed = {}
    for at, view in (one, two):
        graph, state = tied(view.island.graph, view.island.state, becomes)
        renamed[at] = replace(view.island, graph=graph, state=state)
    stays, goes = sorted(
        (key, other_key), key=lambda at: (at != fold.main_key, min(renamed[at].graph.streams))
    )
    if renamed[goes].graph.condensed is not None:
        return fold  # its factor is linearised in a frame of its own
    place = two_from_one if stays == other_key else inverse(two_from_one)
    both, waiting = placed(renamed[stays], renamed[goes], place, fold.waiting)
    try:
        best = minimum(both)
    except UNSOLVABLE:
        return fold
    if not is_solvable(best.island):
        return fold
    words = (
        f"{decision.pairs} landmarks that both show, log-likelihood ratio "
        f"{decision.llr:.0f} against {decision.rival_llr:.0f}, share "
        f"{decision.share:.2f}, {decision.absent} absent"
    )
    fold = replace(fold, landmarks=landmarks.decided(decision))
    streams = sorted(renamed[goes].graph.streams)
    fold = merged_islands(fold, stays, goes, Merge(best, waiting, words))
    fold = _tidied(fold, stays)
    views = IslandViews()
    for stream in streams:
        for last in range(fold.next_sequence(stream) - 1, -1, -_step(fold, stays)):
            fold = _closed(fold, stream, last, views)
    return fold


def _step(fold: Fold, key: Stream) -> int:
    profile: AssociationProfile = fold.islands[key].settings.association
    return max(1, profile.recent // 2)
