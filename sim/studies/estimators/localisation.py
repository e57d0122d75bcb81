"""Monte Carlo localisation on an exactly known map.

p(pose | z, u, map) by prediction, weighing and resampling: Xu's thesis, section 3.5.1; Dellaert et
al. 1999; Thrun et al. 2005, table 8.2.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.studies.estimators import robot_step
from teamslam.sim.studies.estimators.ekf_slam import see
from teamslam.sim.studies.estimators.plain_fastslam import pose_moments
from teamslam.sim.studies.estimators.robot_step import RobotStep, variances
from teamslam.team import core
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Float, UInt32


@dataclass(frozen=True)
class Localisation:
    """Weighted poses and their map [m].

    cloud: particles without landmarks. resample_below: relative effective sample size.
    """

    cloud: Particles
    ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"]
    resample_below: float = 0.5


def initial_state(
    pose: Pose,
    particles: int,
    ids: UInt32[np.ndarray, " L"],
    landmarks: Float[np.ndarray, "L 2"],
) -> Localisation:
    """Start at an exact pose."""
    return Localisation(fastslam.at_poses(np.tile(pose, (particles, 1))), ids, landmarks)


def initial_state_anywhere(
    lowest: Float[np.ndarray, "2"],
    highest: Float[np.ndarray, "2"],
    particles: int,
    ids: UInt32[np.ndarray, " L"],
    landmarks: Float[np.ndarray, "L 2"],
    generator: np.random.Generator,
) -> Localisation:
    """Draw poses over a rectangle [m] and all headings (Xu, figure 3.5a)."""
    low, high = np.append(lowest, -np.pi), np.append(highest, np.pi)
    poses = high - (high - low) * generator.random((particles, 3))
    return Localisation(fastslam.at_poses(poses), ids, landmarks)


def filter_step(
    state: Localisation, step: RobotStep, generator: np.random.Generator
) -> Localisation:
    """Resample a thin cloud, draw the motion, multiply the weights by Π p(z | pose, map)."""
    cloud = state.cloud
    thin = state.resample_below * len(cloud.poses)
    if core.effective_sample_size(cloud.log_weights) < thin:
        cloud, _ = fastslam.resampled(cloud, generator)
    cloud = fastslam.propagated(cloud, step.increment, generator)
    mapped = np.isin(step.ids, state.ids)
    log_weights = _weigh(
        cloud.log_weights,
        cloud.poses,
        state.landmarks[np.searchsorted(state.ids, step.ids[mapped])],
        np.column_stack((step.ranges[mapped], step.bearings[mapped])),
        variances(step.sensor),
    )
    log_weights, _ = core.normalise(log_weights)
    return replace(state, cloud=replace(cloud, log_weights=log_weights))


def innovation(state: Localisation, step: RobotStep) -> Innovation:
    """Innovation of the used measurements; valid for one mode."""
    read = np.isin(state.ids, step.ids)
    count, known = len(state.cloud.poses), int(read.sum())
    on_map = replace(
        state.cloud,
        ids=state.ids[read],
        means=np.tile(state.landmarks[read], (count, 1, 1)),
        covariances=np.zeros((count, known, 3)),
    )
    return robot_step.innovation(on_map, step)


def pose_gaussian(state: Localisation) -> PoseGaussian:
    """Mean and covariance of the cloud."""
    return pose_moments(state.cloud)


def landmark_gaussian(state: Localisation) -> LandmarkGaussian:
    """The known map, with covariance zero."""
    n = 2 * len(state.ids)
    return LandmarkGaussian(state.ids, state.landmarks, np.zeros((n, n)))


def _weigh(
    log_weights: Float[np.ndarray, " M"],
    poses: Float[np.ndarray, "M 3"],
    landmarks: Float[np.ndarray, "n 2"],
    measurements: Float[np.ndarray, "n 2"],
    sensor: tuple[float, float, float],
) -> Float[np.ndarray, " M"]:
    """Weights log w + Σ log N(z; h(pose, landmark), R), with R at the predicted range."""
    distance, ex, ey = see(poses[:, None], landmarks)
    range_sigma = np.sqrt(sensor[0] + sensor[1] * distance * distance)
    bearing_sigma = math.sqrt(sensor[2])
    of_range = (measurements[:, 0] - distance) / range_sigma
    turn = core.wrapped(measurements[:, 1] + poses[:, 2:] - core.atan2(ey, ex))
    of_bearing = turn / bearing_sigma
    exponents = 0.5 * (of_range * of_range + of_bearing * of_bearing)
    volumes = core.log(2.0 * math.pi * range_sigma * bearing_sigma)
    weighed = log_weights.copy()
    for k in range(len(landmarks)):  # the sum has one order on every processor
        weighed -= exponents[:, k]
        weighed -= volumes[:, k]
    return weighed
