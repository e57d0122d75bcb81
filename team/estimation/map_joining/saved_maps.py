"""Saved maps of earlier days in an island: tests of their landmarks, and landmarks that moved.

A saved map is a Gaussian over its landmarks in a free frame. A displacement e of landmark i lowers
the joint cost by

    χ²_i = g_iᵀ M_ii⁻¹ g_i,   g = W r,   M = W − W J Σ Jᵀ W,

with the map's residual r, information W and Jacobian J, and the island's covariance Σ; e = M_ii⁻¹
g_i with covariance M_ii⁻¹ (Baarda 1968). Without a displacement χ²_i has two degrees of freedom. A
landmark beyond the limit gets a second node, its former place, which the map alone observes. Two
submaps are needed to move an unnamed one, since one may have associated its neighbour, which is
undone.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from itertools import count
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.contribution import RobotBias, Stream, is_map, named
from teamslam.team.estimation.gaussian import deviation, information
from teamslam.team.estimation.map_joining.alignment import LEAST_AGREEING, Maps, agreeing
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.estimation.map_joining.submap_graph import (
    Graph,
    Joined,
    add_former_place,
    tie_landmarks,
)
from teamslam.team.estimation.se2 import transformed
from teamslam.team.shapes import Float

FALSE_ALARM = 1e-3  # probability that an unmoved landmark counts as moved in the final map
SEQUENTIAL = 1e-6  # the same of one test in a running map, repeated with every tick
NEGLIGIBLE = 1e-9
"""Share of a landmark's information that the rest of a map must test for a test to count."""
LEAST_SUBMAPS = 2
"""Fewest submaps that place a landmark elsewhere for it to have moved, if it has no number or its
former place is empty.
"""
REMEDY = "load the right map, or save a new one"  # for a saved map that does not join


class Displacement(NamedTuple):
    """Displacement [m] of a landmark since a saved map, in the island's frame.

    chi2: of two degrees of freedom. is_apart: it has two nodes.
    """

    landmark: int
    by: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]
    chi2: float
    is_apart: bool = False

    @property
    def sigma_m(self) -> float:
        """Standard deviation [m] of one coordinate, the mean of both."""
        return deviation(0.5 * float(np.trace(self.covariance)))


def maps_of(graph: Graph) -> list[Joined]:
    """List the saved maps of an island by name, without the station of fixes."""
    found = (
        each
        for each in graph.submaps
        if is_map(each.contribution.stream) and len(each.contribution.local.ids)
    )
    return sorted(found, key=lambda each: each.contribution.stream)


def displacements(
    island: Island, saved: Joined, among: Collection[int] | None = None
) -> list[Displacement]:
    """Estimate the displacement of each landmark of a saved map that others determine, by id.

    among: nodes to test, without those apart; None: all.
    """
    id_of = {node: id_ for id_, node in island.graph.landmarks.items()}
    nodes = saved.landmarks.tolist()
    by_others = _observed_by_others(island.graph, saved) if among is None else among
    tested = [k for k, node in enumerate(nodes) if node in by_others and node in id_of]
    found = [
        Displacement(id_of[nodes[k]], *each)
        for k, each in zip(tested, _tests(island, saved, tested), strict=True)
        if each is not None
    ]
    if among is not None:
        return sorted(found, key=lambda each: each.landmark)
    found += displacements_apart(island, saved.contribution.stream)
    return sorted(found, key=lambda each: each.landmark)


def displacements_apart(island: Island, stream: Stream) -> list[Displacement]:
    """Estimate the displacements of a saved map's landmarks with two nodes."""
    landmarks = island.graph.landmarks
    return [
        _apart(island, id_, former, landmarks[id_])
        for (of, id_), former in island.graph.former.items()
        if of == stream and id_ in landmarks
    ]


def is_confirmed(graph: Graph, saved: Joined, id_: int) -> bool:
    """Return whether LEAST_SUBMAPS other submaps, or a condensed one, observe a landmark."""
    node = graph.landmarks[id_]
    if graph.condensed is not None and (graph.condensed.nodes == node).any():
        return True
    others = (each.landmarks == node for each in graph.submaps if each is not saved)
    return sum(bool(each.any()) for each in others) >= LEAST_SUBMAPS


def _observed_by_others(graph: Graph, saved: Joined) -> set[int]:
    others = {n for each in graph.submaps if each is not saved for n in each.landmarks.tolist()}
    return others if graph.condensed is None else others | {*graph.condensed.nodes.tolist()}


