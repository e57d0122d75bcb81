"""Apply data association (`team.estimation.association`) to the fold: merges, closures, islands."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.closure import (
    patch_step,
    search_island,
    search_other_island,
)
from teamslam.team.estimation.association.gating import list_pairs
from teamslam.team.estimation.association.island_view import IslandView, ViewedSubmap
from teamslam.team.estimation.association.joint_compatibility import MergedPairs
from teamslam.team.estimation.association.landmark_sets import (
    OPEN,
    Decision,
    Landmarks,
    Opened,
    merge_sets,
    name_sides,
)
from teamslam.team.estimation.association.member_log import LocalLandmark, MergeRecord
from teamslam.team.estimation.association.verification import Closure, is_ambiguous
from teamslam.team.estimation.contribution import (
    Contribution,
    Stream,
    first_of,
    is_absolute,
    is_map,
)
from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.map_joining.absence import absences
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    is_solvable,
    iterate_tick,
    joint_marginal,
    solve_island,
)
from teamslam.team.estimation.map_joining.joining import (
    Fold,
    merge_islands,
    precedence,
    separate_moved,
)
from teamslam.team.estimation.map_joining.merging import Merge, place_island
from teamslam.team.estimation.map_joining.saved_maps import (
    FALSE_ALARM,
    LEAST_SUBMAPS,
    SEQUENTIAL,
    maps_of,
    separate,
)
from teamslam.team.estimation.map_joining.submap_graph import tie_landmarks
from teamslam.team.estimation.se2 import inverse
from teamslam.team.shapes import Float

AMBIGUITY_GROWTH = 1.25
"""Growth in submaps of two islands after which an ambiguous attempt is repeated."""


def associate_tick(fold: Fold, contributions: Sequence[Contribution]) -> Fold:
    """Associate the unnamed landmarks of a tick's submaps."""
    fold = replace(fold, landmarks=replace(fold.landmarks, opened=()))
    arrived: dict[Stream, list[Contribution]] = {}
    for contribution in contributions:
        arrived.setdefault(fold.home[contribution.stream], []).append(contribution)
    for key in sorted(arrived):
        fold = _track_island(fold, key, arrived[key])
    last: dict[Stream, int] = {}
    for each in contributions:
        if len(each.local.unnamed.counts):
            last[each.stream] = each.sequence
    views = _IslandViews()
    for stream in sorted(last):
        fold = _close_loop(fold, stream, last[stream], views)
    for stream in sorted(last):
        for key in sorted(fold.islands):
            if key in fold.islands and key != fold.home[stream]:
                fold = _join_island(fold, stream, last[stream], key, views)
    return separate_moved(fold, SEQUENTIAL, contributions) if fold.has_maps else fold


def view_island(island: Island, landmarks: Landmarks) -> IslandView:
    """View landmarks as a joint Gaussian, in the order of their nodes."""
    graph = island.graph
    ordered = sorted(graph.landmarks.items(), key=lambda each: each[1])
    nodes = np.array([node for _, node in ordered], np.int64)
    place = np.full(len(graph.fixed) + 1, -1, np.int64)  # the last is that of a dropped landmark
    place[nodes] = np.arange(len(nodes))
    mean, covariance = joint_marginal(island, nodes.tolist())
    return IslandView(
        ids=[id_ for id_, _ in ordered],
        mean=mean.reshape(-1, 2),
        covariance=covariance,
        submaps=[ViewedSubmap(each.observation, place[each.landmarks]) for each in graph.observed],
        forgotten=(place[graph.memory.pairs], graph.memory.distinct),
        landmarks=landmarks,
        profile=island.settings.association,
        stamp_ns=max((each.contribution.end_ns for each in graph.submaps), default=0),
    )


def recognise_moved(fold: Fold) -> Fold:
    """Give unnamed landmarks that have moved since a saved map the number of their former place.

    A landmark of the map that fewer than LEAST_SUBMAPS submaps of today observe, although more were
    due (`absences`), and one of today that LEAST_SUBMAPS observe, are one if no other landmark of
    either kind is within the gate of either: where all landmarks are known by their places, a
    displacement within the gate is likelier than a loss and an arrival. The map's place becomes the
    former one.
    """
    for key in sorted(fold.islands):
        if fold.islands[key].graph.condensed is None:
            fold = _recognise_in(fold, key)
    return fold


