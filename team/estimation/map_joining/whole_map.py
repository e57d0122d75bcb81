"""The Gaussian back end of one robot: submaps joined one after the other into one Gaussian.

Hybrid-SLAM's map joining (Brooks & Bailey 2008, "HybridSLAM"), with the constraints of Williams'
constrained local submap filter (2001): the whole map and the local map are independent Gaussians,
and "these two landmarks are the same" is an observation without noise. Earlier submaps are not
linearised again, so the map is overconfident after many joins.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation import dense, elementwise
from team.estimation.gaussian import NotACovarianceError, PoseGaussian, carried_along
from team.estimation.geometry import wrapped
from team.estimation.map_joining.tie_kernel import Constraints, tied, tied_pose
from team.estimation.submap import LocalMap

ITERATIONS = 3


@dataclass(frozen=True, eq=False)
class WholeMap:
    """N(mean, covariance) of (pose, landmarks by ascending id) in the map frame [m, rad]."""

    ids: UInt32[np.ndarray, " L"]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]


def initial_map(
    pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"] | None
) -> WholeMap:
    """A map with a pose only; covariance None: the pose is exactly known."""
    spread = np.zeros((3, 3)) if covariance is None else covariance
    return WholeMap(np.zeros(0, dtype=np.uint32), pose, spread)


def joined(whole: WholeMap, local: LocalMap, gate: float = math.inf) -> WholeMap:
    """The local map composed onto the current pose: known landmarks fused, new ones added.

    With s = (whole, local) and the constraint h(s) = pose ∘ local landmark − whole landmark = 0 for
    each known landmark: the iterated EKF update of s, then (pose ∘ end pose, landmarks, pose ∘ new
    landmarks) with its Jacobian. The update has rank 2k for k known landmarks and the Jacobian is
    the identity for the landmarks of the whole map: O(n²k) for its n numbers.

    gate: the known landmarks whose constraints the others contradict by more than this are left out
        of the local map, worst first. By Baarda's test of a single constraint, T = zₗᵀ ((S⁻¹)ₗₗ)⁻¹
        zₗ with the multiplier z = S⁻¹ y is the fall of the cost without that constraint; it is
        χ²-distributed with two degrees of freedom.
    """
    local, in_whole, in_local, tie = _agreeing(whole, local.without_nodes, gate)
    n, m = len(whole.mean), len(local.mean)
    sights, known = 3 + _points(in_local), 3 + _points(in_whole)
    k = len(in_whole)
    of_pose = np.tile(np.eye(2, 3), (k, 1))
    of_pose[:, 2] = tie.lever.ravel()
    turn = np.array([[tie.cos, -tie.sin], [tie.sin, tie.cos]])
    U = dense.product(whole.covariance[:, :3], of_pose.T) - whole.covariance[:, known]
    V = (dense.product(local.covariance[:, sights].reshape(m, k, 2), turn.T)).reshape(m, 2 * k)
    state = whole.mean - dense.product(U, tie.multiplier)
    ended = local.mean - dense.product(V, tie.multiplier)
    of_whole, of_local = dense.product(U, tie.inverse), dense.product(V, tie.inverse)
    # (pose, local): what the new pose and the new landmarks are made of.
    own = np.empty((3 + m, 3 + m))
    own[:3, :3] = whole.covariance[:3, :3] - dense.product(of_whole[:3], U[:3].T)
    own[3:, 3:] = local.covariance - dense.product(of_local, V.T)
    own[:3, 3:] = dense.product(-of_whole[:3], V.T)
    own[3:, :3] = own[:3, 3:].T
    old = np.concatenate(
        [
            whole.covariance[3:, :3] - dense.product(of_whole[3:], U[:3].T),
            dense.product(-of_whole[3:], V.T),
        ],
        axis=1,
    )
    fresh = np.setdiff1d(np.arange(len(local.ids)), in_local)
    made, G = _composed(state[:3], ended, fresh)
    covariance = np.empty((n + 2 * len(fresh), n + 2 * len(fresh)))
    made_at = np.concatenate([np.arange(3), np.arange(n, len(covariance))])
    covariance[3:n, 3:n] = whole.covariance[3:, 3:] - dense.product(of_whole[3:], U[3:].T)
    covariance[np.ix_(made_at, made_at)] = dense.product(dense.product(G, own), G.T)
    covariance[3:n, made_at] = dense.product(old, G.T)
    covariance[made_at, 3:n] = covariance[3:n, made_at].T
    mean = np.concatenate([made[:3], state[3:], made[3:]])
    return _by_id(np.concatenate([whole.ids, local.ids[fresh]]), mean, covariance)


def end_pose(whole: WholeMap, local: LocalMap, gate: float = math.inf) -> tuple[PoseGaussian, int]:
    """The pose of `joined`, without the landmarks, and the number of landmarks that the gate left
    out.
    """
    seen = len(local.ids)
    local, in_whole, in_local, tie = _agreeing(whole, local, gate)
    place, sights = _entries(in_whole), _sights(local, in_local)
    pose, covariance = tied_pose(
        tie,
        whole.mean[place],
        whole.covariance[place[:, None], place],
        local.end_pose,
        np.ascontiguousarray(local.covariance[:3, :3]),
        np.ascontiguousarray(local.covariance[:3, sights]),
    )
    return PoseGaussian(pose, covariance), seen - len(local.ids)


def _agreeing(
    whole: WholeMap, local: LocalMap, gate: float
) -> tuple[LocalMap, Int64[np.ndarray, " k"], Int64[np.ndarray, " k"], Constraints]:
    """The local map without the landmarks that the gate leaves out; the indices of its known
    landmarks in both maps; their constraints.
    """
    while True:
        _, in_whole, in_local = np.intersect1d(
            whole.ids, local.ids, assume_unique=True, return_indices=True
        )
        place, sights = _entries(in_whole), _sights(local, in_local)
        tie, sound = tied(
            whole.mean[place],
            whole.covariance[place[:, None], place],
            local.mean[sights],
            local.covariance[sights[:, None], sights],
            ITERATIONS,
        )
        if not sound:
            raise NotACovarianceError("the known landmarks' innovation", "not positive definite")
        worst = _worst(tie, gate)
        if worst is None:
            return local, in_whole, in_local, tie
        local = without(local, int(in_local[worst]))


def _worst(tie: Constraints, gate: float) -> int | None:
    """Index of the constraint that the others contradict most; None where all are within the
    gate.
    """
    if not len(tie.multiplier) or gate == math.inf:
        return None
    z = tie.multiplier.reshape(-1, 2)
    at = np.arange(len(z))
    own = tie.inverse.reshape(len(z), 2, len(z), 2)[at, :, at]
    try:
        weighted = dense.solve(own, z[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError as error:
        raise NotACovarianceError("a known landmark's innovation", "singular") from error
    gain = np.einsum("ki,ki->k", z, weighted)
    worst = int(gain.argmax())
    return worst if gain[worst] > gate else None


def without(local: LocalMap, place: int) -> LocalMap:
    """The local map without its landmark at this index."""
    rows = np.delete(np.arange(len(local.mean)), _sights(local, np.array([place])))
    ids = np.delete(local.ids, place)
    covariance = local.covariance[np.ix_(rows, rows)]
    return LocalMap(ids, local.mean[rows], covariance, local.node_stamps)


def absorbed(
    whole: WholeMap,
    ids: UInt32[np.ndarray, " K"],
    means: Float[np.ndarray, "K 2"],
    covariance: Float[np.ndarray, "k k"],
) -> WholeMap:
    """Replaces the marginal of the landmarks by the fused map; pose and other landmarks are updated
    by regression.

    See `carried_along` for the regression. Landmarks that were unknown are added. The fused map
    contains this robot's own measurements: they are counted twice if the result is sent for fusion.
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


