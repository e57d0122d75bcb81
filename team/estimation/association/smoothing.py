"""Estimate a window's path and landmarks by Gauss-Newton for a given association."""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.team.estimation import dense
from teamslam.team.estimation.association.scans import (
    UNASSIGNED,
    Scans,
    pose_jacobians,
    relative_to,
    rotations,
)
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Bool, Float, Int64

JITTER = np.diag([1e-6, 1e-6, 1e-8])
"""Added to each motion's covariance [m², m², rad²], which may be of rank 2 or zero."""
ITERATIONS = 6  # most Gauss-Newton steps
SETTLED = 1e-4  # largest entry [m, rad] of a last step: it changes no association


@dataclass(frozen=True)
class SmoothedWindow:
    """Gaussian of K poses and L landmarks in the window's frame; errors of poses on their right.

    covariance: of (ξ₁ … ξ_K, landmarks). squared: the cost, with `dof` degrees of freedom.
    """

    poses: Float[np.ndarray, "K 3"]
    landmarks: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]
    squared: float
    dof: int


def smooth_window(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    poses: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
) -> SmoothedWindow:
    """Minimise Σ ‖Log(motion⁻¹ ∘ before⁻¹ ∘ pose)‖² + Σ ‖point − Rᵀ(landmark − t)‖².

    The window starts at zero. landmark_of: by detection, or UNASSIGNED; every landmark has a
    detection. Raises LinAlgError without a solution.
    """
    counts = np.bincount(landmark_of[landmark_of != UNASSIGNED], minlength=len(landmarks))
    again = counts > 1
    number = np.append(np.where(again, np.cumsum(again) - 1, UNASSIGNED), UNASSIGNED)
    found = _solve_window(scans, number[landmark_of], poses, landmarks[again])
    return found if again.all() else _add_single(found, scans, landmark_of, again)


def _add_single(
    found: SmoothedWindow,
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    again: Bool[np.ndarray, " L"],
) -> SmoothedWindow:
    """Add the landmarks of a single detection, with covariance A P Aᵀ + R."""
    rows = np.flatnonzero(~np.append(again, True)[landmark_of])
    rows = rows[np.argsort(landmark_of[rows])]
    of, m, n = scans.keyframes[rows], len(rows), len(found.covariance)
    turn = rotations(found.poses[of, 2])
    columns, at = 3 * of[:, None] + np.arange(3), np.arange(m)
    A = np.zeros((2 * m, n))
    by_pose = -dense.product(turn, pose_jacobians(scans.points[rows]))
    A.reshape(m, 2, n)[at[:, None], :, columns] = by_pose.transpose(0, 2, 1)
    AP = dense.product(A, found.covariance)
    own = dense.product(AP, A.T)
    dense.add_to_blocks(own, dense.congruent(turn, scans.covariances[rows]))
    landmarks = np.empty((len(again), 2))
    landmarks[again] = found.landmarks
    landmarks[~again] = found.poses[of, :2] + np.einsum("nij,nj->ni", turn, scans.points[rows])
    order = np.argsort(np.concatenate((np.flatnonzero(again), np.flatnonzero(~again))))
    k = 3 * len(found.poses)
    all_columns = np.append(np.arange(k), (k + 2 * order[:, None] + np.arange(2)).ravel())
    P = np.block([[found.covariance, AP.T], [AP, own]])[np.ix_(all_columns, all_columns)]
    return replace(found, landmarks=landmarks, covariance=P)


def _solve_window(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    poses: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
) -> SmoothedWindow:
    used = np.nonzero(landmark_of != UNASSIGNED)[0]
    seen_by, seen = scans.keyframes[used], landmark_of[used]
    weights = dense.inverse(scans.covariances[used])
    motion_weights = dense.inverse(scans.motion_covariances + JITTER)
    k, size = len(poses), 3 * len(poses) + 2 * len(landmarks)
    of_pose = 3 * seen_by[:, None] + np.arange(3)
    of_landmark = 3 * k + 2 * seen[:, None] + np.arange(2)
    columns = np.concatenate((of_pose, of_landmark), axis=1)
    for iteration in range(ITERATIONS + 1):
        information, gradient, squared = _linearise_motions(
            scans.motions, motion_weights, poses, size
        )
        predicted = relative_to(poses[seen_by], landmarks[seen])
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
        poses, landmarks = (
            _apply_step(poses, step[: 3 * k]),
            landmarks + step[3 * k :].reshape(-1, 2),
        )
    dof = 2 * len(used) - 2 * len(landmarks)
    return SmoothedWindow(poses, landmarks, dense.inverse_of_factored(factor), squared, dof)


def _linearise_motions(
    motions: Float[np.ndarray, "K 3"],
    weights: Float[np.ndarray, "K 3 3"],
    poses: Float[np.ndarray, "K 3"],
    size: int,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"], float]:
    k = len(poses)
    before = np.concatenate((np.zeros((1, 3)), poses[:-1]))
    went = np.column_stack((relative_to(before, poses[:, :2]), poses[:, 2] - before[:, 2]))
    error = np.column_stack((relative_to(motions, went[:, :2]), went[:, 2] - motions[:, 2]))
    error[:, 2] = wrapped(error[:, 2])
    back = np.zeros((k, 3, 3))  # −Ad(went⁻¹): the earlier pose's error at the later one
    turned = rotations(went[:, 2]).transpose(0, 2, 1)
    shift = -np.einsum("kij,kj->ki", turned, went[:, :2])
    back[:, :2, :2] = -turned
    back[:, 0, 2], back[:, 1, 2], back[:, 2, 2] = -shift[:, 1], shift[:, 0], -1.0
    information, gradient = np.zeros((size, size)), np.zeros(size)
    BW = dense.product(back.transpose(0, 2, 1), weights)
    BWB = dense.product(BW, back)
    W_error, BW_error = np.einsum("kij,kj->ki", weights, error), np.einsum("kij,kj->ki", BW, error)
    blocks, of_pose = information[: 3 * k, : 3 * k].reshape(k, 3, k, 3), gradient[: 3 * k]
    at = np.arange(k)
    blocks[at, :, at] += weights
    blocks[at[:-1], :, at[:-1]] += BWB[1:]
    blocks[at[:-1], :, at[1:]] += BW[1:]
    blocks[at[1:], :, at[:-1]] += BW[1:].transpose(0, 2, 1)
    of_pose -= W_error.ravel()
    of_pose[:-3] -= BW_error[1:].ravel()
    return information, gradient, float(np.einsum("ki,ki->", error, W_error))


def _apply_step(
    poses: Float[np.ndarray, "K 3"], steps: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "K 3"]:
    xi = steps.reshape(-1, 3)
    went = np.einsum("kij,kj->ki", rotations(poses[:, 2]), xi[:, :2])
    return np.column_stack((poses[:, :2] + went, wrapped(poses[:, 2] + xi[:, 2])))
