"""The derivative of a window's Gaussian by errors that many windows share.

A small calibration error b shifts every submap of a robot alike. With S = ∂mean/∂b a submap is r =
h(x) − (mean + S b) ~ N(0, P), and the centre estimates b together with the map. The mean of the
particles has no derivative in closed form; S is that of the window's smoother, linearised about the
particles' mean path: with J, W over the motions and the measurements and g the derivative of their
residuals, S = −(JᵀWJ)⁻¹ Jᵀ W g. As in the window itself the path takes the measurements as
independent, and the landmarks are solved for given the path.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from team.config import Bias
from team.estimation.gaussian import FAULTS, NotACovarianceError
from team.estimation.hybrid_slam.sensitivity_kernel import (
    BIASES,
    SINGULAR,
    Noise,
    columns_of_all,
)


class Motion(NamedTuple):
    """The motion up to a keyframe, or after the last one: its noise, its shift by `forward_scale`.

    covariance, forward: in the tangent space of the motion's end (forward [m], left [m], turn).
    """

    covariance: Float[np.ndarray, "3 3"]
    forward: Float[np.ndarray, "3"]


def columns(
    biases: Sequence[Bias],
    path: Float[np.ndarray, "P 3"],
    motions: Sequence[Motion],
    landmarks: Float[np.ndarray, "L 2"],
    measurements: tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " N"]],
    own: Float[np.ndarray, "N own"],
    noise: Noise,
) -> tuple[Float[np.ndarray, "B P 3"], Float[np.ndarray, "B L 2"]]:
    """∂/∂b of the path's poses (x, y, theta) and of the landmarks, in the window's frame.

    path: the pose at the end of each motion; the first motion begins at zero. measurements: of each
    the pose (an index into path) and the landmark; own: the noises that they claim. The bias b is
    the error: a bearing reads b too much, a range b too much or (1 + b) times itself, and the way
    driven is (1 + b) times the odometry's.
    """
    covariances = np.array([motion.covariance for motion in motions]).reshape(-1, 3, 3)
    shifts = np.array([motion.forward for motion in motions]).reshape(-1, 3)
    poses, points, fault = columns_of_all(
        path, covariances, shifts, landmarks, *measurements, own, noise
    )
    if fault == SINGULAR:
        raise np.linalg.LinAlgError("Singular matrix")
    if fault:
        raise NotACovarianceError("the smoother of a window", FAULTS[fault])
    chosen = [BIASES.index(bias) for bias in biases]
    return poses[chosen], points[chosen]
