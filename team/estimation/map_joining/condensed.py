"""Condensed submaps: one quadratic cost over the nodes that remain in the graph, and observations.

Linearised at the state `at` of condensing,

    cost(x) = cost + 2 slopeᵀ d + dᵀ information d,   d = x − at (headings wrapped),

with the poses of no other factor eliminated (Schur complement); the linearisation point and the
robust weights stay.

For association the newest MOST submaps of each landmark are stored whole; of older ones, the pairs
of landmarks that they kept apart. A landmark of n < MOST submaps, probably a false detection, is
dropped when every landmark of MOST or more, last observed with it, has since been observed by MOST
n submaps.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Observation, Stream
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]


HISTORY = 50  # number of condensed submaps of each stream whose costs are stored
PATH_BLOCK = 64  # poses in each run of an eliminated path


@dataclass(frozen=True, eq=False)
class SubmapCosts:
    """Agreement of submaps with the rest of the map, oldest first: χ² should be close to dof.

    table: rows χ² without discounts; dof, dim − w tr(JᵀP⁻¹J Σ), its redundancy (Baarda 1968); the
    robust weight w; the median of χ² with `dof` degrees of freedom, NaN for less than one.
    """

    streams: tuple[Stream, ...] = ()
    table: Float[np.ndarray, "4 n"] = field(default_factory=lambda: np.empty((4, 0)))

    @property
    def chi2(self) -> Values:
        """χ² of each submap."""
        chi2: Values = self.table[0]
        return chi2

    @property
    def dof(self) -> Values:
        """Degrees of freedom of each submap."""
        dof: Values = self.table[1]
        return dof

    @property
    def weight(self) -> Values:
        """Robust weight of each submap."""
        weight: Values = self.table[2]
        return weight

    @cached_property
    def of_robots(self) -> Mapping[str, list[int]]:
        """Places of each robot's submaps, robots by name."""
        places: dict[str, list[int]] = {}
        for place, (robot, _) in enumerate(self.streams):
            places.setdefault(robot, []).append(place)
        return {robot: places[robot] for robot in sorted(places)}

    def select(self, places: Sequence[int]) -> "SubmapCosts":
        """Select submaps by place."""
        return SubmapCosts(tuple(self.streams[k] for k in places), self.table[:, places])

    def followed_by(self, later: "SubmapCosts") -> "SubmapCosts":
        """Append later submaps."""
        return SubmapCosts(
            self.streams + later.streams, np.concatenate([self.table, later.table], axis=1)
        )


class EliminatedPath(NamedTuple):
    """Eliminated poses of a stream, first to last, as of their elimination.

    blocks: runs of PATH_BLOCK poses, which checkpoints share. is_fixed: the first is a constant.
    """

    blocks: tuple[Float[np.ndarray, "_ 3"], ...]
    is_fixed: bool

    @property
    def poses(self) -> Float[np.ndarray, "K 3"]:
        """All poses."""
        return np.concatenate([np.zeros((0, 3)), *self.blocks])

    def longer(self, poses: Float[np.ndarray, "K 3"]) -> "EliminatedPath":
        """Append poses."""
        whole = [each for each in self.blocks if len(each) == PATH_BLOCK]
        rest = np.concatenate([np.zeros((0, 3)), *self.blocks[len(whole) :], poses])
        runs = (rest[k : k + PATH_BLOCK].copy() for k in range(0, len(rest), PATH_BLOCK))
        return self._replace(blocks=(*whole, *runs))


class Departed(NamedTuple):
    """Statistics of the condensed factors, as of their condensing.

    robots: Σ w χ² and Σ dof of each robot. submaps: newest costs of each stream, oldest first.
    believed: number of believed submaps of each landmark.
    """

    robots: Mapping[str, tuple[float, float]]
    submaps: SubmapCosts
    believed: Mapping[int, int]
    paths: Mapping[Stream, EliminatedPath]


def select_newest(submaps: SubmapCosts) -> SubmapCosts:
    """Select the costs of the last HISTORY submaps of each stream."""
    left, newest = Counter(submaps.streams), list[int]()
    for place, stream in enumerate(submaps.streams):
        if left[stream] <= HISTORY:
            newest.append(place)
        left[stream] -= 1
    return submaps.select(newest)


NOBODY = Departed({}, SubmapCosts(), {}, {})


