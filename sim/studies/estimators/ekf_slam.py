"""EKF-SLAM with known data association.

Smith, Self and Cheeseman 1990; Thrun et al. 2005, table 10.1. Over a long run the covariance
becomes too small (Julier and Uhlmann 2001).
"""

from dataclasses import dataclass

import numpy as np

from teamslam.sim.studies.estimators.robot_step import (
    RobotStep,
    joint_innovation,
    slots_of,
    variances,
)
from teamslam.team import core
from teamslam.team.core import NEAREST_M
from teamslam.team.estimation.gaussian import LandmarkGaussian, NotACovarianceError, PoseGaussian
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.se2 import Pose
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Bool, Float, Int64, UInt32

Array = Float[np.ndarray, "..."]


def see(poses: Array, landmarks: Array) -> tuple[Array, Array, Array]:
    """Distance d ≥ NEAREST_M and unit vector to each landmark."""
    dx, dy = landmarks[..., 0] - poses[..., 0], landmarks[..., 1] - poses[..., 1]
    distance = np.sqrt(dx * dx + dy * dy)
    near = distance < NEAREST_M
    if not near.any():
        return distance, dx / distance, dy / distance
    s, c = core.sin_and_cos(np.broadcast_to(poses[..., 2], near.shape))
    distance = np.where(near, 1.0, distance)
    ex, ey = np.where(near, c, dx / distance), np.where(near, s, dy / distance)
    return np.where(near, NEAREST_M, distance), ex, ey


Variances = tuple[float, float, float]
NO_CLAIM = np.empty((1, 0))


def advance(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    known: int,
    motion: Float[np.ndarray, "3"],
    Q: Float[np.ndarray, "3 3"],
    slots: Int64[np.ndarray, " k"],
    first: Bool[np.ndarray, " k"],
    measurements: Float[np.ndarray, "k 2"],
    sensor: Variances,
) -> bool:
    """Step the pose and the first `known` landmarks; False: S is not positive definite.

    slots: landmark of each measurement in the state; first: first sight of it.
    """
    size = 3 + 2 * known
    before, P_before = mean[:size], P[:size, :size]
    _move(before, P_before, motion, Q)
    places = 3 + 2 * slots
    old = slots < known
    if not _condition(before, P_before, places[old], measurements[old], sensor):
        return False
    for k in np.flatnonzero(first):
        _place(mean, P, int(places[k]), measurements[k], sensor)
    again = ~old & ~first
    return _condition(mean, P, places[again], measurements[again], sensor)


def _move(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    motion: Float[np.ndarray, "3"],
    Q: Float[np.ndarray, "3 3"],
) -> None:
    """Move: pose ← pose ∘ motion ∘ Exp(ξ), ξ ~ N(0, Q): P_pp ← F P_pp Fᵀ + G Q Gᵀ, P_pl ← F P_pl.

    F = ∂(pose ∘ motion)/∂pose = [[I, ∂R/∂θ t], [0, 1]], G = blkdiag(R(θ'), 1).
    """
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = Q.tolist()
    forward, left, turn = motion.tolist()
    theta = core.wrapped(float(mean[2]) + turn)
    sines, cosines = core.sin_and_cos(np.array([mean[2], theta]))
    s, c = float(sines[0]), float(cosines[0])
    of_x, of_y = -s * forward - c * left, c * forward - s * left
    mean[0] += of_y
    mean[1] -= of_x
    mean[2] = theta
    P[0] += of_x * P[2]
    P[1] += of_y * P[2]
    P[:, 0] += of_x * P[:, 2]
    P[:, 1] += of_y * P[:, 2]
    s, c = float(sines[1]), float(cosines[1])
    P[0, 0] += c * c * xx - 2.0 * c * s * xy + s * s * yy
    P[1, 1] += s * s * xx + 2.0 * c * s * xy + c * c * yy
    P[2, 2] += tt
    P[1, 0] += c * s * (xx - yy) + (c * c - s * s) * xy
    P[2, 0] += c * xt - s * yt
    P[2, 1] += s * xt + c * yt
    P[0, 1], P[0, 2], P[1, 2] = P[1, 0], P[2, 0], P[2, 1]


def _place(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    at: int,
    measurement: Float[np.ndarray, "2"],
    sensor: Variances,
) -> None:
    """Place a landmark in the entries `at` and at + 1.

    g = (x, y) + r (cos, sin)(theta + b), G_p = ∂g/∂pose: P_l· = G_p P_p·, P_ll = G_p P_pp G_pᵀ +
    G_z R G_zᵀ.
    """
    noise = (sensor[0], sensor[1], 1.0, sensor[2], 1.0)
    (mean[at : at + 2],), (own,) = core.place(mean[:3], measurement[None], noise, NO_CLAIM)
    of_x, of_y = mean[1] - mean[at + 1], mean[at] - mean[0]
    P[at, :at] = P[0, :at] + of_x * P[2, :at]
    P[at + 1, :at] = P[1, :at] + of_y * P[2, :at]
    P[:at, at], P[:at, at + 1] = P[at, :at], P[at + 1, :at]
    P[at, at] = P[at, 0] + of_x * P[at, 2] + own[0]
    P[at + 1, at] = P[at + 1, 0] + of_x * P[at + 1, 2] + own[1]
    P[at + 1, at + 1] = P[at + 1, 1] + of_y * P[at + 1, 2] + own[2]
    P[at, at + 1] = P[at + 1, at]


