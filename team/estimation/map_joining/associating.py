"""Data association in the fold: decides after each tick which landmarks of an island are one.

Every submap adds its unnamed landmarks to the graph as nodes of their own; here nodes are merged.
The steps of a tick, in their order: tracking (against the last submaps of the same robot), nearby
landmarks (of older submaps, where the standard deviation of the difference is small; one submap
after the other), sweeping
(landmarks that were split), closures (anywhere else in the map, by map matching), and merges of
islands. Each step is a function of the fold alone, and the fold is a function of the set of submaps
in its canonical order; so are the decisions.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int64

from team.config import UNNAMED
from team.estimation import elementwise
from team.estimation.contribution import Contribution, Stream
from team.estimation.map_joining.association.absence import overlooked
from team.estimation.map_joining.association.comparing import (
    AGAIN_WITHIN,
    by_turns,
    comparable,
    undecided,
)
from team.estimation.map_joining.association.crowding import Crowd
from team.estimation.map_joining.association.growing import (
    Indices,
    Joint,
    Pair,
    conditioned,
    grow,
)
from team.estimation.map_joining.association.hypotheses import (
    MOST_ASSIGNED,
    candidates,
    jointly,
)
from team.estimation.map_joining.association.landmarks import (
    Landmarks,
    LocalLandmark,
    MergeRecord,
    united,
)
from team.estimation.map_joining.gauss_newton import (
    Island,
    iterated,
    joint_marginal,
)
from team.estimation.map_joining.joining import Fold
from team.estimation.map_joining.submap_graph import Graph, tied


class IslandView:
    """An island's landmarks as a joint Gaussian, with the landmarks merged so far.

    ids, nodes: the identity and the node of each landmark, in the order of the nodes.
    seen_by: for each submap that is examined (`Graph.observed`), the indices in `ids` of its
        landmarks.
    sees: which landmarks each submap has; where some are merged, those that they are now.
    """

    def __init__(self, island: Island, landmarks: Landmarks) -> None:
        self.island = island
        graph = island.graph
        ordered = sorted(graph.landmarks.items(), key=lambda each: each[1])
        self.ids = [id_ for id_, _ in ordered]
        nodes = np.array([node for _, node in ordered], np.int64)
        self.place = np.full(len(graph.fixed), -1, np.int64)
        self.place[nodes] = np.arange(len(nodes))
        self.seen_by = [self.place[each.known] for each in graph.observed]
        mean, covariance = joint_marginal(island, nodes.tolist())
        self.place_of = {id_: at for at, id_ in enumerate(self.ids)}
        apart = _apart(graph, self.place, self.ids, landmarks, self.place_of)
        one, two = self.place[graph.memory.pairs[graph.memory.distinct]].T
        apart[one, two] = apart[two, one] = True
        points = mean.reshape(-1, 2)
        counts = np.bincount(
            np.concatenate([np.zeros(0, np.int64), *map(np.unique, self.seen_by)]),
            minlength=len(points),
        )
        around = Crowd((each.observation.spacings for each in graph.observed), points[counts > 1])
        self.profile = around.bounded(island.settings.association)
        unseen = overlooked(points, self.seen_by, self.profile.same)
        self.gone = np.zeros(len(nodes), np.bool_)
        self.sees = np.zeros((len(self.seen_by), len(nodes)), np.bool_)
        for row, places in zip(self.sees, self.seen_by, strict=True):
            row[places] = True
        in_window = _apart_in_window(self.sees, self.place[graph.memory.pairs])
        self.joint = Joint(points, covariance, apart, around, unseen, in_window)
        self._now = np.arange(len(nodes))
        self.ties: list[tuple[int, MergeRecord]] = []
        self.stamp_ns = max((s.contribution.end_ns for s in graph.submaps), default=0)

    def unnamed(self, k: int) -> Indices:
        """Indices of the unnamed landmarks of submap k."""
        seen = self.island.graph.observed[k]
        nodes = seen.landmarks[seen.observation.ids >= UNNAMED]
        places: Indices = np.unique(self.place[nodes[nodes >= 0]])
        return places

    def views(self, k: int) -> list[Indices]:
        """Indices of the unnamed landmarks that each keyframe of submap k observed together."""
        seen = self.island.graph.observed[k]
        nodes = seen.landmarks[seen.observation.ids >= UNNAMED]
        views = (nodes[each] for each in seen.observation.unnamed.views)
        return [self.place[view[view >= 0]] for view in views]

    def take(self, pairs: Iterable[Pair], joint: Joint, kind: str) -> None:
        """Records the pairs that were merged, and the step (`kind`) that merged them."""
        self.joint = joint
        for pair in pairs:
            tie = MergeRecord(
                kind, self.ids[pair.second], pair.llr, pair.rival, pair.sd, self.stamp_ns
            )
            self.ties.append((self.ids[pair.first], tie))
            self.gone[pair.first] = True
            self._now[self._now == pair.first] = pair.second
            self.sees[:, pair.second] |= self.sees[:, pair.first]
            self.sees[:, pair.first] = False

    def now(self, places: Indices) -> Indices:
        """These landmarks, where some are merged the ones that they are now."""
        return np.unique(self._now[places])

    def step(self, kind: str, first: Indices, second: Indices, most_sd: float) -> None:
        """Merges pairs out of two lists of landmarks, growing from the most certain pair
        onwards.
        """
        first, second = first[~self.gone[first]], second[~self.gone[second]]
        if not len(first) or not len(second):
            return
        one, two = (each.ravel() for each in np.meshgrid(first, second, indexing="ij"))
        different = one != two
        found = grow(
            self.joint,
            (one[different], two[different]),
            self.profile,
            most_sd=most_sd,
            sure_sd=self.profile.near,
        )
        if found is not None and found.pairs:
            self.take(found.pairs, found.joint, kind)

    def compare(self, kind: str, k: int, most_sd: float) -> None:
        """Merges the pairs of submap k and one other submap after the other on which all likely
        joint assignments of the two agree.
        """
        own = self.now(self.unnamed(k))
        others = self.sees.copy()
        others[k] = False
        for nearby in comparable(self.joint, own, others, self.profile, most_sd):
            first, second = own[~self.gone[own]], self.now(nearby)
            one, two = (each.ravel() for each in np.meshgrid(first, second, indexing="ij"))
            different = one != two
            found = jointly(self.joint, one[different], two[different], self.profile, most_sd)
            self.take(found.pairs, found.joint, kind)

    def sweep(self) -> None:
        """Merges landmarks at one place that are well known relative to each other and never seen
        together, where all likely joint assignments of them agree.

        Of what is not decided when it is new little is certain: one pair after the other, each by
        itself the likeliest, can turn a robot by a spacing.
        """
        at = np.flatnonzero(~self.gone)
        mean = self.joint.mean[at]
        away = np.abs(mean[:, None] - mean[None]).max(axis=2)
        later, earlier = np.nonzero(np.tril(away < self.profile.same, -1))
        one, two = at[later], at[earlier]
        x, y = (self.joint.mean[one] - self.joint.mean[two]).T
        close = elementwise.hypot(x, y) < self.profile.same
        one, two = one[close], two[close]
        one, two, _ = candidates(self.joint, one, two, self.profile, self.profile.tight)
        split = np.unique(one)
        for begin in range(0, len(split), MOST_ASSIGNED):
            own = np.isin(one, split[begin : begin + MOST_ASSIGNED]) & ~self.gone[two]
            found = jointly(self.joint, one[own], two[own], self.profile, self.profile.tight)
            self.take(found.pairs, found.joint, "sweep")

    def agreed(self, landmarks: Landmarks) -> None:
        """Merges the landmarks that an operator has declared to be one, verdict by verdict in their
        order; one that would unite two landmarks that were declared to be two has no effect.
        """
        declared = [
            (here, there, each.same)
            for each in landmarks.verdicts
            if (here := self._place(landmarks, each.first)) is not None
            and (there := self._place(landmarks, each.second)) is not None
        ]
        for first, second, same in declared:
            one, two = (int(self._now[each]) for each in (first, second))
            apart = ({int(self._now[a]), int(self._now[b])} for a, b, one_ in declared if not one_)
            if not same or one == two or {one, two} in apart:
                continue
            joint = conditioned(self.joint, one, two, self.profile)
            self.take([Pair(one, two, np.inf, 0.0, -np.inf)], joint, "verdict")

    def _place(self, landmarks: Landmarks, member: LocalLandmark) -> int | None:
        """The index in `ids` of a member's landmark; None where the island does not have it."""
        identity = landmarks.identity(member)
        return None if identity is None else self.place_of.get(identity)


