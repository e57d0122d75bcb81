"""A sensor mounted off the origin of the robot's base.

Within a window poses and motions are the sensor's, so that a measurement is range and bearing from
the pose. For a motion T of the base the sensor at m moves by m⁻¹ ∘ T ∘ m. At the window's end the
poses become the base's, particle by particle: with S the sensor's pose since the window's start,
the base's is m ∘ S ∘ m⁻¹, and a point p in the frame of the sensor's start is m p in the base's.
"""

import numpy as np
from jaxtyping import Float

from team import core
from team.estimation import dense
from team.estimation.gaussian import PoseGaussian
from team.estimation.models import Increment
from team.estimation.se2 import Pose, adjoint, compose, inverse


def of_sensor(step: Increment, mount: Pose) -> Increment:
    """Convert a motion of the base to the sensor's: T Exp(ξ) m = m (m⁻¹ T m) Exp(Ad(m⁻¹) ξ)."""
    away = inverse(mount)
    Ad = adjoint(away)
    C = dense.product(dense.product(Ad, step.covariance), Ad.T)
    return Increment(compose(compose(away, step.mean), mount), 0.5 * (C + C.T))


def of_base(step: Increment, mount: Pose) -> Increment:
    """Convert a motion of the sensor to the base's, the inverse of `of_sensor`."""
    return of_sensor(step, inverse(mount))


def moved_by(pose: PoseGaussian, step: Pose) -> PoseGaussian:
    """Compose a pose in (x, y, θ) and a motion, with covariance."""
    end = compose(pose.mean, step)
    dx, dy = end[:2] - pose.mean[:2]
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    return PoseGaussian(end, dense.product(dense.product(F, pose.covariance), F.T))


def base_poses(poses: Float[np.ndarray, "*n 3"], mount: Pose) -> Float[np.ndarray, "*n 3"]:
    """Convert each sensor pose S to the base's, m ∘ S ∘ m⁻¹."""
    away = inverse(mount)
    s, c = core.sin_and_cos(poses[..., 2])
    x = poses[..., 0] + c * away[0] - s * away[1]
    y = poses[..., 1] + s * away[0] + c * away[1]
    found: Float[np.ndarray, "*n 3"] = np.stack([*_turned(x, y, mount), poses[..., 2]], axis=-1)
    found += np.array([mount[0], mount[1], 0.0])
    return found


def base_points(points: Float[np.ndarray, "*n 2"], mount: Pose) -> Float[np.ndarray, "*n 2"]:
    """Map points p of the sensor's start to the base's: m p."""
    found: Float[np.ndarray, "*n 2"] = np.stack(
        _turned(points[..., 0], points[..., 1], mount), axis=-1
    )
    found += mount[:2]
    return found


def base_shifts(
    shifts: Float[np.ndarray, "*b n 3"], poses: Float[np.ndarray, "n 3"], mount: Pose
) -> Float[np.ndarray, "*b n 3"]:
    """Convert shifts (dx, dy, dθ) of the sensor's poses to those of the base's."""
    away = inverse(mount)
    s, c = core.sin_and_cos(poses[:, 2])
    x = shifts[..., 0] - (s * away[0] + c * away[1]) * shifts[..., 2]
    y = shifts[..., 1] + (c * away[0] - s * away[1]) * shifts[..., 2]
    return np.stack([*_turned(x, y, mount), shifts[..., 2]], axis=-1)


def _turned(
    x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"], mount: Pose
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    s, c = core.sin_and_cos(mount[2])
    return c * x - s * y, s * x + c * y
