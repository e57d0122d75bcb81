"""FastSLAM with one set of particles from start to end.

Montemerlo 2003; Xu's thesis, section 3.5.3; Ma & Ma, section IV-C. Particles come to share their
early path, so the landmarks' covariance is far too small.
"""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team import core
from teamslam.team.core import moments
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles, Proposal
from teamslam.team.estimation.se2 import Pose


@dataclass(frozen=True)
class PlainFastSlam:
    """Weighted particles, with their proposal.

    resample_below: relative effective sample size (Xu: 0.5); 1: always (Ma & Ma, Montemerlo).
    """

    particles: Particles
    proposal: Proposal
    resample_below: float


def initial_state(
    pose: Pose, particles: int, proposal: Proposal, resample_below: float
) -> PlainFastSlam:
    """Start at an exact pose."""
    poses = np.tile(pose, (particles, 1))
    return PlainFastSlam(fastslam.at_poses(poses), proposal, resample_below)


def filter_step(
    state: PlainFastSlam, step: RobotStep, generator: np.random.Generator
) -> PlainFastSlam:
    """Resample if needed, move, and update."""
    particles = state.particles
    thin = state.resample_below * len(particles.poses)
    if core.effective_sample_size(particles.log_weights) < thin:
        particles, _ = fastslam.resampled(particles, generator)
    return replace(state, particles=step.fastslam(particles, state.proposal, generator))


def pose_gaussian(state: PlainFastSlam) -> PoseGaussian:
    """Moments of the particles' poses."""
    return pose_moments(state.particles)


def landmark_gaussian(state: PlainFastSlam) -> LandmarkGaussian:
    """Σ wᵢ N(μᵢ, blkdiag(Σ₁, …, Σ_L)) as one Gaussian (Xu, eq. 4.5-4.6)."""
    return landmark_moments(state.particles)


def pose_moments(particles: Particles) -> PoseGaussian:
    """Moments of the weighted poses; singular below four different ones."""
    none = particles.means[:, :0], particles.covariances[:, :0]
    weights = core.exp(particles.log_weights)
    return PoseGaussian(*moments(particles.poses, weights, *none, 1.0))


def landmark_moments(particles: Particles) -> LandmarkGaussian:
    """Moments of the landmarks, correlated by the spread of particles."""
    order = np.argsort(particles.ids)
    mean, P = moments(
        particles.poses,
        core.exp(particles.log_weights),
        np.ascontiguousarray(particles.means[:, order]),
        np.ascontiguousarray(particles.covariances[:, order]),
        1.0,
    )
    return LandmarkGaussian(particles.ids[order], mean[3:].reshape(-1, 2), P[3:, 3:])
