"""The factor graph of one frame, without its state: poses, landmarks, biases; submaps, inter-robot
measurements, priors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED, Bias
from teamslam.team.estimation.contribution import (
    RANGE_POWER,
    STATION,
    Contribution,
    InitialPoseFactor,
    Key,
    RobotBias,
    Stream,
    first_of,
    is_map,
    named,
)
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.condensed import (
    NO_COUNTS,
    NOBODY,
    NOTHING,
    Condensed,
    Departed,
    Memory,
    Observed,
)
from teamslam.team.estimation.se2 import compose, transformed
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
K = TypeVar("K")


CommonBias = Bias | Literal["marker"]
"""Errors that the team has in common: of all sensors, or of each landmark's marker."""
CommonError = Bias | int
"""A bias of all sensors, or, by a landmark's number, the share of the range by which all robots
measure that landmark too far.
"""
SharedError = CommonError | RobotBias
"""An error of a submap: a bias, a marker's, or in a saved map one of a robot on its days."""
DRIFT: Mapping[Bias, float] = MappingProxyType(
    {"forward_scale": 0.2, "range_offset": 0.1, "range_scale": 0.1}
)
"""Scale of a robot's bias on another day about that of a saved map, in scales of its prior.

Optics and electronics of ranges age over months; the driven distance changes with tyres, load and
floor. Clock offsets and bearings are not carried over: a clock is set at each start, and remounting
turns a sensor by more than the prior's scale. By Student's t a replaced sensor loses the tie.
"""
NONE_IN_COMMON: Mapping[CommonBias, float] = MappingProxyType({})
NO_NUMBERS: Mapping[Key, Sequence[int]] = MappingProxyType({})


class Prior(NamedTuple):
    """A pose (x, y, theta), or biases jointly, ~ N(mean, information⁻¹).

    rank: of the information, singular for a difference of biases. is_of_robot: one robot's bias,
    with the loss of Student's t.
    """

    nodes: tuple[int, ...]
    mean: Float[np.ndarray, " k"]
    information: Float[np.ndarray, "k k"]
    rank: int
    is_of_robot: bool = False

    @property
    def is_of_pose(self) -> bool:
        """Whether the prior is of a pose."""
        return len(self.mean) > len(self.nodes)

    @classmethod
    def of_bias(cls, node: int, sigma: float, *, is_of_robot: bool = False) -> "Prior":
        """Make the prior of a bias about 0."""
        certainty = np.array([[1.0 / core.squared(sigma)]])
        return cls((node,), np.zeros(1), certainty, 1, is_of_robot)


class Joined(NamedTuple):
    """A submap in the graph: its start, end and pose nodes, landmarks by id, biases; its factor.

    biases: of the rows of `sensitivity`, ∂mean/∂b, the team's last. A marker's row is that of the
    ranges' scale, for its landmark alone.
    """

    contribution: Contribution
    nodes: Indices
    biases: tuple[SharedError, ...]
    sensitivity: Float[np.ndarray, "B _"]
    factor: core.SubmapFactor

    @classmethod
    def of(
        cls,
        contribution: Contribution,
        nodes: Indices,
        own: tuple[Bias, ...],
        common: tuple[CommonError, ...],
    ) -> "Joined":
        """Make a submap with errors of single robots in a saved map, its own, and the team's.

        Raises NotACovarianceError.
        """
        biases = (*own, *common)
        rows = _sensitivity(contribution.local, biases)
        if contribution.own.errors:
            rows = np.vstack([contribution.by_own, rows]) if biases else contribution.by_own
        return cls.with_rows(contribution, nodes, (*contribution.own.errors, *biases), rows)

    @classmethod
    def with_rows(
        cls,
        contribution: Contribution,
        nodes: Indices,
        biases: tuple[SharedError, ...],
        sensitivity: Float[np.ndarray, "B _"],
    ) -> "Joined":
        """Make a submap with these errors."""
        factor = contribution.factor
        if biases != contribution.local.biases:
            powers = [RANGE_POWER[_scaling(each)] for each in biases]
            curvature = _curvature(contribution.local, biases, sensitivity)
            factor = factor.with_errors(sensitivity, np.array(powers, np.int64), curvature)
        return cls(contribution, nodes, biases, sensitivity, factor)

    @property
    def landmarks(self) -> Indices:
        """Nodes of the submap's landmarks, in its order."""
        local = self.contribution.local
        first = 2 + len(local.node_stamps)
        return self.nodes[first : first + len(local.ids)]


