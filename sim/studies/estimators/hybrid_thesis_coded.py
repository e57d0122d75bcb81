"""Hybrid-SLAM as in the appendix of W. Xu's thesis, where its program differs from its text.

Particles become their weighted mean after each step, but weights carry over (`particle_w(j) =
particle_w(j)*w`) without resampling; landmark covariances stay each particle's own. A new landmark
begins with 15 m and 17.8°, rotated by a matrix with one wrong sign (`Gz = [c r*s; s r*c]`).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.studies.estimators.plain_fastslam import landmark_moments, pose_moments
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team import core
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Float, UInt32

FIRST_RANGE_VAR = 15.0**2
FIRST_BEARING_VAR = 10.0 * math.pi / 18.0**2
"""`r = [(15)^2 0; 0 10*pi/18^2]`: variances of a first measurement [m², rad²]."""


@dataclass(frozen=True)
class CodedState:
    """Particles before (`drawn`, reported) and after they were set to their mean."""

    drawn: Particles
    particles: Particles


def initial_state(pose: Pose, particles: int) -> CodedState:
    """Start at an exact pose."""
    at = fastslam.at_poses(np.tile(pose, (particles, 1)))
    return CodedState(at, at)


def filter_step(state: CodedState, step: RobotStep, generator: np.random.Generator) -> CodedState:
    """Move, multiply the weights, update the landmarks, set all to the mean."""
    known = len(state.particles.ids)
    drawn = step.fastslam(state.particles, "fastslam1", generator)
    for slot in range(known, len(drawn.ids)):
        first = int(np.flatnonzero(step.ids == drawn.ids[slot])[0])
        drawn.covariances[:, slot] = _at_first(
            drawn.poses, step.ranges[first], step.bearings[first]
        )
    pose, landmarks = pose_moments(drawn).mean, landmark_moments(drawn)
    rows = np.searchsorted(landmarks.ids, drawn.ids)
    count = len(drawn.poses)
    mean = replace(
        drawn,
        poses=np.tile(pose, (count, 1)),
        means=np.tile(landmarks.means[rows], (count, 1, 1)),
    )
    return CodedState(drawn, mean)


def _at_first(
    poses: Float[np.ndarray, "M 3"], range_m: float, bearing: float
) -> Float[np.ndarray, "M 3"]:
    """Gz r Gzᵀ of each particle as (xx, xy, yy), with Gz as printed."""
    s, c = core.sin_and_cos(poses[:, 2] + bearing)
    along, across = FIRST_RANGE_VAR, core.squared(range_m) * FIRST_BEARING_VAR
    return np.column_stack(
        (c * c * along + s * s * across, c * s * (along + across), s * s * along + c * c * across)
    )


def pose_gaussian(state: CodedState) -> PoseGaussian:
    """Moments of the last step's particles."""
    return pose_moments(state.drawn)


def landmark_gaussian(state: CodedState) -> LandmarkGaussian:
    """Means, and the 2 × 2 blocks of eq. 4.6."""
    found = landmark_moments(state.drawn)
    blocks = np.kron(np.eye(len(found.ids)), np.ones((2, 2)))
    return LandmarkGaussian(found.ids, found.means, found.covariance * blocks)


def absorb_map(
    state: CodedState,
    ids: UInt32[np.ndarray, " n"],
    landmarks: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
) -> CodedState:
    """Replace these landmarks in every particle (`recieve_information`)."""
    old, count = state.particles, len(state.particles.poses)
    others = ~np.isin(old.ids, ids)
    triangles = np.stack((covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]), axis=1)
    after = replace(
        old,
        ids=np.concatenate((old.ids[others], ids)),
        means=np.concatenate((old.means[:, others], np.tile(landmarks, (count, 1, 1))), axis=1),
        covariances=np.concatenate(
            (old.covariances[:, others], np.tile(triangles, (count, 1, 1))), axis=1
        ),
    )
    return CodedState(replace(after, poses=state.drawn.poses), after)
