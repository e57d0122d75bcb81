"""The bounded fold: old submaps become one quadratic, selected by sequence number only.

The last `lag` submaps of each stream of the main island stay factors. Older ones become one
quadratic over landmarks, biases and the pose at each stream's boundary (`condensed_factor`). The
cost of a tick depends on the number of landmarks and robots, not on the duration of the run.

No submap is condensed before the fold has `begin` submaps, before its robust scale is final, or in
an unmerged island, whose frame will still be transformed.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.map_joining.condensed_factor import (
    NOBODY,
    Condensed,
    Departed,
    EliminatedPath,
    places,
    select_newest,
)
from teamslam.team.estimation.map_joining.gauss_newton import PLAIN, Island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.marginals import BELIEVED, Terms, terms
from teamslam.team.estimation.map_joining.memory import MOST, NOTHING, Memory, Observed
from teamslam.team.estimation.map_joining.path_elimination import (
    MarkedFactors,
    eliminate_paths,
    nodes_of,
)
from teamslam.team.estimation.map_joining.resting import FIRST, eliminate, find_idle, put_to_rest
from teamslam.team.estimation.map_joining.submap_graph import Graph, remove_nodes
from teamslam.team.shapes import Bool, Int64

Indices = Int64[np.ndarray, " _"]
T = TypeVar("T")

ALL_AWAKE = 2**62


class Limits(NamedTuple):
    """The sizes by which a fold is condensed.

    begin: largest raw fold. lag: submaps of each stream that are never condensed. first: number of
    landmarks without a raw submap from which landmarks come to rest.
    """

    begin: int = 128
    lag: int = 8
    first: int = FIRST


LIMITS = Limits()


def condense_submaps(fold: Fold, limits: Limits = LIMITS) -> Fold:
    """Condense the old submaps of the fold's main island.

    Submaps whose poses cannot be eliminated stay raw. A team with unnamed landmarks, which stay
    nodes, condenses once it has as many submaps as landmarks. Association keeps observations of
    condensed submaps (`memory`); landmarks that few submaps confirm are dropped.
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
    """Extend the graph's memory; return also the dropped landmarks: none during an audit, none that
    an operator has judged.
    """
    counts, stays = np.zeros(len(graph.fixed), np.int64), np.zeros(len(graph.fixed), np.bool_)
    before = {} if graph.condensed is None else graph.condensed.departed.believed
    for id_, node in graph.landmarks.items():
        counts[node] = before.get(id_, 0)
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
    rests = find_idle(graph, ~leaving, apart, first)
    eliminated = _mark_eliminated(graph, leaving)
    eliminated[rests] = eliminated[given_up] = True
    out = eliminated.tolist()
    seen = np.array([out[each.observer] or out[each.teammate] for each in graph.sightings], bool)
    prior = np.array([any(out[node] for node in each.nodes) for each in graph.priors], bool)
    factors = MarkedFactors(leaving, seen, prior)
    union = nodes_of(island, factors, [] if before is None else [before.nodes])
    sizes = np.diff(graph.offset)
    unknowns = int(sizes[union[eliminated[union]]].sum())
    if before is None:
        union, H, g, cost = eliminate_paths(island, union, factors, eliminated)
    else:
        H, g, cost = island.estimate.quadratic(union, *factors)
    parts = eliminate(H, g, np.repeat(eliminated[union], sizes[union]))
    left, node_of = remove_nodes(graph, eliminated, ~leaving, ~seen, ~prior)
    remaining = union[~eliminated[union]]
    numbers = places(graph.offset, remaining)
    measured = int(graph.dimensions[leaving].sum()) + 2 * int(seen.sum())
    measured += sum(graph.priors[k].rank for k in np.flatnonzero(prior))
    made = Condensed(
        nodes=node_of[remaining],
        at=island.state[numbers],
        headings=np.isin(numbers, graph.headings),
        information=parts.information,
        slope=parts.slope,
        cost=cost - parts.lowered,
        submaps=int(leaving.sum()) + (0 if before is None else before.submaps),
        redundancy=measured - unknowns + (0 if before is None else before.redundancy),
        departed=_sum_departed(island, leaving, seen, prior, given_up),
        resting=put_to_rest(island, union, parts, rests),
    )
    stays = np.repeat(~eliminated, np.diff(graph.offset))
    return Island(
        replace(left, condensed=made),
        island.state[stays],
        island.age[~leaving],
        island.sighting_age[~seen],
        island.settings,
    )


def _mark_eliminated(graph: Graph, leaving: Bool[np.ndarray, " F"]) -> Bool[np.ndarray, " _"]:
    """Mark the nodes that no later factor can contain."""
    eliminated = np.zeros(len(graph.fixed), np.bool_)
    for f in np.flatnonzero(leaving):
        contribution, nodes, *_ = graph.submaps[f]
        eliminated[nodes[0]] = True
        eliminated[nodes[2 : 2 + len(contribution.local.node_stamps)]] = True
    return eliminated


def _sum_departed(
    island: Island,
    leaving: Bool[np.ndarray, " F"],
    seen: Bool[np.ndarray, " S"],
    prior: Bool[np.ndarray, " priors"],
    given_up: Indices,
) -> Departed:
    graph = island.graph
    before = NOBODY if graph.condensed is None else graph.condensed.departed
    now = terms(island)
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
    robots = _sums(before, now, leaving, seen, prior)
    return Departed(robots, select_newest(submaps), believed, _paths(island, before, leaving))


def _paths(
    island: Island, before: Departed, leaving: Bool[np.ndarray, " F"]
) -> Mapping[Stream, EliminatedPath]:
    graph = island.graph
    counts: dict[Stream, int] = defaultdict(int)
    for f in np.flatnonzero(leaving):
        counts[graph.submaps[f].contribution.stream] += 1
    paths = dict(before.paths)
    for stream, count in counts.items():
        nodes = graph.streams[stream][:count]
        poses = np.array([island.state[graph.offset[n] : graph.offset[n] + 3] for n in nodes])
        old = paths.get(stream, EliminatedPath((), bool(graph.fixed[nodes[0]])))
        paths[stream] = old.longer(poses)
    return paths


def _sums(
    before: Departed,
    now: Terms,
    leaving: Bool[np.ndarray, " F"],
    seen: Bool[np.ndarray, " S"],
    prior: Bool[np.ndarray, " priors"],
) -> dict[str, tuple[float, float]]:
    robots = dict(before.robots)
    for robot, chi2, dof in (
        *_select(now.counted, leaving),
        *_select(now.priors, prior),
        *_select(now.sightings, seen),
    ):
        sums = robots.get(robot, (0.0, 0.0))
        robots[robot] = (sums[0] + chi2, sums[1] + dof)
    return robots


def _select(items: Sequence[T], which: Bool[np.ndarray, " _"]) -> Iterable[T]:
    return (items[k] for k in np.flatnonzero(which).tolist())
