"""A window's detections as arrays, and geometry on many poses and points at once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from team.estimation import dense, elementary, elementwise

NOBODY = -1
"""Stands for no identity and for no landmark."""


@dataclass(frozen=True)
class Scans:
    """The motion of a window and what was detected at each of its K keyframes.

    motions:     the pose of keyframe k in the frame of keyframe k − 1; of the first, in that of the
                 window's start.
    motion_covariances: of (forward, left, turn), in the tangent space of the motion's end.
    keyframes:   the keyframe of each of the N detections, ascending.
    points:      where they are in the robot's frame at their keyframe [m].
    covariances: of the points [m²].
    names:       the identity of those that have one, NOBODY of the others.
    """

    motions: Float[np.ndarray, "K 3"]
    motion_covariances: Float[np.ndarray, "K 3 3"]
    keyframes: Int64[np.ndarray, " N"]
    points: Float[np.ndarray, "N 2"]
    covariances: Float[np.ndarray, "N 2 2"]
    names: Int64[np.ndarray, " N"]

    @property
    def bounds(self) -> Int64[np.ndarray, " bounds"]:
        """Detections bounds[k] to bounds[k + 1] are of keyframe k."""
        return np.searchsorted(self.keyframes, np.arange(len(self.motions) + 1))


def points_of(
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    variances: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Convert ranges and bearings with covariances (rr, rb, bb) to points with theirs, to first
    order.
    """
    s, c = elementwise.sin_and_cos(bearings)
    J = np.stack((np.stack((c, -ranges * s), -1), np.stack((s, ranges * c), -1)), -2)
    R = variances[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.column_stack((ranges * c, ranges * s)), dense.product(
        dense.product(J, R), J.transpose(0, 2, 1)
    )


def rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    """The rotation matrix of an angle."""
    s, c = elementary.sin_and_cos(angle)
    return np.array([[c, -s], [s, c]])


def rotations(angles: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2 2"]:
    """The rotation matrix of each angle."""
    s, c = elementwise.sin_and_cos(angles)
    return np.stack((np.stack((c, -s), -1), np.stack((s, c), -1)), -2)


def path_of(motions: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
    """The poses that the motions lead to, from the zero pose."""
    headings = np.cumsum(motions[:, 2])
    before = np.concatenate(([0.0], headings[:-1]))
    steps = np.einsum("kij,kj->ki", rotations(before), motions[:, :2])
    return np.column_stack((np.cumsum(steps, axis=0), headings))


def seen_from(
    poses: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Each point in the frame of its pose: Rᵀ(p − t)."""
    apart = points - poses[:, :2]
    return np.asarray(np.einsum("nji,nj->ni", rotations(poses[:, 2]), apart))


def pose_jacobians(seen: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 3"]:
    """∂h/∂ξ of h(pose ∘ Exp(ξ), point) = (x, y): [−1, 0, y; 0, −1, −x]."""
    J = np.zeros((len(seen), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = -1.0
    J[:, 0, 2], J[:, 1, 2] = seen[:, 1], -seen[:, 0]
    return J
