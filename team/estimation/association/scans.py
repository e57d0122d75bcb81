"""A window's detections as arrays, and its geometry on many poses and points at once."""

from dataclasses import dataclass

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.shapes import Float, Int64

UNASSIGNED = -1  # no identity, or no landmark


@dataclass(frozen=True)
class Scans:
    """The motion of a window and the detections of each of its K keyframes.

    motions: pose of keyframe k in the frame of k − 1, of the first in that of the window's start.
    motion_covariances: of (forward, left, turn), in the tangent space of the motion's end.
    keyframes: of each of the N detections, ascending. points, covariances: in the robot's frame [m,
    m²]. names: identity of each, or UNASSIGNED.
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
    """Convert ranges and bearings with covariances (rr, rb, bb) to points, to first order."""
    s, c = core.sin_and_cos(bearings)
    J = np.stack((np.stack((c, -ranges * s), -1), np.stack((s, ranges * c), -1)), -2)
    R = variances[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.column_stack((ranges * c, ranges * s)), dense.product(
        dense.product(J, R), J.transpose(0, 2, 1)
    )


def rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    """Return the rotation matrix of an angle."""
    s, c = core.sin_and_cos(angle)
    return np.array([[c, -s], [s, c]])


def rotations(angles: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2 2"]:
    """Return the rotation matrix of each angle."""
    s, c = core.sin_and_cos(angles)
    return np.stack((c, -s, s, c), -1).reshape(-1, 2, 2)


def relative_to(
    poses: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Transform each point into the frame of its pose: Rᵀ(p − t)."""
    apart = points - poses[:, :2]
    return np.asarray(np.einsum("nji,nj->ni", rotations(poses[:, 2]), apart))


def pose_jacobians(seen: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 3"]:
    """Compute ∂h/∂ξ of h(pose ∘ Exp(ξ), point) = (x, y): [−1, 0, y; 0, −1, −x]."""
    J = np.zeros((len(seen), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = -1.0
    J[:, 0, 2], J[:, 1, 2] = seen[:, 1], -seen[:, 0]
    return J


def predict_landmarks(
    pose: Float[np.ndarray, "3"],
    landmarks: Float[np.ndarray, "L 2"],
    P: Float[np.ndarray, "n n"],
    at: int,
    first: int,
) -> tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2 2"]]:
    """Predict each landmark's position relative to a pose, with its covariance.

    P: joint covariance with the pose at `at` and the landmarks at `first`.
    """
    count, own_pose = len(landmarks), slice(at, at + 3)
    turn = rotation(pose[2])
    seen = dense.product(landmarks - pose[:2], turn)
    Hp = pose_jacobians(seen)
    rows = slice(first, first + 2 * count)
    own = P[rows, rows].reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]
    cross = P[own_pose, rows].reshape(3, count, 2).transpose(1, 0, 2)
    mixed = dense.product(dense.product(Hp, cross), turn)
    S = dense.product(dense.product(Hp, P[own_pose, own_pose]), Hp.transpose(0, 2, 1))
    S = S + dense.product(dense.product(turn.T, own), turn) + mixed + mixed.transpose(0, 2, 1)
    return seen, S


def initialise_landmark(
    pose: Float[np.ndarray, "3"],
    point: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "2 2"],
    P: Float[np.ndarray, "n n"],
    at: int,
    end: int,
) -> Float[np.ndarray, "2"]:
    """Initialise a landmark from a detection: return its position, write its covariance to P.

    P: joint covariance of `end` numbers with the pose at `at`; written in place.
    """
    own_pose, new = slice(at, at + 3), slice(end, end + 2)
    turn = rotation(pose[2])
    G = dense.product(turn, np.array([[1.0, 0.0, -point[1]], [0.0, 1.0, point[0]]]))
    P[new, :end] = dense.product(G, P[own_pose, :end])
    P[:end, new] = P[new, :end].T
    P[new, new] = dense.product(dense.product(G, P[own_pose, own_pose]), G.T) + dense.product(
        dense.product(turn, covariance), turn.T
    )
    return np.asarray(pose[:2] + dense.product(turn, point))