def _apart_in_window(
    sees: Bool[np.ndarray, "K n"], pairs: Int64[np.ndarray, "_ 2"]
) -> Bool[np.ndarray, "n n"]:
    """Marks pairs of landmarks that one submap has, these pairs of condensed submaps among them."""
    of = sees.astype(np.float32)
    apart = np.asarray(of.T @ of > 0.0)  # exact: sums of ones
    first, second = pairs.T
    apart[first, second] = apart[second, first] = True
    np.fill_diagonal(apart, False)
    return apart


def _apart(
    graph: Graph,
    place: Indices,
    ids: Sequence[int],
    landmarks: Landmarks,
    place_of: Mapping[int, int],
) -> Bool[np.ndarray, "n n"]:
    """Marks pairs of landmarks that can not be one: observed by one keyframe, named differently, or
    declared to be two by an operator.
    """
    named = np.array(ids) < UNNAMED
    apart = named[:, None] & named[None, :]
    for submap in graph.observed:
        known = submap.landmarks >= 0
        places = place[submap.landmarks[known]]
        one, two = np.nonzero(submap.observation.distinct[known][:, known])
        apart[places[one], places[two]] = True
    for first, second, same in landmarks.verdicts:
        here, there = (place_of.get(landmarks.identity(each) or -1) for each in (first, second))
        if not same and here is not None and there is not None:
            apart[here, there] = apart[there, here] = True
    np.fill_diagonal(apart, False)
    return apart


