"""The kernels of `sensitivity`: a window's smoother, and how its landmarks answer the path's."""

import math
from typing import get_args

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.config import Bias
from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.dense_kernel import solve_stack
from team.estimation.geometry import adjoint, between
from team.estimation.hybrid_slam.arrow_kernel import solve_arrow
from team.estimation.hybrid_slam.fastslam import Noise
from team.estimation.models import NEAREST_M
from team.estimation.placing import put_block

BIASES: tuple[Bias, ...] = get_args(Bias)
"""The biases in the order of the columns."""
BEARING, FORWARD_SCALE, RANGE_OFFSET, RANGE_SCALE = range(len(BIASES))
MOTION_JITTER = (1e-7, 1e-7, 1e-9)
"""Added to each motion's variances [m², m², rad²]: noise of rank 2 has no information matrix."""
SINGULAR = -1
"""The fault of a motion whose noise has no inverse; others are indices in `gaussian.FAULTS`."""


@compiled
def carried_on(
    column: Float[np.ndarray, "3"], motion: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """A shift of the earlier motion, seen at the end of a further motion: Ad(motion⁻¹) column."""
    s, c = elementary.sin_and_cos(motion[2])
    x = column[0] - motion[1] * column[2]
    y = column[1] + motion[0] * column[2]
    return np.array([c * x + s * y, -s * x + c * y, column[2]])


@compiled
def columns_along(
    keyframe_poses: Float[np.ndarray, "K 3"],
    end: Float[np.ndarray, "3"],
    covariances: Float[np.ndarray, "P 3 3"],
    shifts: Float[np.ndarray, "P 3"],
    ids: UInt32[np.ndarray, " L"],
    landmarks: Float[np.ndarray, "L 2"],
    keyframes: Int64[np.ndarray, " N"],
    seen: UInt32[np.ndarray, " N"],
    own: Float[np.ndarray, "N own"],
    noise: Noise,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "B P 3"], Float[np.ndarray, "B L 2"], int]:
    """`columns_of_all` about the path of the keyframes and the end, which is returned, too."""
    path = np.concatenate((keyframe_poses, end.reshape(1, 3)))[: len(shifts)].copy()
    slots = np.searchsorted(ids, seen)
    poses, points, fault = columns_of_all(
        path, covariances, shifts, landmarks, keyframes, slots, own, noise
    )
    return path, poses, points, fault


@compiled
def rows_of(
    chosen: Int64[np.ndarray, " b"],
    poses: Float[np.ndarray, "B P 3"],
    points: Float[np.ndarray, "B L 2"],
    nodes: Int64[np.ndarray, " nodes"],
) -> Float[np.ndarray, "b n"]:
    """The chosen biases' rows over the last pose, the poses at `nodes` and the points."""
    first = 3 + 3 * len(nodes)
    rows = np.zeros((len(chosen), first + 2 * points.shape[1]))
    for b in range(len(chosen)):
        of_poses, of_points, row = poses[chosen[b]], points[chosen[b]], rows[b]
        for i in range(3 if len(of_poses) else 0):
            row[i] = of_poses[len(of_poses) - 1, i]
            for k in range(len(nodes)):
                row[3 + 3 * k + i] = of_poses[nodes[k], i]
        for k in range(len(of_points)):
            row[first + 2 * k], row[first + 2 * k + 1] = of_points[k, 0], of_points[k, 1]
    return rows


