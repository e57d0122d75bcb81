"""The Gaussian back end of one robot: submaps joined one after the other into one Gaussian.

Hybrid-SLAM's map joining (Brooks & Bailey 2008, "HybridSLAM"), with the constraints of Williams'
constrained local submap filter (2001): the whole map and the local map stand side by side as
independent Gaussians, and "these two landmarks are the same" is an observation without noise.
Earlier submaps are not linearised again, so the map is over-confident after many joins.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation.gaussian import carried_along, information
from team.estimation.geometry import compose, transformed, wrapped
from team.estimation.submap import LocalMap

ITERATIONS = 3


@dataclass(frozen=True, eq=False)
class WholeMap:
    """N(mean, covariance) of (pose, landmarks by ascending id) in the map frame [m, rad]."""

    ids: UInt32[np.ndarray, " L"]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]


def begun(pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"] | None) -> WholeMap:
    """A map with a pose only; covariance None: the pose is exactly known."""
    spread = np.zeros((3, 3)) if covariance is None else covariance
    return WholeMap(np.zeros(0, dtype=np.uint32), pose, spread)


def joined(whole: WholeMap, local: LocalMap) -> WholeMap:
    """The local map composed onto the current pose: known landmarks fused, new ones added.

    With s = (whole, local) and the constraint h(s) = pose ∘ local landmark − whole landmark = 0 for
    each known landmark: the iterated EKF update of s in Joseph's form, then
    (pose ∘ end pose, landmarks, pose ∘ new landmarks) with its Jacobian.
    """
    local = local.without_nodes
    n, m = len(whole.mean), len(local.mean)
    prior = np.concatenate([whole.mean, local.mean])
    covariance = np.zeros((n + m, n + m))
    covariance[:n, :n], covariance[n:, n:] = whole.covariance, local.covariance
    _, in_whole, in_local = np.intersect1d(whole.ids, local.ids, return_indices=True)
    state = prior
    if len(in_whole):
        for _ in range(ITERATIONS):
            gap, H = _constraints(state, n, in_whole, in_local)
            spread = information(H @ covariance @ H.T, "the known landmarks' innovation")
            gain = covariance @ H.T @ spread
            state = prior - gain @ (gap + H @ (prior - state))
        rest = np.eye(n + m) - gain @ H
        covariance = rest @ covariance @ rest.T
    fresh = np.setdiff1d(np.arange(len(local.ids)), in_local)
    mean, G = _advanced(state, n, fresh)
    ids = np.concatenate([whole.ids, local.ids[fresh]])
    return _by_id(ids, mean, G @ covariance @ G.T)


def absorbed(
    whole: WholeMap,
    ids: UInt32[np.ndarray, " K"],
    means: Float[np.ndarray, "K 2"],
    covariance: Float[np.ndarray, "k k"],
) -> WholeMap:
    """The fused map replaces the landmarks' marginal; pose and other landmarks follow it.

    They follow by regression (see `carried_along`). Landmarks that were unknown are added. What the
    fused map holds of this robot's own readings is counted again if the result is sent for fusion.
    """
    _, in_whole, in_new = np.intersect1d(whole.ids, ids, return_indices=True)
    mean, joint = carried_along(
        whole.mean,
        whole.covariance,
        3 + _points(in_whole),
        means.ravel(),
        covariance,
        _points(in_new),
    )
    mean[2] = wrapped(mean[2])
    own = whole.ids[np.setdiff1d(np.arange(len(whole.ids)), in_whole)]
    return _by_id(np.concatenate([own, ids]), mean, joint)


def _points(index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    """Places of the coordinates of the points with these indices."""
    return (2 * index[:, None] + np.arange(2)).ravel()


def _by_id(
    ids: UInt32[np.ndarray, " L"],
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
) -> WholeMap:
    order = np.argsort(ids)
    place = np.concatenate([np.arange(3), 3 + _points(order)])
    sorted_covariance = covariance[np.ix_(place, place)]
    return WholeMap(ids[order], mean[place], 0.5 * (sorted_covariance + sorted_covariance.T))


def _turn(heading: float) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2 2"]]:
    """R and dR/dθ."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])


def _constraints(
    state: Float[np.ndarray, " n"],
    split: int,
    in_whole: Int64[np.ndarray, " k"],
    in_local: Int64[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
    """h(s) and its Jacobian; the local map begins at `split`."""
    R, slope = _turn(state[2])
    gap = np.zeros(2 * len(in_whole))
    H = np.zeros((len(gap), len(state)))
    for k, (a, b) in enumerate(zip(in_whole, in_local, strict=True)):
        rows = slice(2 * k, 2 * k + 2)
        own = slice(3 + 2 * a, 5 + 2 * a)
        seen = slice(split + 3 + 2 * b, split + 5 + 2 * b)
        gap[rows] = transformed(state[:3], state[seen]) - state[own]
        H[rows, :2], H[rows, 2] = np.eye(2), slope @ state[seen]
        H[rows, own], H[rows, seen] = -np.eye(2), R
    return gap, H


def _advanced(
    state: Float[np.ndarray, " n"], split: int, fresh: Int64[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
    """(pose ∘ end pose, landmarks, pose ∘ fresh local landmarks) and its Jacobian."""
    R, slope = _turn(state[2])
    size = split + 2 * len(fresh)
    mean = np.zeros(size)
    G = np.zeros((size, len(state)))
    mean[:3] = compose(state[:3], state[split : split + 3])
    G[:3, :3] = np.eye(3)
    G[:2, 2] = slope @ state[split : split + 2]
    G[:2, split : split + 2], G[2, split + 2] = R, 1.0
    mean[3:split] = state[3:split]
    G[3:split, 3:split] = np.eye(split - 3)
    for k, b in enumerate(fresh):
        rows = slice(split + 2 * k, split + 2 * k + 2)
        seen = slice(split + 3 + 2 * b, split + 5 + 2 * b)
        mean[rows] = transformed(state[:3], state[seen])
        G[rows, :2], G[rows, 2], G[rows, seen] = np.eye(2), slope @ state[seen], R
    return mean, G
