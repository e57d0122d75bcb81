"""Restore condensed submaps at a few sizes of the fold, and where a tick contradicts them.

Submaps linearised at different headings make the map overconfident. At begin · GROWTH^k submaps, up
to SETTLED, and at a tick that moves them beyond their linearisation, all are restored and solved.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from teamslam.team.estimation.contribution import Contribution, Key, Stream
from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.condensed import EliminatedPath
from teamslam.team.estimation.map_joining.condensing import LIMITS
from teamslam.team.estimation.map_joining.gauss_newton import (
    FULL_AGE,
    Island,
    add_sightings,
    age_factors,
    empty_island,
    extend_island,
    is_solvable,
    iterate_tick,
)
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.landmark_view import known, points_of
from teamslam.team.estimation.map_joining.saved_maps import maps_of, separate
from teamslam.team.estimation.map_joining.submap_graph import NO_NUMBERS
from teamslam.team.estimation.map_joining.tick import cut_members
from teamslam.team.estimation.se2 import compose, transformed
from teamslam.team.shapes import Float

Values = Float[np.ndarray, " _"]

GROWTH = 1.5  # ratio of successive sizes at which the fold is linearised again
SETTLED = 1000  # number of submaps above which the fold is not linearised again
SOLVED = 3  # repetitions of a tick's iterations after restoring


def is_due(before: int, after: int, begin: int = LIMITS.begin) -> bool:
    """Return whether the fold passes a size at which it is linearised again."""
    size = begin * GROWTH
    while size <= min(after, SETTLED):
        if before < size:
            return True
        size *= GROWTH
    return False


def is_contradicted(before: Fold, after: Fold) -> bool:
    """Return whether a tick moves the condensed submaps beyond their linearisation: by a closure,
    the first unnamed landmarks, or a new main island.
    """
    begins = after.has_unnamed and not before.has_unnamed
    return bool(after.landmarks.opened) or begins or before.main_key != after.main_key


def restore_submaps(
    fold: Fold, contributions: Sequence[Contribution], sightings: Sequence[InterRobotFactor]
) -> Fold:
    """Restore the condensed submaps as factors and solve their islands; unchanged without a
    solution.

    contributions, sightings: all of the fold in canonical order, with refused ones.
    """
    contributions = cut_members(contributions, fold.cuts)
    sightings = cut_members(sightings, fold.cuts)
    for key, island in fold.islands.items():
        old = island.graph.condensed
        if old is not None:
            fold = _restore_island(fold, key, old.departed.paths, contributions, sightings)
    return fold


def _restore_island(
    fold: Fold,
    key: Stream,
    paths: Mapping[Stream, EliminatedPath],
    contributions: Sequence[Contribution],
    sightings: Sequence[InterRobotFactor],
) -> Fold:
    island, landmarks, numbers = fold.islands[key], fold.landmarks, NO_NUMBERS
    submaps = [
        replace(each, local=each.local.motion) if each.key in fold.motion_only else each
        for each in contributions
        if fold.home.get(each.stream) == key and each.key not in fold.refused
    ]
    refused = {of[1:] for of in fold.refused}
    seen = [
        each
        for each in sightings
        if fold.home.get(each.stream) == key
        and each.key not in fold.left_out
        and (*each.stream, each.sequence) not in refused
    ]
    if fold.has_unnamed:
        landmarks, numbers = landmarks.restore(submaps)
    try:
        with np.errstate(all="ignore"):
            raw = _raw(island, fold, submaps, paths, numbers)
            raw, waiting = add_sightings(raw, seen)
            for _ in range(SOLVED):
                raw = iterate_tick(raw)
    except UNSOLVABLE:
        return fold
    if not is_solvable(raw):
        return fold
    others = [each for each in fold.waiting if fold.home.get(each.stream) != key]
    active = [each for each in fold.contributions if fold.home[each.stream] != key]
    return replace(
        fold,
        islands={**fold.islands, key: raw},
        contributions=tuple(sorted([*active, *submaps], key=lambda each: each.key)),
        waiting=tuple(sorted([*others, *waiting], key=lambda each: each.key)),
        landmarks=landmarks,
    )


def _raw(
    island: Island,
    fold: Fold,
    contributions: Sequence[Contribution],
    paths: Mapping[Stream, EliminatedPath],
    numbers: Mapping[Key, Sequence[int]],
) -> Island:
    graph = island.graph
    raw = extend_island(empty_island(island.settings), contributions, fold.starts, numbers)
    raw = age_factors(raw, FULL_AGE)
    full, state, fixed = raw.graph, raw.state.copy(), raw.graph.fixed.copy()
    raw = replace(raw, graph=replace(full, fixed=fixed), state=state)

    def put(node: int, value: Values) -> None:
        state[full.offset[node] : full.offset[node + 1]] = value

    for stream, nodes in graph.streams.items():
        left = paths.get(stream, EliminatedPath((), bool(graph.fixed[nodes[0]])))
        fixed[full.streams[stream][0]] = left.is_fixed
        path = [*left.poses, *map(island.value, nodes)]
        for node, pose in zip(full.streams[stream], path, strict=True):
            put(node, pose)
    ids = known(island)
    given_up = {full.landmarks[id_] for id_ in full.landmarks.keys() - set(ids)}
    for submap in full.submaps:
        local, members = submap.contribution.local, submap.nodes
        start = raw.value(int(members[0]))
        for at, pose in zip(members[2:].tolist(), local.nodes, strict=False):
            put(at, compose(start, pose))
        for at, point in zip(submap.landmarks.tolist(), local.landmarks, strict=True):
            if at in given_up:
                put(at, transformed(start, point))
    for id_, point in zip(ids, points_of(island, ids), strict=True):
        put(full.landmarks[id_], point)
    pairs = [(full.biases[of], node) for of, node in graph.biases.items()]
    pairs += [(full.common[bias], node) for bias, node in graph.common.items()]
    pairs += [(full.remembered[of], node) for of, node in graph.remembered.items()]
    for node, own in pairs:
        put(node, island.value(own))
    for saved in maps_of(full):
        of = saved.contribution.stream
        raw = separate(raw, saved, (id_ for stream, id_ in graph.former if stream == of))
    return raw
