"""Dead reckoning: odometry composed on SE(2), pose_k = pose_{k−1} ∘ mean_k ∘ Exp(ξ_k).

Thrun et al. 2005, chapter 5; Ma & Ma, section VI-A.
"""

from dataclasses import dataclass

import numpy as np

from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import Pose, tangent


@dataclass(frozen=True)
class DeadReckoning:
    """map_from_robot = mean ∘ Exp(ξ), ξ ~ N(0, covariance) in (forward, left, turn)."""

    pose: Increment


def initial_state(pose: Pose) -> DeadReckoning:
    """Start at an exact pose."""
    return DeadReckoning(Increment(pose, np.zeros((3, 3))))


def filter_step(state: DeadReckoning, step: RobotStep) -> DeadReckoning:
    """Compose the pose with the increment."""
    return DeadReckoning(state.pose.then(step.increment))


def pose_gaussian(state: DeadReckoning) -> PoseGaussian:
    """Gaussian in (x, y, theta), to first order: P = G C Gᵀ with G = blkdiag(R(θ), 1)."""
    G = tangent(state.pose.mean[2])
    P = dense.product(dense.product(G, state.pose.covariance), G.T)
    return PoseGaussian(state.pose.mean, 0.5 * (P + P.T))


def landmark_gaussian(state: DeadReckoning) -> LandmarkGaussian:
    """The empty map."""
    return NO_LANDMARKS
