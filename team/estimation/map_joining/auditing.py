"""Fold a tick, cut streams at seams, and undo closures that later submaps contradict.

After a cut (`continuity`) the tick is folded again with the later part as a stream of its own,
without an initial pose; a submap inside which the robot was carried off is refused. For some ticks
after a closure or a merge, the matched share of the landmarks near it that both sides observed is
computed again; below the bound of the settings, these ticks are folded again without the closure.
The outcome depends on the set of submaps alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from teamslam.team.estimation.association.gating import LandmarkDensity
from teamslam.team.estimation.association.landmark_sets import OPEN, Opened, Verdict
from teamslam.team.estimation.association.member_log import LocalLandmark
from teamslam.team.estimation.association.verification import overlap_share
from teamslam.team.estimation.contribution import Contribution, Stream, part_of
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.continuity import Seam, find_seam
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import Audit, Fold, Tick, compact_fold
from teamslam.team.estimation.map_joining.refusal import add_members

SPOILT = "the robot was carried off or slipped in it"

Member = TypeVar("Member", Contribution, InterRobotFactor)


def fold_tick(fold: Fold, tick: Tick, settings: JoinSettings) -> Fold:
    """Fold one tick, and undo closures that it contradicts."""
    if tick.verdicts:
        verdicts = (*fold.landmarks.verdicts, *tick.verdicts)
        fold = replace(fold, landmarks=replace(fold.landmarks, verdicts=verdicts))
    while True:
        parts = _cut_tick(tick, fold.cuts) if fold.cuts else tick
        after = add_members(fold, parts, settings)
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
