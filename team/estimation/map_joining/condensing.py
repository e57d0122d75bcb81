"""Bounded fold: old submaps become one quadratic, selected by sequence number only.

The last `lag` submaps of each stream of the main island stay factors. Older ones become one
quadratic over landmarks, biases and the pose at each stream's boundary (`condensed`). A
landmark without a raw submap comes to rest: it is eliminated, as a Gaussian given the other nodes,
until a submap observes it again.

No submap is condensed before the fold has `begin` submaps, before its robust scale is final, or in
an unmerged island, whose frame will be transformed.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.map_joining.condensed import (
    MOST,
    NOTHING,
    Condensed,
    Departed,
    EliminatedPath,
    Memory,
    Observed,
    select_newest,
)
from teamslam.team.estimation.map_joining.gauss_newton import PLAIN, Island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.marginals import BELIEVED, terms
from teamslam.team.estimation.map_joining.submap_graph import Graph, remove_nodes
from teamslam.team.shapes import Bool, Int64

Indices = Int64[np.ndarray, " _"]

FIRST = 64
"""Number of landmarks without a raw submap at which they begin to come to rest; fewer cost less as
nodes.
"""
ALL_AWAKE = 2**62
RUN = 16  # number of submaps whose poses are eliminated together


class Limits(NamedTuple):
    """The sizes by which a fold is condensed.

    begin: largest raw fold. lag: submaps of each stream that stay raw. first: see FIRST.
    """

    begin: int = 128
    lag: int = 8
    first: int = FIRST


LIMITS = Limits()


def condense_submaps(fold: Fold, limits: Limits = LIMITS) -> Fold:
    """Condense the old submaps of the fold's main island.

    Unnamed landmarks stay nodes: with these a fold condenses once it has as many submaps as
    landmarks, stores the observations (`condensed`), and drops landmarks that few submaps confirm.
    """
    key, (begin, lag, first) = fold.main_key, limits
    if key is None or fold.size <= begin:
        return fold
    unnamed = fold.has_unnamed
    island = fold.islands[key]
    if unnamed:
        lag = max(lag, island.settings.association.recent)
        if fold.size <= len(island.graph.landmarks):
            return fold
    leaving = _mark_leaving(island, lag)
    if not leaving.any():
        return fold
    others = (each for at, each in fold.islands.items() if at != key)
    apart = {id_ for each in others for id_ in each.graph.landmarks}
    memory, given_up = NOTHING, np.zeros(0, np.int64)
    if unnamed:
        memory, given_up = _extend_memory(island.graph, leaving, fold)
    try:
        smaller = _condense_island(
            island, leaving, apart, ALL_AWAKE if unnamed else first, given_up
        )
    except UNSOLVABLE:
        return fold
    if unnamed:
        smaller = _attach_memory(smaller, memory, island.graph, forgets=not fold.audits)
    gone = smaller.graph.gone
    left = island.graph.landmarks.keys() - smaller.graph.landmarks.keys()
    return replace(
        fold,
        islands={**fold.islands, key: smaller},
        contributions=tuple(
            each for each in fold.contributions if each.sequence >= gone.get(each.stream, 0)
        ),
        waiting=tuple(each for each in fold.waiting if each.sequence >= gone.get(each.stream, 0)),
        landmarks=fold.landmarks.without(left) if len(given_up) else fold.landmarks,
    )


def _extend_memory(
    graph: Graph, leaving: Bool[np.ndarray, " F"], fold: Fold
) -> tuple[Memory, Indices]:
    """Extend the graph's memory; return also the landmarks to drop, none during an audit."""
    counts, stays = np.zeros(len(graph.fixed), np.int64), np.zeros(len(graph.fixed), np.bool_)
    for id_, node in graph.landmarks.items():
        counts[node] = graph.departed.believed.get(id_, 0)
    taken = []
    for submap, leaves in zip(graph.submaps, leaving.tolist(), strict=True):
        nodes = submap.landmarks
        if leaves:
            counts[nodes] += 1
            taken.append(Observed(submap.contribution.observation, nodes, counts[nodes]))
        else:
            stays[nodes] = True
    memory = graph.memory.longer(taken)
    if fold.audits:
        return memory, np.zeros(0, np.int64)
    for judged in sorted(fold.landmarks.judged() & graph.landmarks.keys()):
        stays[graph.landmarks[judged]] = True
    return memory, memory.given_up(counts, stays, MOST)


def _attach_memory(smaller: Island, memory: Memory, before: Graph, *, forgets: bool) -> Island:
    graph = smaller.graph
    node_of = np.full(len(before.fixed), -1, np.int64)
    for id_, node in before.landmarks.items():
        node_of[node] = graph.landmarks.get(id_, -1)
    memory = memory.renumbered(node_of)
    if forgets:
        memory = memory.shortened(len(graph.fixed), MOST)
    return replace(smaller, graph=replace(graph, memory=memory))


