"""A window's detections as arrays, their geometry, and their gates against landmarks."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation import dense
from teamslam.team.estimation.se2 import rotation
from teamslam.team.shapes import Bool, Float, Int64

UNASSIGNED = -1  # no identity, or no landmark
LEAST_DETERMINANT = 1e-32
"""Lower bound of |S| [m⁴]: the smallest accepted standard deviation is 1e-8 m."""


class Detections(NamedTuple):
    """Detections of a keyframe in the robot's frame [m, m²]; names: identities, or UNASSIGNED."""

    points: Float[np.ndarray, "n 2"]
    covariances: Float[np.ndarray, "n 2 2"]
    names: Int64[np.ndarray, " n"]

    def select(self, rows: Int64[np.ndarray, " k"]) -> "Detections":
        """Select some of the detections."""
        return Detections(self.points[rows], self.covariances[rows], self.names[rows])


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

    @cached_property
    def rows(self) -> list[slice]:
        """Detections of each keyframe."""
        bounds = np.searchsorted(self.keyframes, np.arange(len(self.motions) + 1)).tolist()
        return [slice(*each) for each in pairwise(bounds)]

    def detections(self, k: int) -> Detections:
        """Return the detections of keyframe k."""
        own = self.rows[k]
        return Detections(self.points[own], self.covariances[own], self.names[own])


def points_of(
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    variances: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Convert ranges and bearings with covariances (rr, rb, bb) to points, to first order."""
    s, c = core.sin_and_cos(bearings)
    J = np.stack((np.stack((c, -ranges * s), -1), np.stack((s, ranges * c), -1)), -2)
    R = variances[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.column_stack((ranges * c, ranges * s)), dense.congruent(J, R)


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
    own = dense.diagonal_blocks(P[rows, rows])
    cross = P[own_pose, rows].reshape(3, count, 2).transpose(1, 0, 2)
    mixed = dense.product(dense.product(Hp, cross), turn)
    S = dense.congruent(Hp, P[own_pose, own_pose]) + dense.congruent(turn.T, own)
    return seen, S + mixed + mixed.transpose(0, 2, 1)


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
    P[new, new] = dense.congruent(G, P[own_pose, own_pose]) + dense.congruent(turn, covariance)
    return np.asarray(pose[:2] + dense.product(turn, point))


def compute_mahalanobis(
    differences: Float[np.ndarray, "*n 2"], covariances: Float[np.ndarray, "*n 2 2"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Compute dᵀS⁻¹d and |S| of each difference d."""
    a, b, c = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    x, y = differences[..., 0], differences[..., 1]
    determinants = np.maximum(a * c - b * b, LEAST_DETERMINANT)
    return (c * x * x - 2.0 * b * x * y + a * y * y) / determinants, determinants


def match_scan(
    scan: Detections,
    predicted: tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2 2"]],
    mapped_names: Int64[np.ndarray, " L"],
    settings: AssociationSettings,
) -> Int64[np.ndarray, " n"]:
    """Match the detections of a scan with landmarks; UNASSIGNED without a match.

    An unnamed detection matches unnamed landmarks in its gate, χ² of two degrees of freedom; a
    named one its landmark at any distance. A pair costs dᵀS⁻¹d + ln|S|.
    """
    seen, spread = predicted
    S = spread[None] + settings.variance_factor * scan.covariances[:, None]
    squared, determinants = compute_mahalanobis(scan.points[:, None] - seen[None], S)
    allowed = scan.names[:, None] == mapped_names[None]
    allowed &= (squared < settings.gate) | (scan.names[:, None] != UNASSIGNED)
    return match_best_first(allowed, squared + core.log(determinants))


def match_best_first(
    allowed: Bool[np.ndarray, "n L"], costs: Float[np.ndarray, "n L"]
) -> Int64[np.ndarray, " n"]:
    """Assign a landmark to each detection, the allowed pair of least cost first, or UNASSIGNED.

    Equal costs keep their order.
    """
    found = np.full(len(allowed), UNASSIGNED)
    rows, columns = np.nonzero(allowed)
    assigned = np.zeros(allowed.shape[1], np.bool_)
    for index in np.argsort(costs[rows, columns], kind="stable"):
        row, column = rows[index], columns[index]
        if found[row] == UNASSIGNED and not assigned[column]:
            found[row], assigned[column] = column, True
    return found