def _sensitivity(local: LocalMap, biases: Sequence[CommonError]) -> Float[np.ndarray, "B _"]:
    if tuple(biases) == local.biases:
        return local.sensitivity
    rows = local.sensitivity[[local.biases.index(_scaling(error)) for error in biases]]
    first = len(local.mean) - 2 * len(local.ids)
    for row, error in zip(rows, biases, strict=True):
        if isinstance(error, int):
            at = first + 2 * int(np.searchsorted(local.ids, error))
            row[:at] = row[at + 2 :] = 0.0
    return rows


def _curvature(
    local: LocalMap, biases: Sequence[SharedError], sensitivity: Float[np.ndarray, "B _"]
) -> Float[np.ndarray, "B _"]:
    rows = np.zeros_like(sensitivity)
    for at, error in enumerate(biases):
        if isinstance(error, str) and biases.count(error) == 1:
            rows[at] = local.curvature[local.biases.index(error)]
    return rows


def _scaling(error: SharedError) -> Bias:
    if isinstance(error, RobotBias):
        return error.bias
    return "range_scale" if isinstance(error, int) else error


class Encounter(NamedTuple):
    """An inter-robot measurement between the pose nodes of observer and teammate."""

    sighting: InterRobotFactor
    observer: int
    teammate: int