def _recognise_in(fold: Fold, key: Stream) -> Fold:
    island = fold.islands[key]
    maps = [each for each in maps_of(island.graph) if not is_absolute(each.contribution.stream)]
    if not maps or not fold.has_unnamed:
        return fold
    view = view_island(island, fold.landmarks)
    own = np.array([not is_map(each.observation.stream) for each in view.submaps], np.bool_)
    today, judged = view.sees[own].sum(axis=0), fold.landmarks.judged()
    free = np.array([id_ >= UNNAMED and id_ not in judged for id_ in view.ids], np.bool_)
    saved = np.zeros(len(view.ids), np.bool_)
    saved[view.saved] = True
    old = np.flatnonzero(free & saved & (today < LEAST_SUBMAPS))
    new = np.flatnonzero(free & ~saved & (today >= LEAST_SUBMAPS))
    places = absences(island, view.joint.mean[old]) if len(old) and len(new) else []
    old = old[np.array([each.chance < FALSE_ALARM for each in places], np.bool_)] if places else old
    if not len(old) or not len(new):
        return fold
    one, two, sds = view.joint.gate(*list_pairs(new, old))
    for first, second, sd in zip(one.tolist(), two.tolist(), sds.tolist(), strict=True):
        number, before = view.ids[first], view.ids[second]
        of = [s.contribution.stream for s in maps if island.graph.landmarks[before] in s.landmarks]
        if len(of) == 1 and (one == first).sum() == (two == second).sum() == 1:
            tie = MergeRecord("near", before, 0.0, 0.0, sd, view.stamp_ns)
            fold = _give_former_place(fold, key, of[0], number, tie)
    return fold


def _give_former_place(
    fold: Fold, key: Stream, stream: Stream, number: int, tie: MergeRecord
) -> Fold:
    """Make a saved map's place of the landmark `tie.into` the former place of another landmark."""
    island = fold.islands[key]
    saved = next(each for each in maps_of(island.graph) if each.contribution.stream == stream)
    place = int(island.graph.offset[island.graph.landmarks[number]])
    apart = separate(island, saved, [tie.into])
    if tie.into in apart.graph.landmarks:
        at = int(apart.graph.offset[apart.graph.landmarks[tie.into]])
        values = apart.state.copy()
        values[at : at + 2] = values[place : place + 2]
        apart = replace(apart, state=values)
    landmarks, becomes = merge_sets(fold.landmarks, [(number, tie)])
    graph, state = tie_landmarks(apart.graph, apart.state, becomes)
    former = dict(graph.former)
    former[stream, becomes.get(tie.into, tie.into)] = former.pop((stream, tie.into))
    island = replace(apart, graph=replace(graph, former=former), state=state)
    return replace(fold, islands={**fold.islands, key: island}, landmarks=landmarks)


class _IslandViews:
    """Views of the islands, cached while an island does not change."""

    def __init__(self) -> None:
        self._of: dict[Stream, tuple[Island, IslandView]] = {}

    def view(self, fold: Fold, key: Stream) -> IslandView:
        island = fold.islands[key]
        known = self._of.get(key)
        if known is None or known[0] is not island:
            known = self._of[key] = island, view_island(island, fold.landmarks)
        return known[1]


def _track_island(fold: Fold, key: Stream, arrived: Sequence[Contribution]) -> Fold:
    view = view_island(fold.islands[key], fold.landmarks)
    order = {each.observation[:2]: k for k, each in enumerate(view.submaps)}
    present = [
        (k, each) for each in arrived if (k := order.get((each.stream, each.sequence))) is not None
    ]
    view.apply_verdicts()
    for k, contribution in present:
        if len(contribution.local.unnamed.counts):
            view.track(k)
    view.compare_again([k for k, _ in present], turn=fold.islands[key].graph.size)
    view.sweep()
    return _apply_merges(fold, key, view)


def _apply_merges(fold: Fold, key: Stream, view: IslandView) -> Fold:
    if not view.ties:
        return fold
    landmarks, becomes = merge_sets(fold.landmarks, view.ties)
    islands = dict(fold.islands)
    for at, island in fold.islands.items():
        if at != key and not any(id_ in becomes for id_ in island.graph.landmarks):
            continue
        graph, state = tie_landmarks(island.graph, island.state, becomes)
        islands[at] = iterate_tick(replace(island, graph=graph, state=state))
    return replace(fold, islands=islands, landmarks=landmarks)


def _close_loop(fold: Fold, stream: Stream, last: int, views: _IslandViews) -> Fold:
    key = fold.home[stream]
    view = views.view(fold, key)
    found = search_island(view, stream, last)
    if found is None:
        return fold
    pairs = [(view.ids[pair.first], view.ids[pair.second]) for pair in found.pairs]
    end = OPEN if last == fold.next_sequence(stream) - 1 else last
    newer = ((stream, last - view.profile.recent + 1, end),)
    decision = _decide(fold, view, found, pairs, "closure", (stream, stream))
    fold = _record(fold, decision, pairs, newer, (stream, stream))
    if decision.why:
        return fold
    view.record_merges(MergedPairs(found.pairs, view.joint), "closure")
    fold = _apply_merges(fold, key, view)
    fold = replace(fold, landmarks=fold.landmarks.add_decisions(decision))
    island, *_ = solve_island(fold.islands[key])
    return _merge_near(replace(fold, islands={**fold.islands, key: island}), key)