def _sights(local: LocalMap, index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    """Indices of the coordinates of some of a submap's landmarks, behind its poses."""
    return len(local.mean) - 2 * len(local.ids) + _points(index)


def _entries(index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    """Indices of the pose's numbers and of those of the landmarks with these indices."""
    return np.concatenate([np.arange(3), 3 + _points(index)])


def _points(index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    """Indices of the coordinates of the points with these indices."""
    return (2 * index[:, None] + np.arange(2)).ravel()


def _by_id(
    ids: UInt32[np.ndarray, " L"],
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
) -> WholeMap:
    if (ids[1:] < ids[:-1]).any():
        order = np.argsort(ids)
        place = _entries(order)
        ids, mean, covariance = ids[order], mean[place], covariance[np.ix_(place, place)]
    return WholeMap(ids, mean, 0.5 * (covariance + covariance.T))


def _composed(
    pose: Float[np.ndarray, "3"], local: Float[np.ndarray, " m"], fresh: Int64[np.ndarray, " f"]
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "q p"]]:
    """(pose ∘ end pose, pose ∘ fresh local landmarks) and its Jacobian by (pose, local)."""
    s, c = elementwise.sin_and_cos(pose[2])
    at = np.concatenate([np.arange(2), 3 + _points(fresh)]).reshape(-1, 2)
    rows = np.concatenate([np.arange(2), 3 + np.arange(2 * len(fresh))]).reshape(-1, 2)
    points = local[at]
    mean = np.empty(3 + 2 * len(fresh))
    G = np.zeros((len(mean), 3 + len(local)))
    mean[rows] = pose[:2] + dense.product(points, np.array([[c, s], [-s, c]]))
    mean[2] = wrapped(pose[2] + local[2])
    G[rows[:, 0], 0] = G[rows[:, 1], 1] = 1.0
    G[rows[:, 0], 2] = -s * points[:, 0] - c * points[:, 1]
    G[rows[:, 1], 2] = c * points[:, 0] - s * points[:, 1]
    G[rows[:, 0], 3 + at[:, 0]] = G[rows[:, 1], 3 + at[:, 1]] = c
    G[rows[:, 0], 3 + at[:, 1]], G[rows[:, 1], 3 + at[:, 0]] = -s, s
    G[2, 2] = G[2, 5] = 1.0
    return mean, G