@dataclass(frozen=True, eq=False)
class Graph:
    """The nodes in the order of their addition, and the factors between them.

    streams: start, then end pose of submap 0, 1, … of each stream. landmarks: node of each id.
    poses: further poses by (stream, stamp). biases, common: errors that a stream's submaps, or all
    streams, share. remembered: a robot's errors on the days of a saved map. former: old place of a
    moved landmark, by (saved map, id). offset: of each node in the state, then its length. fixed:
    exact initial poses, the gauge. condensed: the quadratic that replaces older submaps
    (`condensing`). gone: first sequence after them. memory: their observations.
    """

    streams: Mapping[Stream, tuple[int, ...]]
    landmarks: Mapping[int, int]
    poses: Mapping[tuple[Stream, int], int]
    biases: Mapping[tuple[Stream, Bias], int]
    offset: Indices
    fixed: Bool[np.ndarray, " _"]
    submaps: tuple[Joined, ...]
    sightings: tuple[Encounter, ...]
    priors: tuple[Prior, ...]
    common: Mapping[CommonError, int] = field(default_factory=dict)
    remembered: Mapping[tuple[Stream, RobotBias], int] = field(default_factory=dict)
    condensed: Condensed | None = None
    gone: Mapping[Stream, int] = field(default_factory=dict)
    former: Mapping[tuple[Stream, int], int] = field(default_factory=dict)
    memory: Memory = NOTHING

    @cached_property
    def observed(self) -> tuple[Observed, ...]:
        """Submaps for data association, stored condensed ones first."""
        own = (
            Observed(each.contribution.observation, each.landmarks, NO_COUNTS)
            for each in self.submaps
        )
        return (*self.memory.submaps, *own)

    @cached_property
    def factors(self) -> core.SubmapGraph:
        """Factors in the core's form."""
        return core.SubmapGraph(
            self.offset,
            self.fixed,
            [(each.factor, each.nodes) for each in self.submaps],
            [(a, b, x.measurement, x.information, x.point) for x, a, b in self.sightings],
            [(np.array(x.nodes), x.mean, x.information, x.is_of_robot) for x in self.priors],
            None if self.condensed is None else self.condensed.factor,
        )

    @cached_property
    def pattern(self) -> core.Pattern:
        """Blocks of the normal equations, a variable per node."""
        return self.factors.pattern

    @cached_property
    def saved_maps(self) -> Indices:
        """Indices of the submaps that are saved maps."""
        return np.flatnonzero([is_map(each.contribution.stream) for each in self.submaps])

    @cached_property
    def landmark_start(self) -> Indices:
        """First landmark of each submap among all, and their number."""
        return _starts([len(each.contribution.local.ids) for each in self.submaps])

    @cached_property
    def landmark_nodes(self) -> Indices:
        """Nodes of the landmarks of all submaps."""
        return np.concatenate([np.zeros(0, np.int64), *(each.landmarks for each in self.submaps)])

    @cached_property
    def dimensions(self) -> Indices:
        """Dimension of each submap."""
        return np.array([len(each.contribution.local.mean) for each in self.submaps], np.int64)

    @cached_property
    def headings(self) -> Indices:
        """Indices of the headings in the state."""
        headings: Indices = self.offset[:-1][np.diff(self.offset) == 3] + 2
        return headings

    def next_sequence(self, stream: Stream) -> int:
        """Return the sequence number of a stream's next submap."""
        return self.first_sequence(stream) + len(self.streams[stream]) - 1

    def first_sequence(self, stream: Stream) -> int:
        """Return the sequence number of a stream's first raw submap."""
        return self.gone.get(stream, first_of(stream))

    @property
    def departed(self) -> Departed:
        """Statistics of the condensed factors."""
        return NOBODY if self.condensed is None else self.condensed.departed

    @property
    def size(self) -> int:
        """Number of submaps, condensed ones included."""
        return len(self.submaps) + (0 if self.condensed is None else self.condensed.submaps)

    @property
    def unknowns(self) -> int:
        """Number of estimated quantities."""
        return int(np.diff(self.offset)[~self.fixed].sum())

    def name(self, node: int) -> str:
        """Name a node in messages."""
        names = {at: f"landmark {id_}" for id_, at in self.landmarks.items()}
        for error, at in self.common.items():
            kind = "marker" if isinstance(error, int) else "bias"
            names[at] = f"the {kind} {error} of the team"
        for (stream, (robot, bias)), at in self.remembered.items():
            names[at] = f"the bias {bias} of {robot} in {named(stream)}"
        for (stream, bias), at in self.biases.items():
            names[at] = f"the bias {bias} of {named(stream)}"
        for (stream, id_), at in self.former.items():
            names[at] = f"the place of landmark {id_} in {named(stream)}"
        for (stream, stamp_ns), at in self.poses.items():
            names[at] = f"the pose of {named(stream)} at {stamp_ns * 1e-9:g} s"
        for stream, (start, *ends) in self.streams.items():
            names[start] = f"the start of {named(stream)}"
            for sequence, at in enumerate(ends, self.first_sequence(stream)):
                names[at] = f"the end of submap {sequence} of {named(stream)}"
        return names.get(node, "a split node")


EMPTY_GRAPH = Graph(
    streams={},
    landmarks={},
    poses={},
    biases={},
    offset=np.zeros(1, np.int64),
    fixed=np.zeros(0, np.bool_),
    submaps=(),
    sightings=(),
    priors=(),
)


def _starts(lengths: Sequence[int]) -> Indices:
    return np.cumsum(np.array([0, *lengths], dtype=np.int64))


