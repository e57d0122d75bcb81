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
from jaxtyping import Float, Int64, UInt32

from team.config import Bias
from team.estimation.gaussian import FAULTS, NotACovarianceError
from team.estimation.hybrid_slam.fastslam import Noise
from team.estimation.hybrid_slam.sensitivity_kernel import (
    BIASES,
    SINGULAR,
    columns_along,
    rows_of,
)


class WindowMotions(NamedTuple):
    """The motions up to each keyframe, and after the last one: the noise of each, and its shift by
    `forward_scale`, both in the tangent space of the motion's end (forward [m], left [m], turn).
    """

    covariances: Float[np.ndarray, "P 3 3"]
    shifts: Float[np.ndarray, "P 3"]

    def then(
        self, covariance: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]
    ) -> "WindowMotions":
        """With one more."""
        covariances = np.concatenate((self.covariances, covariance[None]))
        return WindowMotions(covariances, np.concatenate((self.shifts, shift[None])))


NO_MOTIONS = WindowMotions(np.empty((0, 3, 3)), np.empty((0, 3)))


class WindowSights(NamedTuple):
    """The measurements of a window: of each the keyframe, the landmark and the noise it claims."""

    keyframes: Int64[np.ndarray, " N"]
    ids: UInt32[np.ndarray, " N"]
    own: Float[np.ndarray, "N own"]


def columns(
    path: Float[np.ndarray, "K 3"],
    end: Float[np.ndarray, "3"],
    motions: WindowMotions,
    landmarks: tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, "L 2"]],
    seen: WindowSights,
    noise: Noise,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "B P 3"], Float[np.ndarray, "B L 2"]]:
    """The path to the window's end, and ∂/∂b of its poses (x, y, theta) and of the landmarks.

    All are in the window's frame, ∂/∂b by each of BIASES. path: the particles' mean poses at the
    keyframes; end: the mean pose at the window's end. The bias b is the error: a bearing reads b
    too much, a range b too much or (1 + b) times itself, and the way driven is (1 + b) times the
    odometry's.
    """
    whole, poses, points, fault = columns_along(path, end, *motions, *landmarks, *seen, noise)
    if fault == SINGULAR:
        raise np.linalg.LinAlgError("Singular matrix")
    if fault:
        raise NotACovarianceError("the smoother of a window", FAULTS[fault])
    return whole, poses, points


def rows(
    biases: Sequence[Bias],
    poses: Float[np.ndarray, "B P 3"],
    points: Float[np.ndarray, "B L 2"],
    nodes: Int64[np.ndarray, " nodes"],
) -> Float[np.ndarray, "b n"]:
    """∂/∂b of (end pose, pose nodes, landmarks) by some of BIASES; nodes: places in the path."""
    chosen = np.array([BIASES.index(bias) for bias in biases], np.int64)
    return rows_of(chosen, np.ascontiguousarray(poses), np.ascontiguousarray(points), nodes)