class _Sights:
    """H: two rows (range, bearing) for each landmark at `places`.

    H v = (e·δ, e⊥·δ/d − v_theta) with distance d, unit vector e to the landmark, e⊥ = (−ey, ex),
    and δ the landmark's entries of v less the position's.
    """

    def __init__(self, mean: Float[np.ndarray, " n"], places: Int64[np.ndarray, " t"]) -> None:
        self.places = places
        landmarks = mean[places[:, None] + np.arange(2)]
        self.distance, self.ex, self.ey = see(mean[:3], landmarks)

    def apply(self, rows: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k m"]:
        """Compute H v of each row v."""
        dx, dy = rows[:, self.places] - rows[:, :1], rows[:, self.places + 1] - rows[:, 1:2]
        found = np.empty((len(rows), 2 * len(self.places)))
        found[:, 0::2] = self.ex * dx + self.ey * dy
        found[:, 1::2] = (self.ex * dy - self.ey * dx) / self.distance - rows[:, 2:3]
        return found


def _condition(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    places: Int64[np.ndarray, " t"],
    measurements: Float[np.ndarray, "t 2"],
    sensor: Variances,
) -> bool:
    """Update by measurements, linearised at the state before.

    S = H P Hᵀ + R, K = P Hᵀ S⁻¹, x ← x + K (z − h(x)), P by `_joseph`. False: S is not positive
    definite.
    """
    m = 2 * len(places)
    if m == 0:
        return True
    H = _Sights(mean, places)
    innovation, R = np.empty(m), np.empty(m)
    innovation[0::2] = measurements[:, 0] - H.distance
    innovation[1::2] = core.wrapped(measurements[:, 1] + mean[2] - core.atan2(H.ey, H.ex))
    R[0::2], R[1::2] = sensor[0] + sensor[1] * H.distance * H.distance, sensor[2]
    HP = np.ascontiguousarray(H.apply(P).T)
    S = H.apply(HP)
    S[np.diag_indices(m)] += R
    gains = HP.copy()
    if not _solve_in_place(S, gains):
        return False
    for k in range(m):
        mean += innovation[k] * gains[k]
    mean[2] = core.wrapped(float(mean[2]))
    _joseph(P, HP, gains, H, R)
    return True


def _joseph(
    P: Float[np.ndarray, "n n"],
    HP: Float[np.ndarray, "m n"],
    gains: Float[np.ndarray, "m n"],
    H: _Sights,
    R: Float[np.ndarray, " m"],
) -> None:
    """P ← A P Aᵀ + K R Kᵀ with A = I − K H and Kᵀ = `gains`, in place.

    Each row b of A P becomes b − (b Hᵀ − K_j R) Kᵀ; H is five entries wide.
    """
    for k in range(len(HP)):
        P -= gains[k][:, None] * HP[k]
    left = H.apply(P) - gains.T * R
    for k in range(len(HP)):
        P -= left[:, k, None] * gains[k]
    P[:] = np.where(np.tri(len(P), dtype=bool), P, P.T)


def _solve_in_place(S: Float[np.ndarray, "m m"], B: Float[np.ndarray, "m n"]) -> bool:
    """B ← S⁻¹ B by Cholesky; False if S is not positive definite."""
    m = len(S)
    for k in range(m):
        if not S[k, k] > 0.0:
            return False
        S[k, k] = np.sqrt(S[k, k])
        column = S[k + 1 :, k]
        column /= S[k, k]
        S[k + 1 :, k + 1 :] -= column[:, None] * column
        B[k] /= S[k, k]
        B[k + 1 :] -= column[:, None] * B[k]
    for k in range(m - 1, -1, -1):
        for i in range(k + 1, m):
            B[k] -= S[i, k] * B[i]
        B[k] /= S[k, k]
    return True


@dataclass(frozen=True)
class EkfSlam:
    """N(mean, covariance) of (pose, landmarks in order of first sight).

    mean: (x [m], y [m], theta [rad], x₁, y₁, …).
    """

    ids: UInt32[np.ndarray, " L"]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]


def initial_state(pose: Pose) -> EkfSlam:
    """Start at an exact pose."""
    return EkfSlam(np.empty(0, np.uint32), pose, np.zeros((3, 3)))


def filter_step(state: EkfSlam, step: RobotStep) -> EkfSlam:
    """Move, update by all known landmarks at once, then place the new ones.

    Further measurements of a new landmark update it.
    """
    ids_after, slots, first = slots_of(state.ids, step.ids)
    n = 3 + 2 * len(ids_after)
    mean, P = np.empty(n), np.empty((n, n))
    known = len(state.mean)
    mean[:known] = state.mean
    P[:known, :known] = state.covariance
    sound = advance(
        mean,
        P,
        len(state.ids),
        step.increment.mean,
        step.increment.covariance,
        slots,
        first,
        np.column_stack((step.ranges, step.bearings)),
        variances(step.sensor),
    )
    if not sound:
        raise NotACovarianceError("the prediction of measurements", "not positive definite")
    return EkfSlam(ids_after, mean, P)


def innovation(state: EkfSlam, step: RobotStep) -> Innovation:
    """NIS of the used measurements."""
    return joint_innovation(state.ids, state.mean, state.covariance, step)


def pose_gaussian(state: EkfSlam) -> PoseGaussian:
    """Marginal of the pose."""
    return PoseGaussian(state.mean[:3], state.covariance[:3, :3])


def landmark_gaussian(state: EkfSlam) -> LandmarkGaussian:
    """Joint marginal of all landmarks."""
    local = local_map(state)
    return LandmarkGaussian(local.ids, local.landmarks, local.covariance[3:, 3:])


def local_map(state: EkfSlam) -> LocalMap:
    """The whole Gaussian."""
    order = np.argsort(state.ids)
    columns = (3 + 2 * order[:, None] + np.arange(2)).ravel()
    at = np.concatenate((np.arange(3), columns))
    return LocalMap(state.ids[order], state.mean[at], state.covariance[np.ix_(at, at)])