class _Growth:
    """A graph that is being extended: new nodes come after all others."""

    def __init__(self, graph: Graph, state: Values, bias_sigma: Mapping[Bias, float]) -> None:
        self.graph, self.state, self.bias_sigma = graph, state, bias_sigma
        self.streams = dict(graph.streams)
        self.landmarks = dict(graph.landmarks)
        self.poses = dict(graph.poses)
        self.biases = dict(graph.biases)
        self.common = dict(graph.common)
        self.remembered = dict(graph.remembered)
        self.submaps = list(graph.submaps)
        self.priors = list(graph.priors)
        self.values: list[Values] = []
        self.fixed: list[bool] = []

    def value(self, node: int, size: int) -> Values:
        before = len(self.graph.fixed)
        if node >= before:
            return self.values[node - before]
        return self.state[self.graph.offset[node] : self.graph.offset[node] + size]

    def add(self, value: Values, *, fixed: bool = False) -> int:
        self.values.append(value)
        self.fixed.append(fixed)
        return len(self.graph.fixed) + len(self.values) - 1

    def add_stream(self, stream: Stream, start: InitialPoseFactor | None) -> None:
        start = InitialPoseFactor(*stream, np.zeros(3)) if start is None else start
        node = self.add(start.pose, fixed=start.covariance is None)
        self.streams[stream] = (node,)
        if start.information is not None:
            self.priors.append(Prior((node,), start.pose, start.information, 3))

    def add_error(
        self, among: dict[K, int], error: K, sigma: float, *, is_of_robot: bool = False
    ) -> int:
        """Return the node of an error that submaps share, with its prior where it is new."""
        if error not in among:
            among[error] = self.add(np.zeros(1))
            self.priors.append(Prior.of_bias(among[error], sigma, is_of_robot=is_of_robot))
        return among[error]

    def add_remembered(self, contribution: Contribution) -> list[int]:
        """Add the errors of single robots in a saved map, with their evidence."""
        own, stream = contribution.own, contribution.stream
        nodes = [self.add(mean[None]) for mean in own.mean]
        for error, node in zip(own.errors, nodes, strict=True):
            self.remembered[stream, error] = node
            sigma = self.bias_sigma[error.bias]
            self.priors.append(Prior.of_bias(node, sigma, is_of_robot=True))
        biases = contribution.local.biases
        shared = [self.common[b] if b in self.common else self.biases[stream, b] for b in biases]
        both = (*shared, *nodes)
        self.priors.append(Prior(both, own.likeliest, own.evidence, len(both)))
        return nodes

    def grown(self) -> tuple[Graph, Values]:
        grown, state, _ = append_nodes(self.graph, self.state, self.values, self.fixed)
        grown = replace(
            grown,
            streams=self.streams,
            landmarks=self.landmarks,
            poses=self.poses,
            biases=self.biases,
            submaps=tuple(self.submaps),
            priors=tuple(self.priors),
            common=self.common,
            remembered=self.remembered,
        )
        return _tie_biases(grown), state


