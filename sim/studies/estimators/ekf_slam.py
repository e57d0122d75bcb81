"""EKF-SLAM with known data association: one Gaussian over the pose and all landmarks.

Smith, Self and Cheeseman 1990; Thrun et al. 2005, table 10.1. Over a long run the covariance
becomes too small (Julier and Uhlmann 2001).
"""

from dataclasses import dataclass

import numpy as np

from teamslam.sim.studies.estimators.ekf_step import step
from teamslam.sim.studies.estimators.innovation import joint_innovation, slots_of
from teamslam.sim.studies.estimators.robot_step import variances
from teamslam.team.config import Sensor
from teamslam.team.estimation.gaussian import LandmarkGaussian, NotACovarianceError, PoseGaussian
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import Pose
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Float, UInt32


@dataclass(frozen=True)
class EkfSlam:
    """N(mean, covariance) of (pose, landmarks in order of first sight) in the map frame.

    mean: (x [m], y [m], theta [rad], x₁, y₁, …), theta in (−π, π].
    """

    ids: UInt32[np.ndarray, " L"]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]


def initial_state(pose: Pose) -> EkfSlam:
    """Start at an exact pose (else step first by `uncertain_start`)."""
    return EkfSlam(np.empty(0, np.uint32), pose, np.zeros((3, 3)))


def filter_step(
    state: EkfSlam,
    increment: Increment,
    sensor: Sensor,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
) -> EkfSlam:
    """Move, update by all known landmarks at once, then place the new ones.

    Further measurements of a new landmark update it. Raises NotACovarianceError.
    """
    ids_after, slots, first = slots_of(state.ids, ids)
    n = 3 + 2 * len(ids_after)
    mean, P = np.empty(n), np.empty((n, n))
    known = len(state.mean)
    mean[:known] = state.mean
    P[:known, :known] = state.covariance
    sound = step(
        mean,
        P,
        len(state.ids),
        increment.mean,
        increment.covariance,
        slots,
        first,
        np.column_stack((ranges, bearings)),
        variances(sensor),
    )
    if not sound:
        raise NotACovarianceError("the prediction of measurements", "not positive definite")
    return EkfSlam(ids_after, mean, P)


def innovation(
    state: EkfSlam,
    increment: Increment,
    sensor: Sensor,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
) -> Innovation:
    """NIS of the used measurements."""
    return joint_innovation(
        landmarks=state.ids,
        mean=state.mean,
        covariance=state.covariance,
        increment=increment,
        sensor=sensor,
        ids=ids,
        ranges=ranges,
        bearings=bearings,
    )


def pose_gaussian(state: EkfSlam) -> PoseGaussian:
    """Marginal of the pose."""
    return PoseGaussian(state.mean[:3], state.covariance[:3, :3])


def landmark_gaussian(state: EkfSlam) -> LandmarkGaussian:
    """Joint marginal of all landmarks."""
    local = local_map(state)
    return LandmarkGaussian(local.ids, local.landmarks, local.covariance[3:, 3:])


def local_map(state: EkfSlam) -> LocalMap:
    """The whole Gaussian, landmarks by ascending id."""
    order = np.argsort(state.ids)
    columns = (3 + 2 * order[:, None] + np.arange(2)).ravel()
    at = np.concatenate((np.arange(3), columns))
    return LocalMap(state.ids[order], state.mean[at], state.covariance[np.ix_(at, at)])
