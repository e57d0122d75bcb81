"""The factors of the batch MAP, all of one kind at once: residuals, derivatives, their pattern.

Poses are perturbed on the right, pose ∘ Exp(ξ), ξ = (forward [m], left [m], turn [rad]); landmarks
by addition [m]. With P⁻¹ a factor's information and its residual r zero in the mean:

start     r = Log(mean⁻¹ ∘ x),                      ∂r/∂ξ = Jr⁻¹(r)
odometry  r = Log(mean⁻¹ ∘ h), h = a⁻¹ ∘ b,         ∂r/∂ξ_b = Jr⁻¹(r), ∂r/∂ξ_a = −Jr⁻¹(r) Ad(h⁻¹)
measurement   r = (predicted − measured) of range and bearing, the bearing's on the circle.

Log and Jr⁻¹ are those of SE(2): Solà et al., A micro Lie theory, eq. 158 and 163. Each row equals
the result of `geometry` and `models` for one factor, and every sum runs in the order of the
factors.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.estimation import dense, elementary, elementwise
from team.estimation.compiled import compiled
from team.estimation.geometry import (
    adjoint,
    between,
    compose,
    exponential,
    inverse,
    logarithm,
    wrapped,
)
from team.estimation.hybrid_slam.landmark_kernel import innovation_of
from team.estimation.map_joining.joining_kernel import block_pattern
from team.estimation.models import landmark_jacobian, pose_jacobian, predicted
from team.estimation.sparse_cholesky.sparse import Analysis, Pattern, analysed

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Rows = Float[np.ndarray, "n 3"]
Blocks = Float[np.ndarray, "n 3 3"]
Poses = Float[np.ndarray, "K 3"]
Points = Float[np.ndarray, "L 2"]

SMALL_TURN = 1e-4
"""Below it [rad] the quotients of Jr are taken from their series."""


class Starts(NamedTuple):
    """Given initial poses: pose [node], mean (x [m], y [m], θ [rad]), information of ξ."""

    pose: Indices
    mean: Rows
    information: Blocks


class Motions(NamedTuple):
    """The odometry from pose `before` to pose `after`: truth = mean ∘ Exp(ξ), ξ ~ N(0, P)."""

    before: Indices
    after: Indices
    mean: Rows
    information: Blocks


class Measurements(NamedTuple):
    """Landmarks observed from poses, and the sensor's variances of each measurement.

    landmark: index of its landmark.
    variances: (σ_range² [m²], σ_range_per_m², σ_bearing² [rad²]), as `models.variances`.
    own: the covariances that measurements bring themselves (`team.estimation.scans`); the residuals
        of these are whitened by them, and their variances are 1.
    """

    pose: Indices
    landmark: Indices
    ranges: Values
    bearings: Values
    variances: Float[np.ndarray, "n 3"]
    own: Float[np.ndarray, "_ 4"] = np.empty((0, 4))


class Linear(NamedTuple):
    """A factor kind at an estimate: residuals r, and ∂r/∂ of its first and second variable."""

    residual: Float[np.ndarray, "n k"]
    first: Float[np.ndarray, "n k 3"]
    second: Float[np.ndarray, "n k j"]


@compiled
def composed(a_from_b: Rows, b_from_c: Rows) -> Rows:
    """a_from_c of each row."""
    found = np.empty_like(a_from_b)
    for k in range(len(found)):
        found[k] = compose(a_from_b[k], b_from_c[k])
    return found


@compiled
def relative_poses(a_from_b: Rows, a_from_c: Rows) -> Rows:
    """b_from_c of each row."""
    found = np.empty_like(a_from_b)
    for k in range(len(found)):
        found[k] = between(a_from_b[k], a_from_c[k])
    return found


@compiled
def exponentials(xi: Rows) -> Rows:
    """Exp of each row."""
    found = np.empty_like(xi)
    for k in range(len(found)):
        found[k] = exponential(xi[k])
    return found


@compiled
def logarithms(poses: Rows) -> Rows:
    """Log of each row, |θ| < π."""
    found = np.empty_like(poses)
    for k in range(len(found)):
        found[k] = logarithm(poses[k])
    return found


def _half_turn(turn: Values) -> tuple[Values, Values]:
    """(θ/2)/tan(θ/2) and θ/2."""
    half = 0.5 * turn
    small = np.abs(turn) < SMALL_TURN
    safe = np.where(small, 1.0, half)
    return np.where(small, 1.0 - elementary.squared(half) / 3.0, safe / np.tan(safe)), half


def inverse_right_jacobians(xi: Rows) -> Blocks:
    """Jr⁻¹ of each row: Log(Exp(ξ) ∘ Exp(δ)) = ξ + Jr⁻¹(ξ) δ to first order.

    Jr = [[R, t], [0, 1]] with R = [[sin θ/θ, (1 − cos θ)/θ], [−(1 − cos θ)/θ, sin θ/θ]] and
    t = p (ξ₀, ξ₁) + q (−ξ₁, ξ₀), p = (θ − sin θ)/θ², q = (1 − cos θ)/θ²; so
    Jr⁻¹ = [[R⁻¹, −R⁻¹t], [0, 1]].
    """
    forward, left, turn = xi.T
    small = np.abs(turn) < SMALL_TURN
    safe = np.where(small, 1.0, turn)
    p = np.where(small, turn / 6.0, (safe - elementwise.sin(safe)) / elementary.squared(safe))
    q = np.where(
        small,
        0.5 - elementary.squared(turn) / 24.0,
        (1.0 - elementwise.cos(safe)) / elementary.squared(safe),
    )
    t = np.stack([p * forward - q * left, p * left + q * forward], axis=1)
    a, half = _half_turn(turn)
    J = np.zeros((len(xi), 3, 3))
    J[:, 0, 0] = J[:, 1, 1] = a
    J[:, 0, 1], J[:, 1, 0] = -half, half
    J[:, 0, 2] = -a * t[:, 0] + half * t[:, 1]
    J[:, 1, 2] = -half * t[:, 0] - a * t[:, 1]
    J[:, 2, 2] = 1.0
    return J


@compiled
def _adjoints_of_inverse(poses: Rows) -> Blocks:
    """Ad(T⁻¹) of each row."""
    found = np.empty((len(poses), 3, 3))
    for k in range(len(found)):
        found[k] = adjoint(inverse(poses[k]))
    return found


def start_residuals(starts: Starts, poses: Poses) -> tuple[Rows, Blocks]:
    """The residuals r and ∂r/∂ξ of the initial poses."""
    residual = logarithms(relative_poses(starts.mean, poses[starts.pose]))
    return residual, inverse_right_jacobians(residual)


def motion_residuals(motions: Motions, poses: Poses) -> Linear:
    """r, ∂r/∂ξ of the pose before and of the pose after."""
    moved = relative_poses(poses[motions.before], poses[motions.after])
    residual = logarithms(relative_poses(motions.mean, moved))
    after = inverse_right_jacobians(residual)
    return Linear(residual, dense.product(-after, _adjoints_of_inverse(moved)), after)


def measurement_residuals(measurements: Measurements, poses: Poses, landmarks: Points) -> Linear:
    """The residuals r of (range, bearing), ∂r/∂ξ of the pose and ∂r/∂ of the landmark, as in
    `models`.
    """
    z = np.column_stack([measurements.ranges, measurements.bearings])
    found = _linearised(poses[measurements.pose], landmarks[measurements.landmark], z)
    if measurements.own.size:
        _whiten(*found, z, measurements.own)
    return Linear(*found)


@compiled
def _whiten(
    residual: Float[np.ndarray, "n 2"],
    of_pose: Float[np.ndarray, "n 2 3"],
    of_landmark: Float[np.ndarray, "n 2 2"],
    z: Float[np.ndarray, "n 2"],
    own: Float[np.ndarray, "n 4"],
) -> None:
    """Rows times L⁻¹, R = L Lᵀ, of the measurements that claim their covariance R, in place.

    The residual of a point is the point's own in the plane (`landmark_kernel.innovation_of`).
    """
    for k in range(len(residual)):
        if own[k, 3] < 0.0:
            continue
        distance = residual[k, 0] + z[k, 0]
        of_range, of_bearing, rr, rb, bb = innovation_of(
            z[k], own[k], (0.0, 0.0, 0.0), distance, -residual[k, 1]
        )
        residual[k, 0], residual[k, 1] = -of_range, -of_bearing
        slope, first = rb / rr, math.sqrt(rr)
        second = math.sqrt(bb - slope * rb)
        residual[k, 1] = (residual[k, 1] - slope * residual[k, 0]) / second
        residual[k, 0] /= first
        for i in range(3):
            of_pose[k, 1, i] = (of_pose[k, 1, i] - slope * of_pose[k, 0, i]) / second
            of_pose[k, 0, i] /= first
        for i in range(2):
            of_landmark[k, 1, i] = (of_landmark[k, 1, i] - slope * of_landmark[k, 0, i]) / second
            of_landmark[k, 0, i] /= first


@compiled
def _linearised(
    poses: Rows, landmarks: Float[np.ndarray, "n 2"], measurements: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 2"]]:
    count = len(measurements)
    residual = np.empty((count, 2))
    of_pose, of_landmark = np.empty((count, 2, 3)), np.empty((count, 2, 2))
    for k in range(count):
        distance, bearing = predicted(poses[k], landmarks[k])
        residual[k, 0] = distance - measurements[k, 0]
        residual[k, 1] = wrapped(bearing - measurements[k, 1])
        of_pose[k] = pose_jacobian(distance, bearing)
        of_landmark[k] = landmark_jacobian(distance, poses[k, 2] + bearing)
    return residual, of_pose, of_landmark


@dataclass(frozen=True, eq=False)
class Factors:
    """The factors over K poses and L landmarks; node k is pose k, node K + l is landmark l."""

    poses: int
    landmarks: int
    starts: Starts
    motions: Motions
    measurements: Measurements

    @cached_property
    def _pattern_and_entries(self) -> tuple[Pattern, tuple[Indices, ...]]:
        """The pattern, and the entry of each factor's blocks in the order of `places`."""
        starts, motions, measurements = self.starts, self.motions, self.measurements
        pairs = np.concatenate(
            [
                np.column_stack([motions.before, motions.after]),
                np.column_stack([measurements.pose, self.poses + measurements.landmark]),
            ]
        )
        fixed: Bool[np.ndarray, " n"] = np.zeros(self.poses + self.landmarks, dtype=np.bool_)
        lengths = np.repeat([1, 2], [len(starts.pose), len(pairs)])
        begins = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
        column_start, rows, entry = block_pattern(
            fixed, np.concatenate([starts.pose, pairs.ravel()]), begins
        )
        sizes = np.repeat(np.array([3, 2]), [self.poses, self.landmarks])
        table = entry[len(starts.pose) :].reshape(-1, 4)
        of_motions, of_measurements = table[: len(motions.before)], table[len(motions.before) :]
        entries = (
            entry[: len(starts.pose)],
            *(of_motions[:, k] for k in (0, 2, 3)),
            *(of_measurements[:, k] for k in (0, 2, 3)),
        )
        return Pattern(sizes, column_start, rows), entries

    @property
    def pattern(self) -> Pattern:
        """Blocks of the normal equations."""
        return self._pattern_and_entries[0]

    @cached_property
    def analysis(self) -> Analysis:
        """Order of elimination and places in the Cholesky factor."""
        return analysed(self.pattern)

    @cached_property
    def _places(self) -> Indices:
        """Where each number of the factors' blocks is added in the numbers of the pattern."""
        pattern, entries = self._pattern_and_entries
        areas = (9, 9, 9, 9, 9, 6, 4)
        begins = pattern.value_start
        places = [
            (begins[entry][:, None] + np.arange(area)).ravel()
            for entry, area in zip(entries, areas, strict=True)
        ]
        return np.concatenate(places)

    def assembled(self, blocks: tuple[Float[np.ndarray, "..."], ...]) -> Values:
        """The sum of blocks in the layout of the pattern.

        blocks: of the starts; of the motions (before, before), (after, before), (after, after); of
        the measurements (pose, pose), (landmark, pose), (landmark, landmark).
        """
        numbers = np.concatenate([block.ravel() for block in blocks])
        length = int(self.pattern.value_start[-1])
        total: Values = np.bincount(self._places, numbers, length)
        return total

    @cached_property
    def _gradient_places(self) -> Indices:
        of_pose, of_point = np.arange(3), np.arange(2)
        starts, motions, measurements = self.starts, self.motions, self.measurements
        poses = (starts.pose, motions.before, motions.after, measurements.pose)
        return np.concatenate(
            [
                *((3 * pose[:, None] + of_pose).ravel() for pose in poses),
                (3 * self.poses + 2 * measurements.landmark[:, None] + of_point).ravel(),
            ]
        )

    def gathered(self, slopes: tuple[Float[np.ndarray, "..."], ...]) -> Values:
        """The sum of slopes of the starts, motions (before, after), measurements (pose,
        landmark).
        """
        numbers = np.concatenate([slope.ravel() for slope in slopes])
        total: Values = np.bincount(
            self._gradient_places, numbers, 3 * self.poses + 2 * self.landmarks
        )
        return total