def add_submaps(
    graph: Graph,
    state: Values,
    contributions: Sequence[Contribution],
    starts: Mapping[Stream, InitialPoseFactor],
    bias_sigma: Mapping[Bias, float],
    common_bias_sigma: Mapping[CommonBias, float] = NONE_IN_COMMON,
    numbers: Mapping[Key, Sequence[int]] = NO_NUMBERS,
) -> tuple[Graph, Values]:
    """Add submaps to a graph, in order.

    A new pose is start ∘ local pose; the first submap with a landmark places it. A stream without
    an initial pose is fixed at (0, 0, 0), the gauge. A bias has scale bias_sigma about 0 (without
    one the submap's biases are dropped), a common error is N(0, common_bias_sigma²). numbers: the
    team's, of unnamed landmarks.
    """
    growth = _Growth(graph, state, bias_sigma)
    for contribution in (_drop_unscaled_biases(each, bias_sigma) for each in contributions):
        stream, local = contribution.stream, contribution.local
        if stream not in growth.streams:
            growth.add_stream(stream, starts.get(stream))
        start_node = growth.streams[stream][-1]
        map_from_start = growth.value(start_node, 3)
        end_node = growth.add(compose(map_from_start, local.end_pose))
        growth.streams[stream] = (*growth.streams[stream], end_node)
        poses = [growth.add(compose(map_from_start, node)) for node in local.nodes]
        for stamp_ns, node in zip(local.node_stamps.tolist(), poses, strict=True):
            growth.poses[stream, stamp_ns] = node
        ids = numbers.get(contribution.key) or local.ids.tolist()
        for id_, point in zip(ids, local.landmarks, strict=True):
            if id_ not in growth.landmarks:
                growth.landmarks[id_] = growth.add(transformed(map_from_start, point))
        seen = [growth.landmarks[id_] for id_ in ids]
        common = _common_errors(contribution, common_bias_sigma)
        own = local.biases
        if is_map(stream):
            own = tuple(bias for bias in own if bias not in common)
        errors = [
            growth.add_error(growth.biases, (stream, bias), bias_sigma[bias], is_of_robot=True)
            for bias in own
        ]
        errors += [growth.add_error(growth.common, *each) for each in common.items()]
        if contribution.own.errors:
            errors = growth.add_remembered(contribution) + errors
        nodes = np.array([start_node, end_node, *poses, *seen, *errors])
        growth.submaps.append(Joined.of(contribution, nodes, own, tuple(common)))
    return growth.grown()


def _tie_biases(graph: Graph) -> Graph:
    """Tie each robot's biases to those of its name in the first saved map by name.

    b = b₁ + d with the drift d of scale DRIFT, Student's t like the prior, which b₁ has instead.
    """
    if not graph.remembered:
        return graph
    before: dict[RobotBias, int] = {}
    for (_, saved), node in sorted(graph.remembered.items()):
        if saved.bias in DRIFT:
            before.setdefault(saved, node)
    error_of = {node: RobotBias(stream[0], bias) for (stream, bias), node in graph.biases.items()}
    priors = []
    for prior in graph.priors:
        error = error_of.get(prior.nodes[0])
        if error is None or len(prior.nodes) > 1 or error not in before:
            priors.append(prior)
            continue
        certainty = prior.information[0, 0] / core.squared(DRIFT[error.bias])
        W = certainty * np.array([[1.0, -1.0], [-1.0, 1.0]])
        nodes = *prior.nodes, before[error]
        priors.append(Prior(nodes, np.zeros(2), W, 1, is_of_robot=True))
    return replace(graph, priors=tuple(priors))


def _drop_unscaled_biases(
    contribution: Contribution, bias_sigma: Mapping[Bias, float]
) -> Contribution:
    if contribution.own.errors or bias_sigma.keys() >= {*contribution.local.biases}:
        return contribution
    return replace(contribution, local=contribution.local.without_biases)


def _common_errors(
    contribution: Contribution, common_bias_sigma: Mapping[CommonBias, float]
) -> dict[CommonError, float]:
    """Return the common errors of a submap with their sigmas, without unnamed markers
    (`markers`).
    """
    local = contribution.local
    found: dict[CommonError, float] = {
        bias: common_bias_sigma[bias] for bias in local.biases if bias in common_bias_sigma
    }
    of_marker = common_bias_sigma.get("marker")
    has_markers = "range_scale" in local.biases and not is_map(contribution.stream)
    if of_marker is not None and has_markers:
        found |= dict.fromkeys((id_ for id_ in local.ids.tolist() if id_ < UNNAMED), of_marker)
    return found


