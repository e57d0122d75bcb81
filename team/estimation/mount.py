"""A sensor mounted off the origin of the robot's base.

Within a window poses and motions are the sensor's: S = m⁻¹ ∘ T ∘ m for a motion T of the base, with
the sensor at m.
"""

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import Matrix, PoseGaussian
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import Pose, compose


def of_sensor(step: Increment, mount: Pose) -> Increment:
    """Convert a motion of the base to the sensor's: T Exp(ξ) m = m (m⁻¹ T m) Exp(Ad(m⁻¹) ξ)."""
    return Increment(*core.motion_of_sensor(step.mean, step.covariance, mount))


def start_of_sensor(
    pose: Pose, covariance: Matrix | None, mount: Pose
) -> tuple[Pose, Matrix | None]:
    """Convert an initial pose of the base to the sensor's; covariance None: exact."""
    known = np.zeros((3, 3)) if covariance is None else covariance
    found = moved_by(PoseGaussian(pose, known), mount) if mount.any() else PoseGaussian(pose, known)
    return found.mean, None if covariance is None else found.covariance


def moved_by(pose: PoseGaussian, step: Pose) -> PoseGaussian:
    """Compose a pose in (x, y, θ) and a motion, with covariance."""
    end = compose(pose.mean, step)
    dx, dy = end[:2] - pose.mean[:2]
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    return PoseGaussian(end, dense.congruent(F, pose.covariance))