def _join_island(
    fold: Fold, stream: Stream, last: int, other_key: Stream, views: _IslandViews
) -> Fold:
    key = fold.home[stream]
    size = fold.islands[key].graph.size + fold.islands[other_key].graph.size
    if size < AMBIGUITY_GROWTH * fold.ambiguous.get((stream, other_key), 0):
        return fold
    mine, theirs = views.view(fold, key), views.view(fold, other_key)
    found = search_other_island(mine, theirs, stream, last)
    if found is None:
        return fold
    if found.why and is_ambiguous(found, mine.profile):
        fold = replace(fold, ambiguous={**fold.ambiguous, (stream, other_key): size})
    streams = sorted(fold.islands[key].graph.streams)
    sides = streams[0], min(fold.islands[other_key].graph.streams)
    pairs = [(mine.ids[pair.first], theirs.ids[pair.second]) for pair in found.pairs]
    newer = tuple((each, 0, OPEN) for each in streams)
    decision = _decide(fold, mine, found, pairs, "merge", sides)
    fold = _record(fold, decision, pairs, newer, (stream, other_key))
    if decision.why:
        return fold
    ties = [
        (one, MergeRecord("merge", two, pair.llr, pair.rival, pair.sd, mine.stamp_ns))
        for pair, (one, two) in zip(found.pairs, pairs, strict=True)
    ]
    return _merge_islands(fold, (key, other_key), ties, found.motion, decision)


def _decide(
    fold: Fold,
    view: IslandView,
    found: Closure,
    pairs: Sequence[tuple[int, int]],
    kind: str,
    sides: tuple[Stream, Stream],
) -> Decision:
    why = found.why
    if not why and fold.landmarks.was_undone(pairs):
        why = "it was undone before"
    return Decision(
        stamp_ns=view.stamp_ns,
        kind="waits" if why else kind,
        about=name_sides(*sides),
        pairs=len(found.pairs),
        llr=found.llr,
        rival_pairs=found.rival_pairs,
        rival_llr=found.rival_llr,
        share=found.share,
        sd=found.sd,
        why=why,
        absent=found.absent,
    )


def _record(
    fold: Fold,
    decision: Decision,
    pairs: Sequence[tuple[int, int]],
    newer: tuple[tuple[Stream, int, int], ...],
    between: tuple[Stream, Stream],
) -> Fold:
    """Record a deferred decision; open an accepted one for audit.

    Pairs are recorded by their smallest members, without named landmarks.
    """
    waits = fold.landmarks.waits
    if decision.why:
        landmarks = replace(fold.landmarks, waits={**waits, between: decision})
        return replace(fold, landmarks=landmarks)
    of = fold.landmarks.present
    members: tuple[tuple[LocalLandmark, LocalLandmark], ...] = tuple(
        (of[one].first.name, of[two].first.name) for one, two in pairs if one in of and two in of
    )
    landmarks = replace(
        fold.landmarks,
        waits={at: each for at, each in waits.items() if each.about != decision.about},
        opened=(*fold.landmarks.opened, Opened(decision, members, newer)),
    )
    return replace(fold, landmarks=landmarks)


def _merge_near(fold: Fold, key: Stream) -> Fold:
    view = view_island(fold.islands[key], fold.landmarks)
    everything = np.arange(len(view.ids))
    view.grow("near", everything, everything, view.profile.near)
    view.sweep()
    return _apply_merges(fold, key, view)


def _merge_islands(
    fold: Fold,
    keys: tuple[Stream, Stream],
    ties: Sequence[tuple[int, MergeRecord]],
    second_from_first: Float[np.ndarray, "3"],
    decision: Decision,
) -> Fold:
    """Merge two islands in the frame of the first by `precedence` and search the moved streams for
    closures; return the fold unchanged without a solution.
    """
    landmarks, becomes = merge_sets(fold.landmarks, ties)
    renamed = {}
    for key in keys:
        island = fold.islands[key]
        graph, state = tie_landmarks(island.graph, island.state, becomes)
        renamed[key] = replace(island, graph=graph, state=state)
    stays, goes = sorted(keys, key=lambda at: precedence(fold, at))
    if renamed[goes].graph.condensed is not None:
        return fold  # its condensed factor is linearised in its own frame
    place = second_from_first if stays == keys[1] else inverse(second_from_first)
    both, waiting = place_island(renamed[stays], renamed[goes], place, fold.waiting)
    try:
        both, *_ = solve_island(both)
    except UNSOLVABLE:
        return fold
    if not is_solvable(both):
        return fold
    words = (
        f"{decision.pairs} landmarks that both show, log-likelihood ratio "
        f"{decision.llr:.0f} against {decision.rival_llr:.0f}, share "
        f"{decision.share:.2f}, {decision.absent} absent"
    )
    fold = replace(fold, landmarks=landmarks.add_decisions(decision))
    streams = sorted(renamed[goes].graph.streams)
    fold = merge_islands(fold, stays, goes, Merge(both, waiting, words))
    fold = _merge_near(fold, stays)
    views = _IslandViews()
    step = patch_step(fold.islands[stays].settings.association)
    for stream in streams:
        for last in range(fold.next_sequence(stream) - 1, first_of(stream) - 1, -step):
            fold = _close_loop(fold, stream, last, views)
    return fold