def remove_nodes(
    graph: Graph,
    eliminated: Bool[np.ndarray, " _"],
    submaps: Bool[np.ndarray, " F"],
    sightings: Bool[np.ndarray, " S"],
    priors: Bool[np.ndarray, " _"],
) -> Graph:
    """Remove eliminated poses (a stream's first) and landmarks; keep the marked factors, no
    condensed one.
    """
    node_of = np.where(eliminated, -1, np.cumsum(~eliminated) - 1)
    streams, gone = {}, dict(graph.gone)
    for stream, nodes in graph.streams.items():
        first = int(eliminated[[*nodes]].sum())
        streams[stream] = nodes[first:]
        gone[stream] = graph.first_sequence(stream) + first
    left = replace(
        graph,
        streams=streams,
        submaps=tuple(compress(graph.submaps, submaps)),
        sightings=tuple(compress(graph.sightings, sightings)),
        priors=tuple(compress(graph.priors, priors)),
        condensed=None,
        gone=gone,
    )
    return _renumber_nodes(left, node_of, ~eliminated)


def _renumber_nodes(graph: Graph, node_of: Indices, stays: Bool[np.ndarray, " _"]) -> Graph:
    """Renumber the nodes of a graph, except in condensed factors.

    node_of: new number of each node, −1 for a dropped one. stays: origins of the new nodes,
    ascending.
    """
    new = node_of.tolist()

    def renamed(nodes: Mapping[K, int]) -> dict[K, int]:
        return {key: new[node] for key, node in nodes.items() if new[node] >= 0}

    return replace(
        graph,
        streams={s: tuple(new[node] for node in nodes) for s, nodes in graph.streams.items()},
        landmarks=renamed(graph.landmarks),
        poses=renamed(graph.poses),
        former=renamed(graph.former),
        biases=renamed(graph.biases),
        common=renamed(graph.common),
        remembered=renamed(graph.remembered),
        offset=_starts(np.diff(graph.offset)[stays].tolist()),
        fixed=graph.fixed[stays],
        submaps=tuple(each._replace(nodes=node_of[each.nodes]) for each in graph.submaps),
        sightings=tuple(Encounter(seen, new[a], new[b]) for seen, a, b in graph.sightings),
        priors=tuple(
            each._replace(nodes=tuple(new[node] for node in each.nodes)) for each in graph.priors
        ),
        memory=graph.memory.renumbered(node_of),
    )


def append_nodes(
    graph: Graph, state: Values, values: Sequence[Values], fixed: Sequence[bool] = ()
) -> tuple[Graph, Values, range]:
    """Append nodes without factors; return the graph, the state and the nodes."""
    marks = np.array(fixed or [False] * len(values), np.bool_)
    grown = replace(
        graph,
        offset=np.concatenate([graph.offset[:-1], graph.offset[-1] + _starts([*map(len, values)])]),
        fixed=np.concatenate([graph.fixed, marks]),
    )
    nodes = range(len(graph.fixed), len(grown.fixed))
    return grown, np.concatenate([state, *values]), nodes


def add_former_place(
    graph: Graph, state: Values, stream: Stream, id_: int, value: Values, *, shared: bool
) -> tuple[Graph, Values]:
    """Separate a landmark's place in a saved map, `value`, from its present one; without other
    observations (not `shared`) there is no present one.
    """
    node = graph.landmarks[id_]
    if not shared:
        landmarks = {each: at for each, at in graph.landmarks.items() if each != id_}
        former = {**graph.former, (stream, id_): node}
        return replace(graph, landmarks=landmarks, former=former), state
    grown, state, (new,) = append_nodes(graph, state, [value])
    submaps = tuple(
        each._replace(nodes=np.where(each.nodes == node, new, each.nodes))
        if each.contribution.stream == stream
        else each
        for each in graph.submaps
    )
    return replace(grown, submaps=submaps, former={**graph.former, (stream, id_): new}), state


def pose_node(graph: Graph, robot: str, stamp_ns: int) -> int | None:
    """Return the robot's pose node at a stamp."""
    incarnations = sorted(incarnation for name, incarnation in graph.streams if name == robot)
    found = (graph.poses.get(((robot, incarnation), stamp_ns)) for incarnation in incarnations)
    return next((node for node in found if node is not None), None)


