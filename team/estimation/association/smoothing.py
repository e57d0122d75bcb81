"""Estimates a window's path and landmarks jointly by Gauss-Newton, for a given association."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from team.estimation import dense
from team.estimation.association.scans import (
    NOBODY,
    Scans,
    pose_jacobians,
    rotation,
    rotations,
    seen_from,
)
from team.estimation.geometry import wrapped

JITTER = np.diag([1e-6, 1e-6, 1e-8])
"""Added to each motion's covariance [m², m², rad²]: noise of motion may be of rank 2 or none."""
ITERATIONS = 6
SETTLED = 1e-4
"""The iteration ends at a step whose largest entry [m, rad] is smaller: it changes no
association."""


@dataclass(frozen=True)
class Smoothed:
    """N(·) of K poses and L landmarks in the window's frame; the poses' errors on their right.

    covariance: of (ξ₁ … ξ_K, landmarks). squared: the cost at the minimum, with `dof` degrees.
    """

    poses: Float[np.ndarray, "K 3"]
    landmarks: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]
    squared: float
    dof: int


def predicted_by(
    now: Smoothed, k: int
) -> tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2 2"]]:
    """The position of each landmark relative to pose k, and its covariance."""
    poses, count = len(now.poses), len(now.landmarks)
    return seen_with(
        now.poses[k], now.landmarks, now.covariance, slice(3 * k, 3 * k + 3), 3 * poses, count
    )


def seen_with(
    pose: Float[np.ndarray, "3"],
    landmarks: Float[np.ndarray, "L 2"],
    P: Float[np.ndarray, "n n"],
    at: slice,
    first: int,
    count: int,
) -> tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2 2"]]:
    """The same from a joint covariance in which the pose stands at `at` and `count` landmarks
    from `first` on.
    """
    turn = rotation(pose[2])
    seen = dense.product(landmarks - pose[:2], turn)
    Hp = pose_jacobians(seen)
    rows = slice(first, first + 2 * count)
    own = P[rows, rows].reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]
    cross = P[at, rows].reshape(3, count, 2).transpose(1, 0, 2)
    mixed = dense.product(dense.product(Hp, cross), turn)
    spread = dense.product(dense.product(Hp, P[at, at]), Hp.transpose(0, 2, 1)) + dense.product(
        dense.product(turn.T, own), turn
    )
    spread += mixed + mixed.transpose(0, 2, 1)
    return seen, spread


def smoothed(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    poses: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
) -> Smoothed:
    """Minimise Σ ‖Log(motion⁻¹ ∘ pose₋₁⁻¹ ∘ pose)‖² + Σ ‖point − Rᵀ(landmark − t)‖².

    In the metrics of their covariances, the window's start at zero. landmark_of: of each detection
    that counts; every landmark is seen at least once. Raises LinAlgError without a solution.
    """
    used = np.nonzero(landmark_of != NOBODY)[0]
    seen_by, seen = scans.keyframes[used], landmark_of[used]
    weights = dense.inverse(scans.covariances[used])
    motion_weights = dense.inverse(scans.motion_covariances + JITTER)
    k, size = len(poses), 3 * len(poses) + 2 * len(landmarks)
    of_pose = 3 * seen_by[:, None] + np.arange(3)
    of_landmark = 3 * k + 2 * seen[:, None] + np.arange(2)
    columns = np.concatenate((of_pose, of_landmark), axis=1)
    for iteration in range(ITERATIONS + 1):
        information, gradient, squared = _of_motion(scans.motions, motion_weights, poses, size)
        predicted = seen_from(poses[seen_by], landmarks[seen])
        error = scans.points[used] - predicted
        turned = rotations(poses[seen_by, 2]).transpose(0, 2, 1)
        J = np.concatenate((pose_jacobians(predicted), turned), axis=2)
        JW = dense.product(J.transpose(0, 2, 1), weights)
        np.add.at(information, (columns[:, :, None], columns[:, None, :]), dense.product(JW, J))
        np.add.at(gradient, columns, np.einsum("nij,nj->ni", JW, error))
        squared += float(np.einsum("ni,nij,nj->", error, weights, error))
        factor = dense.cholesky(information)
        step = dense.solve_factored(factor, gradient)
        if not np.isfinite(step).all():
            raise np.linalg.LinAlgError("the window has no solution")
        if iteration == ITERATIONS or np.abs(step).max(initial=0.0) < SETTLED:
            break
        poses, landmarks = _moved(poses, step[: 3 * k]), landmarks + step[3 * k :].reshape(-1, 2)
    dof = 2 * len(used) - 2 * len(landmarks)
    return Smoothed(poses, landmarks, dense.inverse_of_factored(factor), squared, dof)


def _of_motion(
    motions: Float[np.ndarray, "K 3"],
    weights: Float[np.ndarray, "K 3 3"],
    poses: Float[np.ndarray, "K 3"],
    size: int,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"], float]:
    """Information, gradient and cost of the motions alone; residual ≈ error of the motion's end."""
    k = len(poses)
    before = np.concatenate((np.zeros((1, 3)), poses[:-1]))
    went = np.column_stack((seen_from(before, poses[:, :2]), poses[:, 2] - before[:, 2]))
    error = np.column_stack((seen_from(motions, went[:, :2]), went[:, 2] - motions[:, 2]))
    error[:, 2] = _directions(error[:, 2])
    back = np.zeros((k, 3, 3))  # −Ad(went⁻¹): the earlier pose's error at the later one
    turned = rotations(went[:, 2]).transpose(0, 2, 1)
    shift = -np.einsum("kij,kj->ki", turned, went[:, :2])
    back[:, :2, :2] = -turned
    back[:, 0, 2], back[:, 1, 2], back[:, 2, 2] = -shift[:, 1], shift[:, 0], -1.0
    information, gradient = np.zeros((size, size)), np.zeros(size)
    BW = dense.product(back.transpose(0, 2, 1), weights)
    BWB = dense.product(BW, back)
    W_error, BW_error = np.einsum("kij,kj->ki", weights, error), np.einsum("kij,kj->ki", BW, error)
    for i in range(k):
        a, b = slice(3 * i - 3, 3 * i), slice(3 * i, 3 * i + 3)
        information[b, b] += weights[i]
        gradient[b] -= W_error[i]
        if i:
            information[a, a] += BWB[i]
            information[a, b] += BW[i]
            information[b, a] += BW[i].T
            gradient[a] -= BW_error[i]
    return information, gradient, float(np.einsum("ki,ki->", error, W_error))


def _directions(angles: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return np.array([wrapped(float(angle)) for angle in angles])


def _moved(
    poses: Float[np.ndarray, "K 3"], steps: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "K 3"]:
    """The poses after a step (forward, left, turn) of each; Exp to first order."""
    xi = steps.reshape(-1, 3)
    went = np.einsum("kij,kj->ki", rotations(poses[:, 2]), xi[:, :2])
    return np.column_stack((poses[:, :2] + went, _directions(poses[:, 2] + xi[:, 2])))
