"""Multi-robot FastSLAM: a particle is a path of every robot and one map.

p(x¹, …, xᴿ, m | z, u) = p(m | x, z) Π_r p(xʳ | zʳ, uʳ): Ma & Ma, section IV-D, algorithm 1, at
known start poses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.studies.estimators.plain_fastslam import landmark_moments, pose_moments
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team import core
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles, Proposal
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Float


@dataclass(frozen=True)
class JointFastSlam:
    """M particles (x¹, …, xᴿ, m, w).

    poses: (x [m], y [m], theta [rad]) by robot and particle. newest: maps, weights, and the poses
    of the robot that moved last. resample_below: relative effective sample size; 1: always.
    """

    robots: tuple[str, ...]
    poses: Float[np.ndarray, "R M 3"]
    newest: Particles
    proposal: Proposal
    resample_below: float

    def of_robot(self, robot: str) -> Particles:
        """Particles with the poses of one robot."""
        return replace(self.newest, poses=self.poses[self.robots.index(robot)])


def initial_state(
    poses: Mapping[str, Pose], particles: int, proposal: Proposal, resample_below: float
) -> JointFastSlam:
    """Start at exact poses."""
    of_robots = np.stack([np.tile(pose, (particles, 1)) for pose in poses.values()])
    newest = fastslam.at_poses(of_robots[0])
    return JointFastSlam(tuple(poses), of_robots, newest, proposal, resample_below)


def filter_step(
    state: JointFastSlam, turns: Sequence[RobotStep], generator: np.random.Generator
) -> JointFastSlam:
    """Resample if the particles are thin, then process the robots' turns, each with p(zʳ | …)."""
    log_weights = state.newest.log_weights
    if core.effective_sample_size(log_weights) < state.resample_below * len(log_weights):
        newest, parents = fastslam.resampled(state.newest, generator)
        state = replace(state, newest=newest, poses=state.poses[:, parents])
    for turn in turns:
        newest = turn.fastslam(state.of_robot(turn.robot), state.proposal, generator)
        poses = state.poses.copy()
        poses[state.robots.index(turn.robot)] = newest.poses
        state = replace(state, newest=newest, poses=poses)
    return state


def pose_gaussian(state: JointFastSlam, robot: str) -> PoseGaussian:
    """Mean and covariance of one robot's poses."""
    return pose_moments(state.of_robot(robot))


def landmark_gaussian(state: JointFastSlam) -> LandmarkGaussian:
    """Mixture of the particles' maps as one Gaussian."""
    return landmark_moments(state.of_robot(state.robots[0]))