def encounter_of(graph: Graph, sighting: InterRobotFactor) -> Encounter | None:
    """Tie the inter-robot measurement to its nodes; None while one is missing."""
    observer, teammate = observer_of(graph, sighting), teammate_of(graph, sighting)
    return None if observer is None or teammate is None else Encounter(sighting, observer, teammate)


def observer_of(graph: Graph, sighting: InterRobotFactor) -> int | None:
    """Return the observer's node, the station's for a fix."""
    if sighting.is_fix:
        return graph.streams[STATION][0] if STATION in graph.streams else None
    return graph.poses.get((sighting.stream, sighting.stamp_ns))


def teammate_of(graph: Graph, sighting: InterRobotFactor) -> int | None:
    """Return the node of the measured pose."""
    if sighting.is_fix:
        return graph.poses.get((sighting.stream, sighting.stamp_ns))
    return pose_node(graph, sighting.teammate, sighting.stamp_ns)


def merge_graphs(
    main: Graph,
    state: Values,
    other: Graph,
    other_state: Values,
    main_from_other: Float[np.ndarray, "3"],
) -> tuple[Graph, Values]:
    """Join both graphs in the main frame; equal ids become one landmark, at the main graph's value.

    No submap of the other may be condensed, since its gauge becomes free.
    """
    assert other.condensed is None, "a condensed factor is linearised in its own frame"
    node_of = np.full(len(other.fixed), -1)
    for id_ in main.landmarks.keys() & other.landmarks.keys():
        node_of[other.landmarks[id_]] = main.landmarks[id_]
    for bias in main.common.keys() & other.common.keys():
        node_of[other.common[bias]] = main.common[bias]
    moves = node_of < 0
    node_of[moves] = len(main.fixed) + np.arange(moves.sum())
    parts = np.split(other_state, other.offset[1:-1])
    values = [_transform_value(main_from_other, each) for each in compress(parts, moves)]
    moved = _renumber_nodes(other, node_of, np.ones(len(other.fixed), np.bool_))
    kept = [
        not prior.is_of_pose and (len(prior.nodes) > 1 or moves[prior.nodes[0]])
        for prior in other.priors
    ]
    grown, joint, _ = append_nodes(main, state, values)
    graph = replace(
        grown,
        streams={**main.streams, **moved.streams},
        landmarks={**moved.landmarks, **main.landmarks},
        poses={**main.poses, **moved.poses},
        biases={**main.biases, **moved.biases},
        submaps=(*main.submaps, *moved.submaps),
        sightings=(*main.sightings, *moved.sightings),
        priors=(*main.priors, *compress(moved.priors, kept)),
        common={**moved.common, **main.common},
        remembered={**main.remembered, **moved.remembered},
        gone={**main.gone, **other.gone},
        former={**main.former, **moved.former},
    )
    return _tie_biases(graph), joint


def tie_landmarks(graph: Graph, state: Values, becomes: Mapping[int, int]) -> tuple[Graph, Values]:
    """Renumber landmarks; equal new numbers become one node, at the first's value."""
    first: dict[int, int] = {}
    remaining = np.ones(len(graph.fixed), np.bool_)
    stands_for = np.arange(len(graph.fixed))
    for id_, node in sorted(graph.landmarks.items(), key=lambda each: each[1]):
        number = becomes.get(id_, id_)
        stands_for[node] = first.setdefault(number, node)
        remaining[node] = stands_for[node] == node
    node_of = (np.cumsum(remaining) - 1)[stands_for]
    sizes, old = np.diff(graph.offset), graph.condensed
    renamed = replace(
        graph,
        landmarks=first,
        condensed=None if old is None else old.tied(sizes, node_of, becomes),
    )
    return _renumber_nodes(renamed, node_of, remaining), state[np.repeat(remaining, sizes)]


def _transform_value(main_from_other: Float[np.ndarray, "3"], value: Values) -> Values:
    if len(value) == 3:
        return compose(main_from_other, value)
    return transformed(main_from_other, value) if len(value) == 2 else value
