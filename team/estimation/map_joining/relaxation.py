"""First guess of a whole graph: headings as free vectors.

With (c, s) = (cos θ, sin θ) of each pose as two free numbers, a submap's equations are linear,

    p − p_s − [[c_s, −s_s], [s_s, c_s]] z = 0,   (c, s)_e − R(z_θ) (c, s)_s = 0,

so least squares has one minimum (chordal relaxation: Martinec & Pajdla 2007, Carlone et al. 2015).
Weights leave correlations out.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation.map_joining.submap_graph import Graph
from teamslam.team.shapes import Bool, Float, Int64

Values = Float[np.ndarray, " _"]
Indices = Int64[np.ndarray, " _"]


class _Rows(NamedTuple):
    """R equations Σ coefficient · number = right, of T terms, with weights 1/σ."""

    numbers: Int64[np.ndarray, "R T"]
    coefficients: Float[np.ndarray, "R T"]
    right: Float[np.ndarray, " R"]
    weights: Float[np.ndarray, " R"]


def relax_headings(graph: Graph, state: Values) -> Values | None:
    """Relax the graph to a new state; fixed nodes and biases stay. None if undetermined."""
    sizes = np.diff(graph.offset).tolist()
    at = np.concatenate([[0], np.cumsum([4 if size == 3 else size for size in sizes])])
    numbers = np.zeros(at[-1])
    free = np.ones(at[-1], dtype=np.bool_)
    movable = ~graph.fixed & (np.diff(graph.offset) > 1)
    for node in np.flatnonzero(~movable):
        value = state[graph.offset[node] : graph.offset[node + 1]]
        numbers[at[node] : at[node + 1]] = _lifted(value) if len(value) == 3 else value
        free[at[node] : at[node + 1]] = False
    found = _least_squares(list(_list_equations(graph, at)), numbers, free)
    if found is None:
        return None
    moved = state.copy()
    for node in np.flatnonzero(movable):
        value, size = found[at[node] : at[node + 1]], sizes[node]
        if size == 3:
            value = np.array([value[0], value[1], core.atan2(value[3], value[2])])
        moved[graph.offset[node] : graph.offset[node + 1]] = value
    return moved


def _lifted(pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    return np.array([pose[0], pose[1], core.cos(pose[2]), core.sin(pose[2])])


def _least_squares(
    rows: Sequence[_Rows], numbers: Values, free: Bool[np.ndarray, " _"]
) -> Values | None:
    size, place = int(free.sum()), np.where(free, np.cumsum(free) - 1, -1)
    keys, products, right = [], [], np.zeros(size)
    for each in rows:
        column, weighted = place[each.numbers], each.weights[:, None] * each.coefficients
        is_free = column >= 0
        fixed = np.where(is_free, 0.0, weighted * numbers[each.numbers]).sum(axis=1)
        answers = weighted * (each.weights * each.right - fixed)[:, None]
        right += np.bincount(column[is_free], answers[is_free], size)
        below = (column[:, None, :] >= 0) & (column[:, :, None] >= column[:, None, :])
        keys.append((column[:, None, :] * size + column[:, :, None])[below])
        products.append((weighted[:, :, None] * weighted[:, None, :])[below])
    entries, which = np.unique(np.concatenate(keys), return_inverse=True)
    normal = np.bincount(which, np.concatenate(products)).astype(np.float64, copy=False)
    starts = np.searchsorted(entries, size * np.arange(size + 1))
    if np.count_nonzero(normal[entries % (size + 1) == 0]) < size:
        return None
    try:
        pattern = core.Pattern(np.ones(size, np.int64), starts, entries % size)
        factor = core.Cholesky(pattern, normal)
    except core.NotPositiveDefiniteError:
        return None
    found = numbers.copy()
    found[free] = factor.solve(right)
    return found if np.isfinite(found).all() else None


def _list_equations(graph: Graph, at: Indices) -> Iterator[_Rows]:
    for contribution, nodes, *_ in graph.submaps:
        local, start = contribution.local, int(at[nodes[0]])
        variances = np.diag(local.covariance)
        count = 1 + len(local.node_stamps)
        poses = local.mean[: 3 * count].reshape(-1, 3)
        spreads = variances[: 3 * count].reshape(-1, 3)
        points = np.concatenate([poses[:, :2], local.landmarks])
        spread = np.concatenate([spreads[:, :2], variances[3 * count :].reshape(-1, 2)])
        yield _points(
            start, at[nodes[1 : len(points) + 1]], points, 1.0 / np.sqrt(spread.mean(axis=1))
        )
        yield _turns(start, at[nodes[1 : count + 1]], poses[:, 2], 1.0 / np.sqrt(spreads[:, 2]))
    for sighting, observer, teammate in graph.sightings:
        distance, bearing = sighting.measurement.tolist()
        spread = 0.5 * (
            sighting.covariance[0, 0] + sighting.covariance[1, 1] * core.squared(distance)
        )
        point = distance * np.array([[core.cos(bearing), core.sin(bearing)]])
        weight = np.array([1.0 / math.sqrt(spread)])
        yield _points(int(at[observer]), at[[teammate]], point, weight)
    for prior in graph.priors:
        if not prior.is_of_pose:
            continue
        numbers = at[prior.nodes[0]] + np.arange(4)
        weights = np.sqrt(np.diag(prior.information))[[0, 1, 2, 2]]
        yield _Rows(numbers[:, None], np.ones((4, 1)), _lifted(prior.mean), weights)


def _points(
    start: int,
    points: Int64[np.ndarray, " n"],
    places: Float[np.ndarray, "n 2"],
    weights: Float[np.ndarray, " n"],
) -> _Rows:
    n = len(points)
    numbers = np.empty((2 * n, 4), dtype=np.int64)
    numbers[0::2, 0], numbers[1::2, 0] = points, points + 1
    numbers[0::2, 1], numbers[1::2, 1] = start, start + 1
    numbers[:, 2:] = start + 2, start + 3
    coefficients = np.empty((2 * n, 4))
    coefficients[:, :2] = 1.0, -1.0
    coefficients[0::2, 2], coefficients[0::2, 3] = -places[:, 0], places[:, 1]
    coefficients[1::2, 2], coefficients[1::2, 3] = -places[:, 1], -places[:, 0]
    return _Rows(numbers, coefficients, np.zeros(2 * n), np.repeat(weights, 2))


def _turns(
    start: int,
    poses: Int64[np.ndarray, " n"],
    angles: Float[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
) -> _Rows:
    n = len(poses)
    s, c = core.sin_and_cos(angles)
    numbers = np.empty((2 * n, 3), dtype=np.int64)
    numbers[0::2, 0], numbers[1::2, 0] = poses + 2, poses + 3
    numbers[:, 1:] = start + 2, start + 3
    coefficients = np.ones((2 * n, 3))
    coefficients[0::2, 1], coefficients[0::2, 2] = -c, s
    coefficients[1::2, 1], coefficients[1::2, 2] = -s, -c
    return _Rows(numbers, coefficients, np.zeros(2 * n), np.repeat(weights, 2))