def _tests(
    island: Island, saved: Joined, tested: Sequence[int]
) -> list[tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"], float] | None]:
    """Compute (displacement, covariance, χ²) of landmarks, by index in the saved map; None if
    undetermined.
    """
    if not tested:
        return []
    graph, state = island.graph, island.state
    factor = island.settings.covariance_factor
    W = saved.contribution.information[3:, 3:] / factor
    start = int(graph.offset[saved.nodes[0]])
    s, c = core.sin_and_cos(state[start + 2])
    rotation = np.array([[c, -s], [s, c]])
    at = graph.offset[saved.landmarks]
    inside = dense.product(island.points(saved.landmarks) - state[start : start + 2], rotation)
    bias_at = graph.offset[saved.nodes[len(saved.nodes) - len(saved.biases) :]]
    shifts = saved.sensitivity[:, 3:] if len(saved.biases) else np.zeros((0, len(W)))
    z = saved.contribution.local.landmarks.ravel()
    residual = z + dense.product(state[bias_at], shifts) - inside.ravel()
    g = dense.product(W, residual)
    columns = np.array([n for k in tested for n in (2 * k, 2 * k + 1)])
    own = W[:, columns]
    # Jᵀ W e: h = Rᵀ(x − t) − bᵀ S of each landmark, by landmark, start pose and biases.
    right = np.zeros((len(state), len(columns)))
    x, y = own[0::2], own[1::2]
    along = np.stack([c * x - s * y, s * x + c * y])
    np.add.at(right, at, along[0])
    np.add.at(right, at + 1, along[1])
    right[start : start + 2] -= along.sum(axis=1)
    right[start + 2] += (inside[:, 1, None] * x - inside[:, 0, None] * y).sum(axis=0)
    right[bias_at] -= dense.product(shifts, own)
    right[np.repeat(graph.fixed, np.diff(graph.offset))] = 0.0
    M = own[columns] - dense.product(right.T, island.posterior.solve(right))
    found: list[tuple[Float[np.ndarray, 2], Float[np.ndarray, "2 2"], float] | None] = []
    for k, first in zip(tested, range(0, len(columns), 2), strict=True):
        block = M[first : first + 2, first : first + 2]
        block = 0.5 * (block + block.T)
        if not _is_tested(block, own[2 * k : 2 * k + 2, first : first + 2]):
            found.append(None)
            continue
        P = information(block, "a displacement")
        e = dense.product(P, g[2 * k : 2 * k + 2])
        chi2 = float(dense.product(e, g[2 * k : 2 * k + 2]))
        found.append((-dense.product(rotation, e), dense.congruent(rotation, P), chi2))
    return found


def _is_tested(block: Float[np.ndarray, "2 2"], own: Float[np.ndarray, "2 2"]) -> bool:
    scale, trace = NEGLIGIBLE * float(np.trace(own)), float(block[0, 0] + block[1, 1])
    determinant = float(block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0])
    return bool(block[0, 0] > scale and block[1, 1] > scale) and determinant > scale * trace


def _apart(island: Island, id_: int, former: int, present: int) -> Displacement:
    mean, P = joint_marginal(island, [former, present])
    by = mean[2:] - mean[:2]
    covariance = P[:2, :2] + P[2:, 2:] - P[:2, 2:] - P[2:, :2]
    metric = information(covariance, f"the displacement of landmark {id_}")
    return Displacement(id_, by, covariance, dense.quadratic(metric, by), is_apart=True)


def separate(island: Island, saved: Joined, ids: Iterable[int]) -> Island:
    """Add a node for the former place of landmarks of a saved map."""
    graph, state = island.graph, island.state
    stream = saved.contribution.stream
    nodes = {node: k for k, node in enumerate(saved.landmarks.tolist())}
    by_others = _observed_by_others(graph, saved)
    start = island.value(int(saved.nodes[0]))
    for id_ in sorted(ids):
        node = graph.landmarks[id_]
        value = transformed(start, saved.contribution.local.landmarks[nodes[node]])
        graph, state = add_former_place(graph, state, stream, id_, value, shared=node in by_others)
    return replace(island, graph=graph, state=state)


def dissociate(island: Island, saved: Joined, id_: int) -> Island:
    """Assign the other submaps' place of a saved map's landmark to a new unnamed landmark."""
    apart = separate(island, saved, [id_])
    former = dict(apart.graph.former)
    place = former.pop((saved.contribution.stream, id_))
    landmarks = dict(apart.graph.landmarks)
    other = next(number for number in count(UNNAMED) if number not in landmarks)
    landmarks |= {id_: place, other: landmarks[id_]}
    return replace(apart, graph=replace(apart.graph, landmarks=landmarks, former=former))