@compiled
def columns_of_all(
    path: Float[np.ndarray, "P 3"],
    covariances: Float[np.ndarray, "P 3 3"],
    shifts: Float[np.ndarray, "P 3"],
    landmarks: Float[np.ndarray, "L 2"],
    at: Int64[np.ndarray, " N"],
    slots: Int64[np.ndarray, " N"],
    own: Float[np.ndarray, "N own"],
    noise: Noise,
) -> tuple[Float[np.ndarray, "B P 3"], Float[np.ndarray, "B L 2"], int]:
    """`columns` by all biases; and why there are none: SINGULAR, or an index in FAULTS."""
    count, biases = len(path), len(BIASES)
    poses, none = np.zeros((biases, count, 3)), np.zeros((biases, len(landmarks), 2))
    metrics, noises = np.zeros((count, 3, 3)), covariances.copy()
    for k in range(count):
        for i in range(3):
            metrics[k, i, i] = 1.0
            noises[k, i, i] += MOTION_JITTER[i]
    if not solve_stack(noises, metrics):
        return poses, none, SINGULAR
    size = 3 * count + 2 * len(landmarks)
    A, right = np.zeros((size, size)), np.zeros((size, biases))
    rows = _measurement_rows(path, landmarks, at, slots, own, noise)
    _add_motions(A, right, path, metrics, shifts)
    _add_measurements(A, right, rows, at, slots, 3 * count)
    fault = solve_arrow(A, right, 3 * count)
    if fault:
        return poses, none, fault
    twists = right[: 3 * count].T.copy().reshape(biases, count, 3)
    for k in range(count):
        s, c = elementary.sin_and_cos(path[k, 2])
        for b in range(biases):
            x, y = twists[b, k, 0], twists[b, k, 1]
            poses[b, k, 0], poses[b, k, 1] = c * x - s * y, s * x + c * y
            poses[b, k, 2] = twists[b, k, 2]
    return poses, _landmarks_given(twists, rows, at, slots, len(landmarks), noise), 0


@compiled
def _add_motions(
    A: Float[np.ndarray, "n n"],
    right: Float[np.ndarray, "n B"],
    path: Float[np.ndarray, "P 3"],
    metrics: Float[np.ndarray, "P 3 3"],
    shifts: Float[np.ndarray, "P 3"],
) -> None:
    """Residual ξ_k − Ad(x_k⁻¹ x_{k−1}) ξ_{k−1} − shift·b in the metric C⁻¹, for each motion."""
    for k in range(len(path)):
        before = np.zeros(3) if k == 0 else path[k - 1]
        J = np.zeros((3, 6))
        put_block(J, 0, 0, -adjoint(between(path[k], before)))
        for i in range(3):
            J[i, 3 + i] = 1.0
        for i in range(6):
            if k == 0 and i < 3:
                continue
            row = 3 * (k - 1) + i
            weighted = np.zeros(3)
            for a in range(3):
                for b in range(3):
                    weighted[b] += J[a, i] * metrics[k, a, b]
            for b in range(3):
                right[row, FORWARD_SCALE] += weighted[b] * shifts[k, b]
            for j in range(6):
                if k > 0 or j >= 3:
                    for b in range(3):
                        A[row, 3 * (k - 1) + j] += weighted[b] * J[b, j]


@compiled
def _measurement_rows(
    path: Float[np.ndarray, "P 3"],
    landmarks: Float[np.ndarray, "L 2"],
    poses: Int64[np.ndarray, " N"],
    slots: Int64[np.ndarray, " N"],
    own: Float[np.ndarray, "N own"],
    noise: Noise,
) -> Float[np.ndarray, "N 2 8"]:
    """Of each measurement, for range and bearing: ∂h by the pose and the landmark, g, the variance,
    and how much of the range's row is taken from the bearing's: its regression on it.
    """
    rows = np.zeros((len(poses), 2, 8))
    for n in range(len(poses)):
        pose = path[poses[n]]
        dx, dy = landmarks[slots[n], 0] - pose[0], landmarks[slots[n], 1] - pose[1]
        distance = max(math.sqrt(dx * dx + dy * dy), NEAREST_M)
        direction = elementary.atan2(dy, dx)
        bearing = direction - pose[2]
        of_range, of_bearing = rows[n, 0], rows[n, 1]
        s, c = elementary.sin_and_cos(bearing)
        sine, cosine = elementary.sin_and_cos(direction)
        of_range[0], of_range[1] = -c, -s
        of_range[3], of_range[4] = cosine, sine
        of_range[5] = distance
        of_range[6] = noise.range_variance + noise.range_per_m2 * distance * distance
        of_bearing[0], of_bearing[1] = s / distance, -c / distance
        of_bearing[2] = -1.0
        of_bearing[3], of_bearing[4] = -sine / distance, cosine / distance
        of_bearing[5] = 1.0
        of_bearing[6] = noise.bearing_variance
        if own.shape[1] and own[n, 3] >= 0.0:
            slope = own[n, 1] / own[n, 0]
            of_range[6] = own[n, 0]
            of_bearing[6] = own[n, 2] - slope * own[n, 1]
            of_bearing[7] = slope
            for i in range(5):
                of_bearing[i] -= slope * of_range[i]
    return rows


