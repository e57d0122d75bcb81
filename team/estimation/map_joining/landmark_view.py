"""Landmarks of an island by id, nodes and those at rest alike.

For a landmark at rest, x = means + gain d + e with e ~ N(0, C): Cov(x, z) = gain Cov(d, z) and
Cov(x, x') = C + gain Cov(d, d) gainᵀ.
"""

from collections.abc import Sequence

import numpy as np

from teamslam.team.estimation import dense
from teamslam.team.estimation.map_joining.condensed_factor import (
    Resting,
    between,
    make_empty_rest,
    places,
)
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]


def known(island: Island) -> list[int]:
    """List the ids of all landmarks, ascending."""
    return sorted([*island.graph.landmarks, *resting_of(island).ids.tolist()])


def resting_of(island: Island) -> Resting:
    """Return the landmarks at rest, perhaps none."""
    old = island.graph.condensed
    if old is None:
        return make_empty_rest(0)
    return make_empty_rest(len(old.at)) if old.resting is None else old.resting


def points_of(island: Island, ids: Sequence[int]) -> Float[np.ndarray, "L 2"]:
    """Return the positions [m] of landmarks."""
    points = np.empty((len(ids), 2))
    awake, nodes, at = _sorted_out(island, ids)
    points[awake] = island.state[places(island.graph.offset, nodes)].reshape(-1, 2)
    if len(at):
        points[~awake] = island.resting_points[at]
    return points


def blocks_of(island: Island, ids: Sequence[int]) -> Float[np.ndarray, "L 2 2"]:
    """Return the own covariance [m²] of each landmark."""
    blocks = np.empty((len(ids), 2, 2))
    awake, nodes, at = _sorted_out(island, ids)
    pattern = island.graph.pattern
    begin = pattern.value_start[pattern.column_start[nodes]]
    own = island.selected_covariance[begin[:, None] + np.arange(4)].reshape(-1, 2, 2)
    own[island.graph.fixed[nodes]] = 0.0
    blocks[awake] = own
    if len(at):
        blocks[~awake] = island.resting_blocks[at]
    return blocks


def joint(
    island: Island, nodes: Sequence[int], ids: Sequence[int]
) -> tuple[Values, Float[np.ndarray, "n n"]]:
    """Compute mean and joint covariance of nodes and landmarks."""
    return joints(island, [(nodes, ids)])[0]


def joints(
    island: Island, groups: Sequence[tuple[Sequence[int], Sequence[int]]]
) -> list[tuple[Values, Float[np.ndarray, "n n"]]]:
    """Compute `joint` of several groups with one solution."""
    parts = [_sorted_out(island, ids) for _, ids in groups]
    members = [
        np.concatenate([np.array(nodes, np.int64), own])
        for (nodes, _), (_, own, _) in zip(groups, parts, strict=True)
    ]
    union = np.unique(np.concatenate(members))
    sizes = np.diff(island.graph.offset)[union]
    first = np.concatenate([[0], np.cumsum(sizes)])
    if any(len(at) for *_, at in parts):
        covariance, with_boundary = _beside_boundary(island, union)
    else:
        covariance, with_boundary = joint_marginal(island, union.tolist())[1], None
    found = []
    for (awake, own, at), of_group in zip(parts, members, strict=True):
        rows = places(first, np.searchsorted(union, of_group))
        mean = island.state[places(island.graph.offset, of_group)]
        matrix = covariance[np.ix_(rows, rows)]
        if with_boundary is not None and len(at):
            mean = np.concatenate([mean, island.resting_points[at].ravel()])
            matrix = _with_resting(island, matrix, with_boundary[rows], at)
            start = len(rows) - 2 * len(own)
            order = np.empty(len(awake), np.int64)
            order[awake], order[~awake] = np.arange(len(own)), len(own) + np.arange(len(at))
            chosen = np.arange(len(mean))
            chosen[start:] = (start + 2 * order[:, None] + np.arange(2)).ravel()
            mean, matrix = mean[chosen], matrix[np.ix_(chosen, chosen)]
        found.append((mean, matrix))
    return found


def _with_resting(
    island: Island, covariance: Matrix, with_boundary: Float[np.ndarray, "n b"], at: Indices
) -> Float[np.ndarray, "m m"]:
    """Extend a joint covariance by landmarks at rest.

    with_boundary: its covariance with the nodes of the condensed factor.
    """
    rest = resting_of(island)
    numbers = places(2 * np.arange(len(rest.ids) + 1), at)
    cross = dense.product(rest.gain[numbers], with_boundary.T)
    spread = island.resting_spread[numbers]
    among = dense.product(spread, spread.T) + between(rest.upper, numbers, numbers)
    return np.block([[covariance, cross.T], [cross, 0.5 * (among + among.T)]])


def _beside_boundary(island: Island, nodes: Indices) -> tuple[Matrix, Float[np.ndarray, "n b"]]:
    """Compute the joint covariance of nodes, and that with the condensed factor's nodes.

    The selected inverse has the latter; other nodes take a solution each.
    """
    graph, old = island.graph, island.graph.condensed
    assert old is not None
    in_boundary = np.isin(nodes, old.nodes)
    offset = graph.offset
    at, boundary = places(offset, nodes), places(offset, old.nodes)
    outside = np.repeat(~in_boundary, np.diff(offset)[nodes])
    columns = island.posterior.inverse_columns(at[outside])
    columns[:, graph.fixed[nodes[~in_boundary]].repeat(np.diff(offset)[nodes[~in_boundary]])] = 0.0
    within = np.searchsorted(boundary, at[~outside])
    covariance = np.empty((len(at), len(at)))
    covariance[:, outside] = columns[at]
    covariance[outside] = columns[at].T
    covariance[np.ix_(~outside, ~outside)] = island.boundary_covariance[np.ix_(within, within)]
    with_boundary = np.empty((len(at), len(boundary)))
    with_boundary[outside] = columns[boundary].T
    with_boundary[~outside] = island.boundary_covariance[within]
    return 0.5 * (covariance + covariance.T), with_boundary


def _sorted_out(
    island: Island, ids: Sequence[int]
) -> tuple[Bool[np.ndarray, " L"], Indices, Indices]:
    """Split landmarks: marks of nodes, the nodes, places of those at rest. Raises KeyError."""
    landmarks = island.graph.landmarks
    found = np.array([landmarks.get(id_, -1) for id_ in ids], np.int64)
    awake = found >= 0
    if awake.all():
        return awake, found, np.zeros(0, np.int64)
    place = resting_of(island).place
    at = [place[id_] for id_, is_node in zip(ids, awake.tolist(), strict=True) if not is_node]
    return awake, found[awake], np.array(at, np.int64)