@dataclass(frozen=True, eq=False)
class Condensed:
    """The quadratic cost of the module's equation, over free nodes.

    submaps: their number. redundancy: measured quantities less eliminated unknowns. resting: ids of
    the landmarks at rest by place; None before the first.
    """

    factor: core.Quadratic
    submaps: int
    redundancy: int
    departed: Departed = field(default=NOBODY)
    resting: Indices | None = None

    @property
    def nodes(self) -> Indices:
        """Nodes of the cost in the graph."""
        return self.factor.nodes

    @cached_property
    def place(self) -> Mapping[int, int]:
        """Place of each landmark at rest."""
        ids = [] if self.resting is None else self.resting.tolist()
        return {id_: k for k, id_ in enumerate(ids)}

    def tied(self, sizes: Indices, node_of: Indices, becomes: Mapping[int, int]) -> "Condensed":
        """Merge landmarks into one node, with the same cost where they are equal.

        sizes: of each node. node_of: new number of each former node. becomes: that of each
        renumbered landmark. The linearisation point is that of the first merged landmark.
        """
        departed = self.departed
        if any(id_ in departed.believed for id_ in becomes):
            believed = Counter[int]()
            for id_, count in departed.believed.items():
                believed[becomes.get(id_, id_)] += count
            departed = departed._replace(believed=believed)
        old, own = self.factor, sizes[self.nodes]
        nodes, first, slot = np.unique(node_of[old.nodes], return_index=True, return_inverse=True)
        begin = np.cumsum([0, *own[first]])[slot]
        to = np.concatenate([np.arange(at, at + size) for at, size in zip(begin, own, strict=True)])
        T = (to[:, None] == np.arange(to.max() + 1)).astype(np.float64)  # d = T d' + moved
        first = T.argmax(axis=0)
        moved = np.where(old.headings, 0.0, old.at[first][to] - old.at)
        half = dense.product(old.information, moved)
        factor = core.Quadratic(
            nodes,
            old.at[first],
            old.headings[first],
            dense.congruent(T.T, old.information),
            dense.product(T.T, old.slope + half),
            old.cost + float(dense.product(2.0 * old.slope + half, moved)),
        )
        return replace(self, factor=factor, departed=departed)


MOST = 8  # newest condensed submaps stored for each landmark
NO_COUNTS: Indices = np.zeros(0, np.int64)


class Observed(NamedTuple):
    """A submap with the node of each landmark; −1 for a dropped one.

    counts: condensed submaps with each landmark; empty if not condensed.
    """

    observation: Observation
    landmarks: Indices
    counts: Indices

    @property
    def known(self) -> Indices:
        """Nodes of the landmarks without dropped ones."""
        return self.landmarks[self.landmarks >= 0]


@dataclass(frozen=True, eq=False)
class Memory:
    """The stored condensed submaps, oldest first, and the pairs of forgotten ones.

    pairs: nodes of two landmarks of one forgotten submap, ascending. distinct: certainly two
    (`LocalMap.distinct`).
    """

    submaps: tuple[Observed, ...] = ()
    pairs: Int64[np.ndarray, "P 2"] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    distinct: Bool[np.ndarray, " P"] = field(default_factory=lambda: np.zeros(0, np.bool_))

    def renumbered(self, node_of: Indices) -> "Memory":
        """Renumber the nodes, −1 for a dropped one; drop pairs that become one landmark."""
        to = np.append(node_of, -1)
        submaps = tuple(each._replace(landmarks=to[each.landmarks]) for each in self.submaps)
        return replace(_unique(to[self.pairs], self.distinct), submaps=submaps)

    def longer(self, submaps: Sequence[Observed]) -> "Memory":
        """Append submaps."""
        return replace(self, submaps=(*self.submaps, *submaps))

    def given_up(self, counts: Indices, stays: Bool[np.ndarray, " nodes"], most: int) -> Indices:
        """List the nodes of the landmarks to drop, ascending.

        counts: condensed submaps by node. stays: landmarks to keep.
        """
        if not self.submaps:
            return np.zeros(0, np.int64)
        size = [len(each.landmarks) for each in self.submaps]
        of = np.repeat(np.arange(len(size)), size)
        node = np.concatenate([each.landmarks for each in self.submaps])
        before = np.concatenate([each.counts for each in self.submaps])
        of, node, before = (each[node >= 0] for each in (of, node, before))
        now = counts[node]
        well_known = now >= most
        since = np.full(len(size), -1)
        since[of[well_known]] = np.iinfo(np.int64).max
        np.minimum.at(since, of[well_known], (now - before)[well_known])
        last = np.zeros(len(counts), np.int64)
        np.maximum.at(last, node, of)
        gone = ~well_known & ~stays[node] & (last[node] == of) & (since[of] >= most * now)
        return np.unique(node[gone])

    def shortened(self, nodes: int, most: int) -> "Memory":
        """Drop the submaps that are among the newest `most` of none of their landmarks."""
        newer = np.zeros(nodes, np.int64)
        remembered, forgotten = [], []
        for each in reversed(self.submaps):
            if (newer[each.known] < most).any():
                newer[each.known] += 1
                remembered.append(each)
            else:
                forgotten.append(each)
        if not forgotten:
            return self
        pairs, distinct = [self.pairs], [self.distinct]
        for each in forgotten:
            marks = each.observation.distinct
            one, two = np.triu_indices(len(marks), 1)
            pairs.append(np.column_stack([each.landmarks[one], each.landmarks[two]]))
            distinct.append(marks[one, two])
        found = _unique(np.concatenate(pairs), np.concatenate(distinct))
        return replace(found, submaps=tuple(reversed(remembered)))


NOTHING = Memory()


def _unique(pairs: Int64[np.ndarray, "P 2"], distinct: Bool[np.ndarray, " P"]) -> Memory:
    if not len(pairs):
        return NOTHING
    pairs = np.sort(pairs, axis=1)
    two = (pairs[:, 0] != pairs[:, 1]) & (pairs[:, 0] >= 0)
    pairs, distinct = pairs[two], distinct[two]
    order = np.lexsort((~distinct, pairs[:, 1], pairs[:, 0]))
    pairs, distinct = pairs[order], distinct[order]
    first = np.ones(len(pairs), np.bool_)
    first[1:] = (pairs[1:] != pairs[:-1]).any(axis=1)
    return Memory((), pairs[first], distinct[first])
