"""Hybrid-SLAM as stated in the thesis: after each step all particles become their weighted mean.

W. Xu, sections 4.2 and 4.3. The reset makes covariances far too small. Corrected: a landmark's
initial covariance (thesis: 30 m), and weights restart with each step.
"""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team import core
from teamslam.team.core import moments
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Float, UInt32


@dataclass(frozen=True)
class ThesisState:
    """Mean pose and independent landmarks.

    pose: (x [m], y [m], theta [rad]). pose_covariance: of the last step's particles. ids:
    ascending. landmarks: [m]. particles: their number.
    """

    pose: Pose
    pose_covariance: Float[np.ndarray, "3 3"]
    ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"]
    covariances: Float[np.ndarray, "L 2 2"]
    particles: int


def initial_state(pose: Pose, particles: int) -> ThesisState:
    """Start at an exact pose."""
    none = np.empty((0, 2)), np.empty((0, 2, 2))
    return ThesisState(pose, np.zeros((3, 3)), np.empty(0, np.uint32), *none, particles)


def filter_step(state: ThesisState, step: RobotStep, generator: np.random.Generator) -> ThesisState:
    """Sample poses about the mean, update and weigh (FastSLAM 1.0), reset to eq. 4.5-4.6."""
    drawn = reset(state, step.ids, state.particles)
    after = step.fastslam(drawn, "fastslam1", generator)
    mean, P = moments(after.poses, core.exp(after.log_weights), after.means, after.covariances, 1.0)
    columns = 3 + 2 * np.arange(len(after.ids))[:, None] + np.arange(2)
    return absorb_map(
        replace(state, pose=mean[:3], pose_covariance=P[:3, :3]),
        after.ids,
        mean[3:].reshape(-1, 2),
        P[columns[:, :, None], columns[:, None, :]],
    )


def reset(state: ThesisState, ids: UInt32[np.ndarray, " n"], particles: int) -> Particles:
    """Particles at the mean, without correlations or pose covariance."""
    observed = np.isin(state.ids, ids)
    blocks = state.covariances[observed]
    triangles = np.stack((blocks[:, 0, 0], blocks[:, 0, 1], blocks[:, 1, 1]), axis=1)
    return Particles(
        poses=np.tile(state.pose, (particles, 1)),
        log_weights=np.full(particles, -core.log(float(particles))),
        ids=state.ids[observed],
        means=np.tile(state.landmarks[observed], (particles, 1, 1)),
        covariances=np.tile(triangles, (particles, 1, 1)),
    )


def absorb_map(
    state: ThesisState,
    ids: UInt32[np.ndarray, " n"],
    landmarks: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
) -> ThesisState:
    """Replace known landmarks; add unknown ones (section 5.2)."""
    others = ~np.isin(state.ids, ids)
    merged = np.concatenate((state.ids[others], ids))
    order = np.argsort(merged)
    return replace(
        state,
        ids=merged[order],
        landmarks=np.concatenate((state.landmarks[others], landmarks))[order],
        covariances=np.concatenate((state.covariances[others], covariances))[order],
    )
