"""Landmarks come to rest, and become nodes again where a submap observes them.

A landmark that no raw submap contains is, given the condensed factor's other nodes, a Gaussian
(`Resting`), eliminated like an old pose: the cost of a tick depends on the landmarks near the
robots only. The inverse is exact: with e = x − means − gain d ~ N(0, C), the quadratic gains eᵀ C⁻¹
e, and the other resting landmarks are conditioned on it.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.map_joining.condensed_factor import Resting, between, places
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.landmark_view import resting_of
from teamslam.team.estimation.map_joining.submap_graph import Graph, append_nodes
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Marks = Bool[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]

FIRST = 64
"""Number of landmarks without a raw submap from which landmarks come to rest: fewer cost less as
nodes.
"""


class Elimination(NamedTuple):
    """A quadratic A, g with `out` eliminated: x_out ~ N(step + gain d, (L Lᵀ)⁻¹).

    lowered: gᵀA⁻¹g over `out`. slope, information: over the others.
    """

    out: Marks
    lowered: float
    slope: Values
    information: Matrix
    factor: Matrix
    step: Values
    gain: Float[np.ndarray, "o n"]


def eliminate(H: Matrix, g: Values, out: Marks) -> Elimination:
    """Eliminate some numbers from a quadratic (Schur complement)."""
    remaining = ~out
    if not out.any():
        none = np.zeros((0, 0))
        return Elimination(out, 0.0, g, H, none, np.zeros(0), np.zeros((0, len(g))))
    cross = H[np.ix_(out, remaining)]
    factor = dense.cholesky(H[np.ix_(out, out)])
    solved = dense.solve_factored(factor, np.column_stack([cross, g[out]]))
    information = H[np.ix_(remaining, remaining)] - dense.product(cross.T, solved[:, :-1])
    slope: Values = g[remaining] - dense.product(cross.T, solved[:, -1])
    lowered = float(dense.product(g[out], solved[:, -1]))
    symmetric: Matrix = 0.5 * (information + information.T)
    return Elimination(out, lowered, slope, symmetric, factor, -solved[:, -1], -solved[:, :-1])


def find_idle(graph: Graph, stays: Marks, apart: Collection[int], first: int) -> Indices:
    """List the nodes of landmarks that come to rest, ascending: in no submap that stays nor in
    another island (`apart`).

    None while no landmark rests yet and fewer than `first` could.
    """
    seen = {*graph.landmark_nodes[np.repeat(stays, np.diff(graph.landmark_start))].tolist()}
    found = sorted(n for id_, n in graph.landmarks.items() if n not in seen and id_ not in apart)
    some_rest = graph.condensed is not None and graph.condensed.resting is not None
    return np.array(found if some_rest or len(found) >= first else [], np.int64)


def put_to_rest(
    island: Island, union: Indices, parts: Elimination, nodes: Indices
) -> Resting | None:
    """Make the resting landmarks, given the nodes of `union` that remain, from the eliminated
    `nodes`.
    """
    graph, old = island.graph, island.graph.condensed
    if not len(nodes) and (old is None or old.resting is None):
        return None
    before, sizes = resting_of(island), np.diff(graph.offset)[union]
    at_rest = np.isin(union, nodes if old is None else np.concatenate([old.nodes, nodes]))
    at_rest, rests = (
        np.repeat(each, sizes)[parts.out] for each in (at_rest, np.isin(union, nodes))
    )
    gain, means = np.zeros((len(before.means), len(parts.out))), before.means
    if old is not None:
        first = np.concatenate([[0], np.cumsum(sizes)])
        gain[:, places(first, np.searchsorted(union, old.nodes))] = before.gain
        means = means + dense.product(before.gain, old.moved(island.state, graph.boundary))
    on_out = np.ascontiguousarray(gain[:, parts.out][:, at_rest])
    gain = np.ascontiguousarray(gain[:, ~parts.out])
    core.add_product(on_out, np.ascontiguousarray(parts.gain[at_rest]), gain)
    root = dense.forward(parts.factor, np.eye(len(at_rest))[:, at_rest])
    covariance = dense.product(root.T, root)
    spread = dense.product(on_out, covariance)
    n, total = len(means), len(means) + 2 * len(nodes)
    upper = core.upper_and_product(before.upper, np.arange(n), total, spread, on_out.T)
    upper[:n, n:] = spread[:, rests[at_rest]]
    upper[n:, n:] = covariance[np.ix_(rests[at_rest], rests[at_rest])]
    id_of = {node: id_ for id_, node in graph.landmarks.items()}
    ids = np.array([id_of[node] for node in nodes.tolist()], np.int64)
    points = island.state[places(graph.offset, nodes)] + parts.step[rests]
    return Resting(
        np.concatenate([before.ids, ids]),
        np.concatenate([means + dense.product(on_out, parts.step[at_rest]), points]),
        np.concatenate([gain, parts.gain[rests]]),
        upper,
    )


def wake_landmarks(island: Island, ids: Collection[int]) -> Island:
    """Turn landmarks at rest into nodes again."""
    graph = island.graph
    old = graph.condensed
    if old is None or old.resting is None:
        return island
    rest = old.resting
    wakes = np.isin(rest.ids, np.array(sorted(ids), np.int64))
    if not wakes.any():
        return island
    numbers = np.repeat(wakes, 2)
    out, left = np.flatnonzero(numbers), np.flatnonzero(~numbers)
    gain, remaining = rest.gain[out], np.ascontiguousarray(rest.gain[left])
    precision = dense.inverse_of_factored(dense.cholesky(between(rest.upper, out, out)))
    weighted = dense.product(precision, gain)
    own = old.information + dense.product(gain.T, weighted)
    information = np.block([[0.5 * (own + own.T), -weighted.T], [-weighted, precision]])
    cross = between(rest.upper, left, out)
    share = dense.product(cross, precision)
    core.add_product(-share, np.ascontiguousarray(gain), remaining)
    upper = core.upper_and_product(rest.upper, left, len(left), -share, cross.T)
    points = rest.means[out] + dense.product(gain, old.moved(island.state, graph.boundary))
    grown, state, nodes = append_nodes(graph, island.state, [*points.reshape(-1, 2)])
    awake = dict(zip(rest.ids[wakes].tolist(), nodes, strict=True))
    condensed = replace(
        old,
        nodes=np.concatenate([old.nodes, nodes]),
        at=np.concatenate([old.at, rest.means[out]]),
        headings=np.concatenate([old.headings, np.zeros(len(out), np.bool_)]),
        information=information,
        slope=np.concatenate([old.slope, np.zeros(len(out))]),
        redundancy=old.redundancy + len(out),
        resting=Resting(
            rest.ids[~wakes], rest.means[left], np.concatenate([remaining, share], axis=1), upper
        ),
    )
    return replace(
        island,
        graph=replace(grown, landmarks={**graph.landmarks, **awake}, condensed=condensed),
        state=state,
    )