def associated(fold: Fold, contributions: Sequence[Contribution]) -> Fold:
    """The fold after tracking, nearby landmarks and sweeping for the submaps of one tick."""
    arrived: dict[Stream, list[Contribution]] = {}
    for contribution in contributions:
        arrived.setdefault(fold.home[contribution.stream], []).append(contribution)
    for key in sorted(arrived):
        fold = _followed(fold, key, arrived[key])
    return fold


def _followed(fold: Fold, key: Stream, arrived: Sequence[Contribution]) -> Fold:
    """Tracks, merges nearby landmarks and sweeps, for the new submaps of one island."""
    island = fold.islands[key]
    view = IslandView(island, fold.landmarks)
    order = {each.observation[:2]: k for k, each in enumerate(island.graph.observed)}
    view.agreed(fold.landmarks)
    for contribution in arrived:
        k = order.get((contribution.stream, contribution.sequence))
        if k is None or not len(contribution.local.unnamed.counts):
            continue
        fresh = view.unnamed(k)
        before = recent(
            island.graph, contribution.stream, contribution.sequence, view.profile.recent
        )
        view.step("track", fresh, union(view.seen_by[at] for at in before), np.inf)
        others = np.setdiff1d(np.arange(len(view.ids)), view.seen_by[k])
        view.compare("near", k, view.profile.near)
        view.step("near", fresh, others, view.profile.near)
    for k in _again(view, order, arrived):
        view.compare("near", k, view.profile.near)
    view.sweep()
    return applied(fold, key, view)


def _again(
    view: IslandView, order: Mapping[tuple[Stream, int], int], arrived: Sequence[Contribution]
) -> list[int]:
    """Indices of older submaps near the tick's ones with landmarks that may be one with others: a
    pair that was undecided may be decidable now.
    """
    fresh = [k for each in arrived if (k := order.get((each.stream, each.sequence))) is not None]
    near = np.flatnonzero(view.sees[fresh].any(axis=0))
    if not len(near):
        return []
    away = np.abs(view.joint.mean[:, None] - view.joint.mean[near][None]).max(axis=2).min(axis=1)
    around = np.flatnonzero((away < AGAIN_WITHIN * view.profile.same) & ~view.gone)
    loose = np.zeros(len(view.ids), np.bool_)
    loose[undecided(view.joint, around, view.profile)] = True
    found = np.setdiff1d(np.flatnonzero(view.sees[:, loose].any(axis=1)), fresh)
    return by_turns(found.tolist(), view.island.graph.size)


def applied(fold: Fold, key: Stream, view: IslandView) -> Fold:
    """The fold with the landmarks that a view has merged, after one further iteration."""
    if not view.ties:
        return fold
    landmarks, becomes = united(fold.landmarks, view.ties)
    islands = dict(fold.islands)
    for at, island in fold.islands.items():
        if at != key and not any(id_ in becomes for id_ in island.graph.landmarks):
            continue
        graph, state = tied(island.graph, island.state, becomes)
        islands[at] = iterated(replace(island, graph=graph, state=state))
    return replace(fold, islands=islands, landmarks=landmarks)


def recent(graph: Graph, stream: Stream, sequence: int, count: int) -> list[int]:
    """Indices in the graph of the last `count` submaps of a stream before this sequence number."""
    return [
        k
        for k, each in enumerate(graph.observed)
        if each.observation.stream == stream
        and sequence - count <= each.observation.sequence < sequence
    ]


def union(of: Iterable[Indices]) -> Int64[np.ndarray, " _"]:
    """The indices that are in any of these lists, ascending."""
    places: Int64[np.ndarray, " _"] = np.unique(np.concatenate([np.zeros(0, np.int64), *of]))
    return places