def reunite(island: Island, stream: Stream, id_: int) -> Island:
    """Tie a landmark's former place to its present one."""
    graph = island.graph
    former = {at: node for at, node in graph.former.items() if at != (stream, id_)}
    node = graph.former[stream, id_]
    aside = max([*graph.landmarks, 0]) + 1
    landmarks = {**graph.landmarks, aside: node}
    graph = replace(graph, former=former, landmarks=landmarks)
    graph, state = tie_landmarks(graph, island.state, {aside: id_})
    return replace(island, graph=graph, state=state)


def next_change(
    island: Island, chance: float, nodes: Collection[int] | None = None
) -> tuple[Joined, Displacement] | None:
    """Find the landmark that disagrees most with its place in a saved map, beyond chance.

    nodes: those to test in a running map.
    """
    limit, graph = chi2_limit(2, chance), island.graph
    found = [
        (each.chi2, saved, each)
        for saved in maps_of(graph)
        for each in displacements(island, saved, nodes)
        if not each.is_apart and each.chi2 > limit
        if nodes is None or each.landmark < UNNAMED or is_confirmed(graph, saved, each.landmark)
    ]
    if not found:
        return None
    _, saved, worst = max(found, key=lambda each: each[0])
    return saved, worst


def returned(island: Island, chance: float) -> list[tuple[Stream, int]]:
    """List the landmarks apart whose two places agree within chance."""
    limit = chi2_limit(2, chance)
    return [
        (saved.contribution.stream, each.landmark)
        for saved in maps_of(island.graph)
        for each in displacements(island, saved)
        if each.is_apart and each.chi2 <= limit
    ]


class Replaced(NamedTuple):
    """Error of a robot that differs from a saved map; chi2: one degree of freedom."""

    error: RobotBias
    saved: Stream
    value: float
    before: float
    chi2: float


def replaced_sensors(island: Island) -> list[Replaced]:
    """List the robots' errors that differ from a saved map beyond chance."""
    graph, limit = island.graph, chi2_limit(1, FALSE_ALARM)
    saved_at = {node: of for of, node in graph.remembered.items()}
    found = []
    for prior in graph.priors if saved_at else ():
        if not prior.is_of_robot or len(prior.nodes) == 1:
            continue
        (value, before), P = joint_marginal(island, prior.nodes)
        by = float(value - before)
        chi2 = by * by / float(P[0, 0] + P[1, 1] - 2.0 * P[0, 1])
        if chi2 > limit:
            stream, error = saved_at[prior.nodes[1]]
            found.append(Replaced(error, stream, float(value), float(before), chi2))
    return found


def contradiction(island: Island) -> tuple[Stream, str] | None:
    """Find a saved map with most of today's landmarks elsewhere; return the reason."""
    for saved in maps_of(island.graph):
        stream = saved.contribution.stream
        moved = sum(of == stream for of, _ in island.graph.former)
        nodes = {*saved.landmarks.tolist()} & {*island.graph.landmarks.values()}
        same = len(nodes & _observed_by_others(island.graph, saved))
        if moved >= LEAST_AGREEING and moved >= same:
            return stream, (
                f"{moved} of its {moved + same} landmarks that were seen today are elsewhere: it "
                "is the map of another place, or half of the place has changed"
            )
    return None


def disagreeing(
    main: Island, other: Island, ids: Sequence[int], confidence: float
) -> list[int] | str:
    """Find the landmarks that moved between two islands, one with a saved map, or return the reason
    if no more than half agree within `confidence`.
    """
    a, A = joint_marginal(main, [main.graph.landmarks[id_] for id_ in ids])
    b, B = joint_marginal(other, [other.graph.landmarks[id_] for id_ in ids])
    maps = Maps(a.reshape(-1, 2), A, b.reshape(-1, 2), B)
    agree = agreeing(maps, chi2_limit(2, 1.0 - confidence))
    same = int(agree.sum())
    if same < LEAST_AGREEING or 2 * same <= len(ids):
        of = next(each for island in (main, other) for each in maps_of(island.graph))
        return (
            f"{len(ids)} shared landmarks disagree: of {named(of.contribution.stream)} no more "
            f"than {same} are at one place; it is the map of another site, or half of the site has "
            f"changed: {REMEDY}"
        )
    return [id_ for id_, is_same in zip(ids, agree.tolist(), strict=True) if not is_same]
