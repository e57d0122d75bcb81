"""Compiled kernel that joins a local map to a whole map (`whole_map.joined`)."""

import math

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.dense_kernel import matrix_product
from team.estimation.geometry import wrapped
from team.estimation.map_joining.tie_kernel import agreed, coordinates, moved_by, of_map, of_seen
from team.estimation.placing import put, put_block

Joined = tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, " p"], Float[np.ndarray, "p p"], int]


@compiled
def joined_by_id(
    whole_ids: UInt32[np.ndarray, " L"],
    whole_mean: Float[np.ndarray, " n"],
    whole_covariance: Float[np.ndarray, "n n"],
    ids: UInt32[np.ndarray, " K"],
    local_mean: Float[np.ndarray, " m"],
    local_covariance: Float[np.ndarray, "m m"],
) -> Joined:
    """Join two maps: ids, mean and covariance, landmarks by ascending id; and the fault.

    Updates (whole, local) by the constraints, Δ = P Hᵀ S⁻¹ H P, with G the Jacobian of the new pose
    and the new landmarks by (pose, local).
    """
    found = agreed(
        whole_ids, whole_mean, whole_covariance, ids, local_mean, local_covariance, math.inf
    )
    if found.fault:
        return whole_ids, whole_mean, whole_covariance, found.fault
    tie, n, m = found.tie, len(whole_mean), len(local_mean)
    place = coordinates(found.in_whole, 3, 3)
    U = of_map(_columns(whole_covariance, place), tie.lever)
    V = of_seen(_columns(local_covariance, found.sights), tie.cos, tie.sin)
    state, ended = np.empty(n), np.empty(m)
    moved_by(whole_mean, U, tie.multiplier, state)
    moved_by(local_mean, V, tie.multiplier, ended)
    of_whole, of_local = matrix_product(U, tie.inverse), matrix_product(V, tie.inverse)
    whole = whole_covariance - matrix_product(of_whole, U.T.copy())
    cross = matrix_product(-of_whole, V.T.copy())
    local = local_covariance - matrix_product(of_local, V.T.copy())
    # (pose, local): what the new pose and the new landmarks are made of.
    own, old = np.empty((3 + m, 3 + m)), np.empty((n - 3, 3 + m))
    put_block(own, 0, 0, whole[:3, :3])
    put_block(own, 3, 3, local)
    put_block(own, 0, 3, cross[:3])
    put_block(own, 3, 0, cross[:3].T)
    put_block(old, 0, 0, whole[3:, :3])
    put_block(old, 0, 3, cross[3:])
    fresh = _others(len(ids), found.in_local)
    made, G = _composed(state[:3], ended, fresh)
    of_own = matrix_product(matrix_product(G, own), G.T.copy())
    of_old = matrix_product(old, G.T.copy())
    size = n + 2 * len(fresh)
    mean, P = np.empty(size), np.empty((size, size))
    put(mean, 0, made[:3])
    put(mean, 3, state[3:])
    put(mean, n, made[3:])
    put_block(P, 3, 3, whole[3:, 3:])
    put_block(P, 0, 0, of_own[:3, :3])
    put_block(P, n, n, of_own[3:, 3:])
    put_block(P, 0, n, of_own[:3, 3:])
    put_block(P, n, 0, of_own[3:, :3])
    put_block(P, 3, 0, of_old[:, :3])
    put_block(P, 3, n, of_old[:, 3:])
    put_block(P, 0, 3, of_old[:, :3].T)
    put_block(P, n, 3, of_old[:, 3:].T)
    all_ids = np.empty(len(whole_ids) + len(fresh), np.uint32)
    put(all_ids, 0, whole_ids)
    put(all_ids, len(whole_ids), ids[fresh])
    order = np.argsort(all_ids)
    return _in_order(all_ids, mean, P, order)


@compiled
def _columns(
    covariance: Float[np.ndarray, "q p"], entries: Int64[np.ndarray, " m"]
) -> Float[np.ndarray, "q m"]:
    columns = np.empty((len(covariance), len(entries)))
    for i in range(len(covariance)):
        for j in range(len(entries)):
            columns[i, j] = covariance[i, entries[j]]
    return columns


@compiled
def _others(count: int, indices: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " f"]:
    others, k = np.empty(count - len(indices), np.int64), 0
    for i in range(count):
        if k < len(indices) and indices[k] == i:
            k += 1
        else:
            others[i - k] = i
    return others


@compiled
def _composed(
    pose: Float[np.ndarray, "3"], local: Float[np.ndarray, " m"], fresh: Int64[np.ndarray, " f"]
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "q p"]]:
    """(pose ∘ end pose, pose ∘ fresh local landmarks) and its Jacobian by (pose, local)."""
    s, c = elementary.sin_and_cos(pose[2])
    mean = np.empty(3 + 2 * len(fresh))
    G = np.zeros((len(mean), 3 + len(local)))
    mean[2] = wrapped(pose[2] + local[2])
    G[2, 2] = G[2, 5] = 1.0
    for k in range(len(fresh) + 1):
        row = 0 if k == 0 else 1 + 2 * k
        at = 0 if k == 0 else 3 + 2 * fresh[k - 1]
        x, y = local[at], local[at + 1]
        mean[row], mean[row + 1] = pose[0] + (c * x - s * y), pose[1] + (s * x + c * y)
        G[row, 0] = G[row + 1, 1] = 1.0
        G[row, 2], G[row + 1, 2] = -s * x - c * y, c * x - s * y
        G[row, 3 + at] = G[row + 1, 4 + at] = c
        G[row, 4 + at], G[row + 1, 3 + at] = -s, s
    return mean, G


@compiled
def _in_order(
    ids: UInt32[np.ndarray, " L"],
    mean: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    order: Int64[np.ndarray, " L"],
) -> Joined:
    place, n = coordinates(order, 3, 3), len(mean)
    sorted_mean, P = np.empty(n), np.empty((n, n))
    for i in range(n):
        sorted_mean[i] = mean[place[i]]
        for j in range(n):
            P[i, j] = 0.5 * (covariance[place[i], place[j]] + covariance[place[j], place[i]])
    return ids[order], sorted_mean, P, 0
