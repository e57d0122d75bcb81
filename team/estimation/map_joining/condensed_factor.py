"""The condensed factor: old submaps as one quadratic cost over the nodes that remain in the graph.

Linearised at the state `at` of condensing,

    cost(x) = cost + 2 slopeᵀ d + dᵀ information d,   d = x − at (headings wrapped),

with the poses of no other factor eliminated (Schur complement): exact but for the linearisation
point and the robust weights, which stay.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Stream
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]


HISTORY = 50
"""Number of condensed submaps of each stream whose costs are stored."""
PATH_BLOCK = 64
"""Number of poses in each run of an eliminated path."""


@dataclass(frozen=True, eq=False)
class SubmapCosts:
    """Agreement of submaps with the rest of the map, oldest first: χ² should be close to dof.

    streams: of each submap. table: rows χ² without discounts; dof, dim − w tr(JᵀP⁻¹J Σ), its
    redundancy (Baarda 1968); the robust weight w; the median of χ² with `dof` degrees of freedom,
    NaN for less than one.
    """

    streams: tuple[Stream, ...] = ()
    table: Float[np.ndarray, "4 n"] = field(default_factory=lambda: np.empty((4, 0)))

    @property
    def chi2(self) -> Values:
        """χ² of each."""
        chi2: Values = self.table[0]
        return chi2

    @property
    def dof(self) -> Values:
        """Degrees of freedom of each."""
        dof: Values = self.table[1]
        return dof

    @property
    def weight(self) -> Values:
        """Robust weight of each."""
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
        """Select some, by place."""
        return SubmapCosts(tuple(self.streams[k] for k in places), self.table[:, places])

    def followed_by(self, later: "SubmapCosts") -> "SubmapCosts":
        """Append later ones."""
        return SubmapCosts(self.streams + later.streams, np.hstack([self.table, later.table]))


class EliminatedPath(NamedTuple):
    """The eliminated poses of a stream, first to last, at the state of their elimination.

    blocks: runs of PATH_BLOCK poses, the last one shorter, stored once in checkpoints. is_fixed:
    whether the first pose is a constant.
    """

    blocks: tuple[Float[np.ndarray, "_ 3"], ...]
    is_fixed: bool

    @property
    def poses(self) -> Float[np.ndarray, "K 3"]:
        """All of them."""
        return np.concatenate([np.zeros((0, 3)), *self.blocks])

    def longer(self, poses: Float[np.ndarray, "K 3"]) -> "EliminatedPath":
        """Append poses to the path."""
        whole = [each for each in self.blocks if len(each) == PATH_BLOCK]
        rest = np.concatenate([np.zeros((0, 3)), *self.blocks[len(whole) :], poses])
        runs = (rest[k : k + PATH_BLOCK].copy() for k in range(0, len(rest), PATH_BLOCK))
        return self._replace(blocks=(*whole, *runs))


class Departed(NamedTuple):
    """Statistics of the condensed factors, as of their condensing.

    robots: Σ w χ² and Σ dof of each robot. submaps: the newest costs of each stream, oldest first.
    believed: number of believed submaps of each landmark. paths: the eliminated poses.
    """

    robots: Mapping[str, tuple[float, float]]
    submaps: SubmapCosts
    believed: Mapping[int, int]
    paths: Mapping[Stream, EliminatedPath]


def select_newest(submaps: SubmapCosts) -> SubmapCosts:
    """Select the costs of the last HISTORY submaps of each stream."""
    counts, older = Counter(submaps.streams), list[int]()
    beyond = sum(max(count - HISTORY, 0) for count in counts.values())
    for place, stream in enumerate(submaps.streams):
        if len(older) == beyond:
            break
        if counts[stream] > HISTORY:
            counts[stream] -= 1
            older.append(place)
    streams = list(submaps.streams)
    for place in reversed(older):
        del streams[place]
    return SubmapCosts(tuple(streams), np.delete(submaps.table, older, axis=1))


NOBODY = Departed({}, SubmapCosts(), {}, {})


@dataclass(frozen=True, eq=False)
class Resting:
    """Landmarks that no raw submap contains, given the nodes of the condensed factor.

    x ~ N(means + gain d, covariance), d as in `Condensed`; no nodes until a submap observes them.
    ids: in the order in which they came to rest. covariance: its upper triangle, square (`upper`)
    or packed.
    """

    ids: Indices
    means: Values
    gain: Float[np.ndarray, "r n"]
    covariance: Float[np.ndarray, "r r"] | Values

    @cached_property
    def upper(self) -> Float[np.ndarray, "r r"]:
        """The upper triangle of a square matrix; the rest is not read."""
        if self.covariance.ndim == 2:
            return self.covariance
        return core.unpacked(self.covariance, len(self.means))

    @property
    def packed(self) -> "Resting":
        """The same in half the memory."""
        packed = core.packed(self.covariance) if self.covariance.ndim == 2 else self.covariance
        return replace(self, covariance=packed)

    @cached_property
    def place(self) -> Mapping[int, int]:
        """Place of each id."""
        return {id_: k for k, id_ in enumerate(self.ids.tolist())}


def make_empty_rest(numbers: int) -> Resting:
    """Make an empty `Resting` beside a condensed factor."""
    none = np.zeros(0)
    return Resting(none.astype(np.int64), none, np.zeros((0, numbers)), np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class Condensed:
    """The quadratic cost of the module's equation over `nodes`, ascending, none of them fixed.

    headings: which of its numbers are headings. submaps: number of submaps that it replaces.
    redundancy: number of measured quantities less eliminated unknowns. resting: None if there have
    never been any.
    """

    nodes: Indices
    at: Values
    headings: Bool[np.ndarray, " _"]
    information: Float[np.ndarray, "n n"]
    slope: Values
    cost: float
    submaps: int
    redundancy: int
    departed: Departed = field(default=NOBODY)
    resting: Resting | None = None

    @property
    def packed(self) -> "Condensed":
        """The same factor, to be stored."""
        return self if self.resting is None else replace(self, resting=self.resting.packed)

    def moved(self, state: Values, numbers: Indices) -> Values:
        """Difference d = state − at, headings wrapped; numbers: `Graph.boundary`."""
        d: Values = state[numbers] - self.at
        turn = d[self.headings]
        d[self.headings] = turn + 2.0 * np.pi * np.floor((np.pi - turn) / (2.0 * np.pi))
        return d

    @cached_property
    def quadratic(self) -> core.Quadratic:
        """The factor, to compute with."""
        return core.Quadratic(
            self.nodes, self.at, self.headings, self.information, self.slope, self.cost
        )


def places(offset: Indices, nodes: Indices) -> Indices:
    """Indices in the state of the numbers of some nodes."""
    sizes = offset[nodes + 1] - offset[nodes]
    first = np.repeat(offset[nodes] - np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes)
    found: Indices = first + np.arange(len(first))
    return found


def tie_nodes(
    old: Condensed, sizes: Indices, node_of: Indices, becomes: Mapping[int, int]
) -> Condensed:
    """Merge landmarks of the factor into one node: the same cost where they are equal.

    node_of: new number of each former node. becomes: that of each renumbered landmark. The
    linearisation point is that of the first merged landmark.
    """
    departed = old.departed
    if any(id_ in departed.believed for id_ in becomes):
        believed: dict[int, int] = {}
        for id_, count in departed.believed.items():
            now = becomes.get(id_, id_)
            believed[now] = believed.get(now, 0) + count
        departed = departed._replace(believed=believed)
    now = node_of[old.nodes]
    if (np.diff(now) > 0).all():
        return replace(old, nodes=now, departed=departed)
    nodes, at = np.unique(now, return_index=True)
    own = sizes[old.nodes]
    begin = np.concatenate([[0], np.cumsum(own[at])])
    to = places(begin, np.searchsorted(nodes, now))
    _, first = np.unique(to, return_index=True)
    moved = old.at[first][to] - old.at
    moved[old.headings] = 0.0
    half = dense.product(old.information, moved)
    others = np.setdiff1d(np.arange(len(to)), first)
    information = old.information[np.ix_(first, first)]
    np.add.at(information, to[others], old.information[np.ix_(others, first)])
    np.add.at(information.T, to[others], old.information[np.ix_(others, first)])
    corner = np.ix_(to[others], to[others])
    np.add.at(information, corner, old.information[np.ix_(others, others)])
    slope = np.zeros(len(first))
    np.add.at(slope, to, old.slope + half)
    return replace(
        old,
        nodes=nodes,
        at=old.at[first],
        headings=old.headings[first],
        information=information,
        slope=slope,
        cost=old.cost + float(2.0 * dense.product(old.slope, moved) + dense.product(moved, half)),
        departed=departed,
    )


def between(upper: Matrix, rows: Indices, columns: Indices) -> Float[np.ndarray, "r c"]:
    """Return some rows and columns of a symmetric matrix stored as upper triangle."""
    entries: Float[np.ndarray, "r c"] = upper[
        np.minimum.outer(rows, columns), np.maximum.outer(rows, columns)
    ]
    return entries
