"""The path within a closed window, given the pose at its end.

Given the end, which a submap contains, the earlier poses are a linear Gaussian, so a map that moves
the two ends moves the path between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from teamslam.team import core
from teamslam.team.core import POSE_JITTER, on_group, sample_factor
from teamslam.team.estimation import dense
from teamslam.team.estimation.hybrid_slam.window import Window
from teamslam.team.estimation.se2 import Pose, wrapped
from teamslam.team.shapes import Float, Int64


@dataclass(frozen=True)
class WindowPath:
    """The K keyframes of a window, in the frame of its start.

    x_k = mean_k + gain_k (end − end_mean); poses are (x [m], y [m], theta [rad]). covariances: of
    x_k given the end.
    """

    stamps_ns: Int64[np.ndarray, " K"]
    means: Float[np.ndarray, "K 3"]
    gains: Float[np.ndarray, "K 3 3"]
    covariances: Float[np.ndarray, "K 3 3"]
    end_mean: Float[np.ndarray, "3"]


def window_path(window: Window, keyframes_ns: Sequence[int]) -> WindowPath:
    """Regress the path of a closed window's particles on their end.

    With the covariances P over (x_k, end), about the submap's means (`on_group`), gain = P_ke
    P_ee⁻¹ and the remainder P_kk − gain P_ek; P_ee has the submap's POSE_JITTER.
    """
    weights = core.exp(window.particles.log_weights)
    poses = np.concatenate((window.paths, window.particles.poses[None]))
    means, off = (
        np.array(each) for each in zip(*(on_group(at, weights) for at in poses), strict=True)
    )
    scaled = sample_factor(weights) * weights[None, :, None] * off
    P_ee = dense.product(scaled[-1].T, off[-1]) + np.diag(POSE_JITTER)
    P_ke = np.einsum("kmi,mj->kij", scaled[:-1], off[-1])
    P_kk = np.einsum("kmi,kmj->kij", scaled[:-1], off[:-1]) + np.diag(POSE_JITTER)
    gains = dense.solve(P_ee, P_ke.transpose(0, 2, 1)).transpose(0, 2, 1)
    left = P_kk - dense.product(gains, P_ke.transpose(0, 2, 1))
    return WindowPath(
        np.array(keyframes_ns, np.int64),
        means[:-1],
        gains,
        0.5 * (left + left.transpose(0, 2, 1)),
        means[-1],
    )


@dataclass(frozen=True)
class Ends:
    """Start and end pose of a window in the map, with joint 6 × 6 covariance."""

    start: Pose
    end: Pose
    covariance: Float[np.ndarray, "6 6"]


def placed(
    path: WindowPath, ends: Ends, covariance_factor: float = 1.0
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 3 3"]]:
    """Return keyframe poses and covariances in the map's frame, in (x, y, theta).

    x = start ∘ (mean + gain (start⁻¹ ∘ end − end_mean)), to first order in both ends and in the
    remainder, whose covariance is multiplied by covariance_factor.
    """
    heading = ends.start[2]
    s, c = core.sin_and_cos(heading)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    local_end = dense.product(turn.T, ends.end - ends.start)
    off = local_end - path.end_mean
    off[2] = wrapped(off[2])
    local = path.means + dense.product(path.gains, off)
    poses = ends.start + dense.product(local, turn.T)
    poses[:, 2] = core.atan2(core.sin(poses[:, 2]), core.cos(poses[:, 2]))
    J_end_start = np.column_stack((-turn.T[:, :2], [local_end[1], -local_end[0], -1.0]))
    covariances = np.empty((len(local), 3, 3))
    for k, (gain, left) in enumerate(zip(path.gains, path.covariances, strict=True)):
        moved = dense.product(turn, gain)
        J = np.concatenate(
            (dense.product(moved, J_end_start), dense.product(moved, turn.T)), axis=1
        )
        J[:, :3] += np.eye(3)
        J[:, 2] += [-s * local[k, 0] - c * local[k, 1], c * local[k, 0] - s * local[k, 1], 0.0]
        within = covariance_factor * dense.congruent(turn, left)
        covariances[k] = dense.congruent(J, ends.covariance) + within
    return poses, 0.5 * (covariances + covariances.transpose(0, 2, 1))
