"""Fold a tick, cut streams at seams, and undo closures that later submaps contradict.

After a cut (`continuity`) the tick is folded again with the later part as an island. For some ticks
after a closure or a merge, the matched share of the landmarks near it that both sides observed is
computed again; below the bound of the settings, these ticks are folded again without the closure.
The outcome depends on the set of submaps alone.
"""

from dataclasses import replace

import numpy as np

from teamslam.team.estimation.association.density import LandmarkDensity
from teamslam.team.estimation.association.landmark_sets import OPEN, Opened
from teamslam.team.estimation.association.verification import overlap_share
from teamslam.team.estimation.map_joining.continuity import Seam, find_seam
from teamslam.team.estimation.map_joining.cutting import cut_tick
from teamslam.team.estimation.map_joining.gauss_newton import Island, JoinSettings
from teamslam.team.estimation.map_joining.joining import Audit, Fold, Tick, compact_fold
from teamslam.team.estimation.map_joining.refusal import add_members


def fold_tick(fold: Fold, tick: Tick, settings: JoinSettings) -> Fold:
    """Fold one tick, and undo closures that it contradicts."""
    if tick.verdicts:
        verdicts = (*fold.landmarks.verdicts, *tick.verdicts)
        fold = replace(fold, landmarks=replace(fold.landmarks, verdicts=verdicts))
    while True:
        parts = cut_tick(tick, fold.cuts) if fold.cuts else tick
        after = add_members(fold, parts, settings)
        if not after.has_unnamed:
            return after
        seam = _first_seam(after, parts)
        if seam is None:
            return _audit_closures(fold, after, tick, settings)
        fold = replace(fold, cuts=(*fold.cuts, seam))


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
    """Compute the matched share of the landmarks near a closure."""
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
    at = _points(island, both)
    if not len(at):
        return None
    one, two = (_points(island, [node for node in known if side[node]]) for side in sides)
    around = LandmarkDensity(each.observation.spacings for each in graph.observed)
    return overlap_share(one, two, at, around.limit_lengths(island.settings.association))


def _points(island: Island, nodes: list[int]) -> np.ndarray:
    at = island.graph.offset[nodes]
    return np.column_stack([island.state[at], island.state[at + 1]])