@compiled
def _add_measurements(
    A: Float[np.ndarray, "n n"],
    right: Float[np.ndarray, "n B"],
    rows: Float[np.ndarray, "N 2 8"],
    poses: Int64[np.ndarray, " N"],
    slots: Int64[np.ndarray, " N"],
    first: int,
) -> None:
    """Residual h(pose, landmark) + g b of measurements that are independent, as particles weigh
    them.

    first: where the landmarks' unknowns begin.
    """
    at = np.empty(5, dtype=np.int64)
    for n in range(len(rows)):
        for i in range(3):
            at[i] = 3 * poses[n] + i
        at[3], at[4] = first + 2 * slots[n], first + 2 * slots[n] + 1
        for kind in range(2):
            row = rows[n, kind]
            for i in range(5):
                weighted = row[i] / row[6]
                if kind:
                    right[at[i], BEARING] -= weighted * row[5]
                    if row[7] != 0.0:
                        right[at[i], RANGE_OFFSET] += weighted * row[7]
                        right[at[i], RANGE_SCALE] += weighted * row[7] * rows[n, 0, 5]
                else:
                    right[at[i], RANGE_OFFSET] -= weighted
                    right[at[i], RANGE_SCALE] -= weighted * row[5]
                for j in range(5):
                    A[at[i], at[j]] += weighted * row[j]


@compiled
def _add_given_path(
    A: Float[np.ndarray, "2 2"],
    right: Float[np.ndarray, "2 B"],
    rows: Float[np.ndarray, "n 8"],
    shifts: Float[np.ndarray, "n B"],
    white: float,
) -> None:
    """The ranges or the bearings of one landmark, given by how much each residual moves.

    The share of the variance that is not white is one constant error, eliminated by Schur's
    complement.
    """
    count, biases = shifts.shape
    column, error, total = np.zeros(2), np.zeros(biases), 0.0
    for n in range(count):
        weight = 1.0 / (white * rows[n, 6])
        total += weight
        for b in range(biases):
            error[b] += weight * shifts[n, b]
        for i in range(2):
            column[i] += weight * rows[n, 3 + i]
            for b in range(biases):
                right[i, b] -= weight * rows[n, 3 + i] * shifts[n, b]
            for j in range(2):
                A[i, j] += weight * rows[n, 3 + i] * rows[n, 3 + j]
    if white < 1.0:
        share = 1.0 / (total + 1.0 / ((1.0 - white) * rows[count - 1, 6]))
        for i in range(2):
            for b in range(biases):
                right[i, b] += share * column[i] * error[b]
            for j in range(2):
                A[i, j] -= share * column[i] * column[j]


@compiled
def _landmarks_given(
    twists: Float[np.ndarray, "B P 3"],
    rows: Float[np.ndarray, "N 2 8"],
    poses: Int64[np.ndarray, " N"],
    slots: Int64[np.ndarray, " N"],
    count: int,
    noise: Noise,
) -> Float[np.ndarray, "B L 2"]:
    """How the landmarks answer, given the path's answer, as they are solved again at the end."""
    biases = len(twists)
    moved = np.zeros((biases, count, 2))
    for landmark in range(count):
        own = np.flatnonzero(slots == landmark)
        A, right = np.zeros((2, 2)), np.zeros((2, biases))
        for kind in range(2):
            shifts = np.zeros((len(own), biases))
            for k in range(len(own)):
                row = rows[own[k], kind]
                if kind:
                    shifts[k, BEARING] = row[5]
                    shifts[k, RANGE_OFFSET] = -row[7]
                    shifts[k, RANGE_SCALE] = -row[7] * rows[own[k], 0, 5]
                else:
                    shifts[k, RANGE_OFFSET], shifts[k, RANGE_SCALE] = 1.0, row[5]
                for b in range(biases):
                    twist = twists[b, poses[own[k]]]
                    shifts[k, b] += row[0] * twist[0] + row[1] * twist[1] + row[2] * twist[2]
            white = noise.bearing_white if kind else noise.range_white
            _add_given_path(A, right, rows[own, kind], shifts, white)
        determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        for b in range(biases):
            x, y = right[0, b], right[1, b]
            moved[b, landmark, 0] = (A[1, 1] * x - A[0, 1] * y) / determinant
            moved[b, landmark, 1] = (A[0, 0] * y - A[1, 0] * x) / determinant
    return moved
