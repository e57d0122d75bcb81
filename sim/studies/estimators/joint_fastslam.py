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
from teamslam.team.shapes import Float, UInt32


@dataclass(frozen=True)
class JointFastSlam:
    """M particles (x¹, …, xᴿ, m, w).

    poses: (x [m], y [m], theta [rad]) by robot and particle. resample_below: relative effective
    sample size; 1: always.
    """

    robots: tuple[str, ...]
    poses: Float[np.ndarray, "R M 3"]
    log_weights: Float[np.ndarray, " M"]
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "M L 2"]
    covariances: Float[np.ndarray, "M L 3"]
    proposal: Proposal
    resample_below: float


def initial_state(
    poses: Mapping[str, Pose], particles: int, proposal: Proposal, resample_below: float
) -> JointFastSlam:
    """Start at exact poses."""
    none = fastslam.at_poses(np.zeros((particles, 3)))
    return JointFastSlam(
        robots=tuple(poses),
        poses=np.stack([np.tile(pose, (particles, 1)) for pose in poses.values()]),
        log_weights=none.log_weights,
        ids=none.ids,
        means=none.means,
        covariances=none.covariances,
        proposal=proposal,
        resample_below=resample_below,
    )


def filter_step(
    state: JointFastSlam, turns: Sequence[RobotStep], generator: np.random.Generator
) -> JointFastSlam:
    """Resample if the particles are thin, then process the robots' turns, each with p(zʳ | …)."""
    thin = state.resample_below * len(state.log_weights)
    if fastslam.effective_sample_size(state.log_weights) < thin:
        parents = fastslam.systematic_parents(state.log_weights, generator.random())
        state = replace(
            state,
            poses=state.poses[:, parents],
            log_weights=np.full(len(parents), -core.log(float(len(parents)))),
            means=state.means[parents],
            covariances=state.covariances[parents],
        )
    for turn in turns:
        index = state.robots.index(turn.robot)
        after = turn.fastslam(_particles_of(state, index), state.proposal, generator)
        poses = state.poses.copy()
        poses[index] = after.poses
        state = replace(
            state,
            poses=poses,
            log_weights=after.log_weights,
            ids=after.ids,
            means=after.means,
            covariances=after.covariances,
        )
    return state


def pose_gaussian(state: JointFastSlam, robot: str) -> PoseGaussian:
    """Mean and covariance of one robot's poses."""
    return pose_moments(_particles_of(state, state.robots.index(robot)))


def landmark_gaussian(state: JointFastSlam) -> LandmarkGaussian:
    """Mixture of the particles' maps as one Gaussian."""
    return landmark_moments(_particles_of(state, 0))


def _particles_of(state: JointFastSlam, index: int) -> Particles:
    return Particles(
        state.poses[index], state.log_weights, state.ids, state.means, state.covariances
    )
