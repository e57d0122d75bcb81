"""Fold a tick: refuse members, cut streams at seams, undo closures that later submaps contradict.

If a tick as a whole has no solution, its members are added in canonical order without those that
make the normal equations unsolvable. A refused submap is reduced to its motion; where that fails
too, the robot's chain ends. An unsolvable initial pose becomes unknown; an inter-robot measurement
is left out.

After a cut (`continuity`) the tick is folded again with the later part as a stream of its own,
without an initial pose; a submap inside which the robot was carried off is refused. For some ticks
after a closure or a merge, the matched share of the landmarks near it that both sides observed is
computed again; below the bound of the settings, these ticks are folded again without the closure.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from teamslam.team.estimation.association.gating import LandmarkDensity
from teamslam.team.estimation.association.landmark_sets import OPEN, Opened, Verdict
from teamslam.team.estimation.association.member_log import LocalLandmark
from teamslam.team.estimation.association.verification import overlap_share
from teamslam.team.estimation.contribution import (
    Contribution,
    InitialPoseFactor,
    Key,
    Stream,
    named,
    part_of,
)
from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.continuity import Seam, find_seam
from teamslam.team.estimation.map_joining.fold_association import associate_tick
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, is_solvable
from teamslam.team.estimation.map_joining.joining import (
    Audit,
    Fold,
    Tick,
    add_start,
    compact_fold,
    fold_submaps,
)

T = TypeVar("T")
SPOILT = "the robot was carried off or slipped in it"

Member = TypeVar("Member", Contribution, InterRobotFactor)


def fold_tick(fold: Fold, tick: Tick, settings: JoinSettings) -> Fold:
    """Fold one tick, and undo closures that it contradicts."""
    if tick.verdicts:
        verdicts = (*fold.landmarks.verdicts, *tick.verdicts)
        fold = replace(fold, landmarks=replace(fold.landmarks, verdicts=verdicts))
    while True:
        parts = _cut_tick(tick, fold.cuts) if fold.cuts else tick
        after = _add_members(fold, parts, settings)
        if not after.has_unnamed:
            return after
        seam = _first_seam(after, parts)
        if seam is None:
            return _audit_closures(fold, after, tick, settings)
        fold = replace(fold, cuts=(*fold.cuts, seam))


def _cut_tick(tick: Tick, cuts: Sequence[Seam]) -> Tick:
    """Assign the members of a tick to the parts of cut streams; refuse spoilt submaps."""
    submaps = cut_members(tick.contributions, cuts)
    spoilt = {each.key: SPOILT for each in submaps if _is_spoilt(each, cuts)}
    return replace(
        tick,
        contributions=submaps,
        sightings=cut_members(tick.sightings, cuts),
        outside={**tick.outside, **spoilt},
        verdicts=tuple(_cut_verdict(each, cuts) for each in tick.verdicts),
    )


def cut_members(members: Sequence[Member], cuts: Sequence[Seam]) -> list[Member]:
    """Assign submaps or inter-robot measurements to the parts of cut streams."""
    parts = [_find_part(each.stream, each.sequence, cuts) for each in members]
    return [
        each if part == each.stream else replace(each, incarnation=part[1])
        for each, part in zip(members, parts, strict=True)
    ]


def _find_part(stream: Stream, sequence: int, cuts: Sequence[Seam]) -> Stream:
    """Find the part of a stream that contains a submap."""
    for cut in cuts:
        if cut.stream == stream and sequence >= cut.after:
            stream = part_of(stream, cut.after)
    return stream


def _is_spoilt(submap: Contribution, cuts: Sequence[Seam]) -> bool:
    return any(cut.stream == submap.stream and submap.sequence > cut.before for cut in cuts)


def _cut_verdict(verdict: Verdict, cuts: Sequence[Seam]) -> Verdict:
    def cut(each: LocalLandmark) -> LocalLandmark:
        return LocalLandmark(*_find_part(each[:2], each.sequence, cuts), *each[2:])

    return verdict._replace(first=cut(verdict.first), second=cut(verdict.second))


def _first_seam(fold: Fold, tick: Tick) -> Seam | None:
    for each in tick.contributions:
        if each.key not in fold.refused:
            island = fold.islands[fold.home[each.stream]]
            seam = find_seam(island, each.stream, each.sequence)
            if seam is not None:
                return seam
    return None


def _audit_closures(fold: Fold, after: Fold, tick: Tick, settings: JoinSettings) -> Fold:
    if not after.landmarks.opened and not fold.audits:
        return after
    length = settings.association.audited
    open_ = [
        replace(audit, ticks=(*audit.ticks, tick))
        for audit in fold.audits
        if len(audit.ticks) < length
    ]
    before = compact_fold(fold)
    open_ += [Audit(opened, before, (tick,)) for opened in after.landmarks.opened]
    for audit in open_:
        share = share_now(after, audit.opened)
        if share is not None and share < settings.association.undone_below:
            return _undo_closure(audit, after, share, settings)
    return replace(after, audits=tuple(open_))


def _undo_closure(audit: Audit, after: Fold, share: float, settings: JoinSettings) -> Fold:
    opened = audit.opened
    words = f"share {share:.2f} < {settings.association.undone_below:g} after {len(audit.ticks)}"
    stamp_ns = max((each.end_ns for each in after.contributions[-1:]), default=0)
    undone = opened.decision._replace(
        stamp_ns=stamp_ns, kind="undone", share=share, why=f"{words} ticks"
    )
    landmarks = audit.before.landmarks.add_decisions(opened.decision, undone)
    landmarks = replace(landmarks, undone=(*landmarks.undone, opened))
    fold = replace(audit.before, landmarks=landmarks)
    for tick in audit.ticks:
        fold = fold_tick(fold, replace(tick, verdicts=()), settings)
    return fold


def share_now(fold: Fold, opened: Opened) -> float | None:
    """Compute the matched share of the landmarks near a closure; None without any."""
    places = {fold.landmarks.identity(one) for one, _ in opened.pairs}
    if not places:
        return None
    island = fold.islands[fold.home[opened.newer[0][0]]]
    graph, margin = island.graph, island.settings.association.recent
    newer = {stream: (first, last) for stream, first, last in opened.newer}
    sides = np.zeros((2, len(graph.fixed)), np.bool_)
    for submap in graph.observed:
        of = submap.observation
        first, last = newer.get(of.stream, (OPEN, -OPEN))
        if first <= of.sequence <= last:
            sides[0, submap.known] = True
        elif not first - margin <= of.sequence <= last + margin:
            sides[1, submap.known] = True
    known = [graph.landmarks[id_] for id_ in sorted(graph.landmarks)]
    both = [node for node in known if sides[:, node].all()]
    at = island.points(both)
    if not len(at):
        return None
    one, two = (island.points([node for node in known if side[node]]) for side in sides)
    around = LandmarkDensity(each.observation.spacings for each in graph.observed)
    return overlap_share(one, two, at, around.limit_lengths(island.settings.association))


def _add_members(fold: Fold, tick: Tick, settings: JoinSettings) -> Fold:
    """Add the tick's members; record exceptions in `refused`, `motion_only`, `left_out`,
    `set_aside`.
    """
    fold = replace(fold, set_aside=(*fold.set_aside, *tick.set_aside))
    fold, members = _select_reachable(fold, tick.contributions, tick.outside)
    streams = {each.stream for each in members}
    starts = [start for start in tick.starts if start.stream in streams]
    sightings = _of_members(tick.sightings, fold)
    whole = _attempt(fold, members, starts, sightings, settings)
    if whole is not None:
        return whole
    selection = _Selection(fold, settings, {start.stream: start for start in starts})
    return selection.add_solvable(members, sightings)


def describe_refusals(fold: Fold) -> list[str]:
    """Describe where each chain ended and how many submaps follow, then other refusals."""
    ended: dict[Stream, list[int]] = {}
    for _, robot, incarnation, sequence in fold.refused:
        ended.setdefault((robot, incarnation), []).append(sequence)
    words = []
    for stream in sorted(ended):
        first, behind = min(ended[stream]), len(ended[stream]) - 1
        why = next(w for k, w in fold.refused.items() if (*k[1:3], k[3]) == (*stream, first))
        tail = f"; the {behind} behind it are not in the map either" if behind else ""
        words.append(f"submap {first} of {named(stream)} refused: {why}{tail}")
    return [*words, *fold.set_aside]


def _select_reachable(
    fold: Fold, contributions: Sequence[Contribution], outside: Mapping[Key, str]
) -> tuple[Fold, list[Contribution]]:
    refused = dict(fold.refused)
    ended = {(robot, incarnation) for _, robot, incarnation, _ in refused}
    members = []
    for each in contributions:
        why = "the chain ended before it" if each.stream in ended else outside.get(each.key)
        if why is None:
            members.append(each)
        else:
            refused[each.key] = why
            ended.add(each.stream)
    return replace(fold, refused=refused), members


def _of_members(sightings: Iterable[InterRobotFactor], fold: Fold) -> list[InterRobotFactor]:
    gone = {key[1:] for key in fold.refused}
    return [each for each in sightings if (*each.stream, each.sequence) not in gone]


def _attempt(
    fold: Fold,
    members: Sequence[Contribution],
    starts: Iterable[InitialPoseFactor],
    sightings: Sequence[InterRobotFactor],
    settings: JoinSettings,
) -> Fold | None:
    for start in starts:
        fold = add_start(fold, start)
    try:
        with np.errstate(all="ignore"):
            after = fold_submaps(fold, members, settings, sightings)
            if after.has_unnamed:
                after = associate_tick(after, members)
    except UNSOLVABLE:
        return None
    changed = (
        island
        for key, island in after.islands.items()
        if key not in fold.islands or island.state is not fold.islands[key].state
    )
    return after if all(is_solvable(island) for island in changed) else None


class _Selection:
    """Selection of a tick's solvable members, one by one in canonical order."""

    def __init__(
        self, fold: Fold, settings: JoinSettings, starts: Mapping[Stream, InitialPoseFactor]
    ) -> None:
        self._fold = fold
        self._settings = settings
        self._starts = dict(starts)
        self._members: list[Contribution] = []
        self._refused = dict(fold.refused)
        self._motion_only = set(fold.motion_only)
        self._set_aside = list(fold.set_aside)

    def add_solvable(
        self, members: Sequence[Contribution], sightings: Sequence[InterRobotFactor]
    ) -> Fold:
        unseen = replace(self._fold, waiting=())
        self._grow(unseen, members)
        base = replace(
            unseen,
            refused=dict(sorted(self._refused.items())),
            motion_only=frozenset(self._motion_only),
        )
        waiting = [*self._fold.waiting, *_of_members(sightings, base)]
        candidates = sorted(waiting, key=lambda each: each.key)

        def after(some: Sequence[InterRobotFactor]) -> Fold | None:
            return _attempt(base, self._members, self._of(self._members), some, self._settings)

        accepted, bad = _select_greatest(candidates, lambda some: after(some) is not None)
        self._set_aside += [
            f"an inter-robot measurement of {each.teammate} by {named(each.stream)} at "
            f"{each.stamp_ns * 1e-9:.1f} s refused: with it the map has no solution"
            for each in bad
        ]
        found = after(accepted)
        if found is None:  # none of the members: the fold as it was, with its measurements
            found = replace(base, waiting=tuple(accepted))
        left_out = self._fold.left_out.union(each.key for each in bad)
        return replace(found, left_out=left_out, set_aside=tuple(self._set_aside))

    def _of(self, members: Sequence[Contribution]) -> list[InitialPoseFactor]:
        streams = {each.stream for each in members}
        return [start for stream, start in self._starts.items() if stream in streams]

    def _solves(self, fold: Fold, members: Sequence[Contribution]) -> bool:
        return _attempt(fold, members, self._of(members), (), self._settings) is not None

    def _grow(self, fold: Fold, block: Sequence[Contribution]) -> None:
        """Add a block of submaps, or its halves, or refuse a single submap."""
        ended = {(robot, incarnation) for _, robot, incarnation, _ in self._refused}
        for each in block:
            if each.stream in ended:
                self._refused[each.key] = "the chain ended before it"
        block = [each for each in block if each.stream not in ended]
        if not block:
            return
        if self._solves(fold, [*self._members, *block]):
            self._members += block
        elif len(block) > 1:
            half = len(block) // 2
            self._grow(fold, block[:half])
            self._grow(fold, block[half:])
        else:
            self._grow_by_less(fold, block[0])

    def _grow_by_less(self, fold: Fold, whole: Contribution) -> None:
        """Add a submap without its initial pose, its motion alone, or none."""
        start = self._starts.pop(whole.stream, None) if whole.sequence == 0 else None
        if start is not None and self._solves(fold, [*self._members, whole]):
            self._members.append(whole)
            self._set_aside.append(
                f"the initial pose of {named(whole.stream)} refused, taken as unknown: "
                "with it the map has no solution"
            )
            return
        if start is not None:
            self._starts[whole.stream] = start
        motion = replace(whole, local=whole.local.motion)
        if self._solves(fold, [*self._members, motion]):
            self._members.append(motion)
            self._motion_only.add(whole.key)
            self._set_aside.append(
                f"of submap {whole.sequence} of {named(whole.stream)} only the motion is in the "
                "map: with its landmarks it has no solution"
            )
            return
        self._refused[whole.key] = "with it the map has no solution"


def _select_greatest(
    items: Sequence[T], works: Callable[[Sequence[T]], bool]
) -> tuple[list[T], list[T]]:
    accepted: list[T] = []
    bad: list[T] = []

    def add(block: Sequence[T]) -> None:
        if not block or works([*accepted, *block]):
            accepted.extend(block)
        elif len(block) == 1:
            bad.extend(block)
        else:
            half = len(block) // 2
            add(block[:half])
            add(block[half:])

    add(items)
    return accepted, bad