def _mark_leaving(island: Island, lag: int) -> Bool[np.ndarray, " F"]:
    graph = island.graph
    last = {stream: graph.next_sequence(stream) - lag for stream in graph.streams}
    narrow = (island.scale <= 1.0) | (island.scale >= PLAIN)
    leaving = np.zeros(len(graph.submaps), np.bool_)
    blocked = set[Stream]()
    for f, (contribution, *_) in enumerate(graph.submaps):
        stream = contribution.stream
        if contribution.sequence < last[stream] and narrow[f] and stream not in blocked:
            leaving[f] = True
        else:
            blocked.add(stream)
    return leaving


def _condense_island(
    island: Island,
    leaving: Bool[np.ndarray, " F"],
    apart: Collection[int],
    first: int,
    given_up: Indices,
) -> Island:
    graph, before = island.graph, island.graph.condensed
    rests = _find_idle(graph, ~leaving, apart, first)
    with island.determined():
        factor, eliminated, unknowns, seen, prior = island.estimate.condense(
            leaving, rests, given_up, _list_runs(graph, leaving)
        )
    measured = int(graph.dimensions[leaving].sum()) + 2 * int(seen.sum())
    measured += sum(graph.priors[k].rank for k in np.flatnonzero(prior))
    resting = None if before is None else before.resting
    if len(rests):
        id_of = {node: id_ for id_, node in graph.landmarks.items()}
        ids = np.array([id_of[node] for node in rests.tolist()], np.int64)
        resting = ids if resting is None else np.concatenate([resting, ids])
    made = Condensed(
        factor=factor,
        submaps=int(leaving.sum()) + (0 if before is None else before.submaps),
        redundancy=measured - unknowns + (0 if before is None else before.redundancy),
        departed=_sum_departed(island, leaving, seen, prior, given_up),
        resting=resting,
    )
    left = remove_nodes(graph, eliminated, ~leaving, ~seen, ~prior)
    stays = np.repeat(~eliminated, np.diff(graph.offset))
    return Island(
        replace(left, condensed=made),
        island.state[stays],
        island.age[~leaving],
        island.sighting_age[~seen],
        island.settings,
    )


def _find_idle(
    graph: Graph, stays: Bool[np.ndarray, " F"], apart: Collection[int], first: int
) -> Indices:
    """List the nodes of landmarks that come to rest, ascending: in no raw submap and no other
    island (`apart`); at first at least `first`.
    """
    seen = {*graph.landmark_nodes[np.repeat(stays, np.diff(graph.landmark_start))].tolist()}
    found = sorted(n for id_, n in graph.landmarks.items() if n not in seen and id_ not in apart)
    some_rest = graph.condensed is not None and graph.condensed.resting is not None
    return np.array(found if some_rest or len(found) >= first else [], np.int64)


def _list_runs(graph: Graph, leaving: Bool[np.ndarray, " F"]) -> list[Indices]:
    streams: dict[Stream, list[int]] = defaultdict(list)
    for f in np.flatnonzero(leaving).tolist():
        streams[graph.submaps[f].contribution.stream].append(f)
    return [
        np.array(own[k : k + RUN], np.int64)
        for _, own in sorted(streams.items())
        for k in range(0, len(own), RUN)
    ]


def _sum_departed(
    island: Island,
    leaving: Bool[np.ndarray, " F"],
    seen: Bool[np.ndarray, " S"],
    prior: Bool[np.ndarray, " priors"],
    given_up: Indices,
) -> Departed:
    graph = island.graph
    before, now = graph.departed, terms(island)
    believed = dict(before.believed)
    id_of = {node: id_ for id_, node in graph.landmarks.items()}
    is_believed = island.estimate.landmark_weights >= BELIEVED
    for f in np.flatnonzero(leaving):
        begin, end = graph.landmark_start[f : f + 2]
        nodes = graph.submaps[f].landmarks[is_believed[begin:end]]
        for id_ in (id_of[node] for node in nodes.tolist()):
            believed[id_] = believed.get(id_, 0) + 1
    for node in given_up.tolist():
        believed.pop(id_of[node], None)
    submaps = before.submaps.followed_by(now.submaps.select(np.flatnonzero(leaving).tolist()))
    robots = now.add_to(before.robots, np.concatenate([leaving, prior, seen]))
    return Departed(robots, select_newest(submaps), believed, _paths(island, before, leaving))


def _paths(
    island: Island, before: Departed, leaving: Bool[np.ndarray, " F"]
) -> Mapping[Stream, EliminatedPath]:
    graph = island.graph
    counts = Counter(each.contribution.stream for each in compress(graph.submaps, leaving))
    paths = dict(before.paths)
    for stream, count in counts.items():
        nodes = graph.streams[stream][:count]
        poses = np.array([*map(island.value, nodes)])
        old = paths.get(stream, EliminatedPath((), bool(graph.fixed[nodes[0]])))
        paths[stream] = old.longer(poses)
    return paths
