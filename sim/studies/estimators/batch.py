"""The batch MAP over all raw measurements: every pose of every robot, and one map.

Minimises Σ rᵀP⁻¹r of the start poses and of the odometry + Σ ρ(rᵀR⁻¹r) of the measurements (their
residuals: `batch_factors`) over one pose per robot and keyframe and all landmarks: full smoothing
(Dellaert & Kaess 2006, Square root SAM), with the information matrix instead of its root. ρ is the
identity, or Cauchy's c² log(1 + χ²/c²) by iterated re-weighting. A measurement's noise is the
sensor's at the range that the estimate predicts, and is not differentiated. Nothing is ever
linearised for good: the estimate grows with the measurements and every iteration is over all of
them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int64, UInt32

from sim.studies.estimators import batch_factors as factors_of
from sim.studies.estimators.batch_factors import Factors, Linear, Measurements, Motions, Starts
from sim.studies.estimators.robot_step import RobotStep
from team.estimation import dense, elementary
from team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian, information
from team.estimation.geometry import Pose, compose, tangent
from team.estimation.map_joining.least_squares import (
    STUCK,
    Iterate,
    Values,
    iterated,
    robust_scale,
)
from team.estimation.models import located, variances
from team.estimation.scans import of_each
from team.estimation.sparse_cholesky import sparse

FLOOR_SIGMAS = (1e-4, 2e-3, 1e-4)
"""Added to each keyframe's motion (forward [m], left [m], turn [rad]): the covariance of a robot
that can not slip is singular, and that of no motion at all is zero."""
EXACT_SIGMA = 1e-5
"""Of a start pose that is exactly known [m, rad]."""
ROBUST_START, ROBUST_DECAY = 8.0, 0.7
"""A measurement's robust scale begins at 8 c and narrows with each iteration that it lives through,
until it is c: what is far off since a pose was dead-reckoned is not taken for an outlier."""


@dataclass(frozen=True, eq=False)
class Batch(Iterate):
    """An estimate of everything, in the map frame.

    poses:     (x [m], y [m], θ [rad]), in the order in which they came.
    pose_robot: place in `robots` of each pose's robot.
    landmarks: [m], in the order in which they were first seen; ids are theirs.
    age:       iterations that each measurement has lived through; its robust scale follows from it.
    robust_c:  Cauchy's scale on √χ² of a measurement (2 numbers); None for least squares.
    """

    robots: tuple[str, ...]
    factors: Factors
    poses: Float[np.ndarray, "K 3"]
    pose_robot: Int64[np.ndarray, " K"]
    landmarks: Float[np.ndarray, "L 2"]
    ids: UInt32[np.ndarray, " L"]
    age: Int64[np.ndarray, " n"]
    robust_c: float | None

    @cached_property
    def seen(self) -> Linear:
        """The residuals of the measurements and their Jacobians."""
        return factors_of.measurement_residuals(
            self.factors.measurements, self.poses, self.landmarks
        )

    @cached_property
    def _precision(self) -> Float[np.ndarray, "n 2"]:
        """1/σ² of (range, bearing) of each measurement at the range that the estimate predicts."""
        measurements = self.factors.measurements
        distance = self.seen.residual[:, 0] + measurements.ranges
        at_zero, per_m, bearing = measurements.variances.T
        return 1.0 / np.column_stack([at_zero + per_m * elementary.squared(distance), bearing])

    @property
    def narrow(self) -> bool:
        """Whether every measurement's robust scale has come to its end."""
        return self.robust_c is None or bool((self._scale == self.robust_c).all())

    @property
    def _scale(self) -> Values:
        return robust_scale(self.age, self.robust_c, ROBUST_START, ROBUST_DECAY)

    @cached_property
    def _weight(self) -> Values:
        """Robust weight of each measurement, 1/(1 + χ²/c²); 1 without a robust loss."""
        if self.robust_c is None:
            return np.ones(len(self.age))
        chi2 = np.sum(elementary.squared(self.seen.residual) * self._precision, axis=1)
        weight: Values = 1.0 / (1.0 + chi2 / elementary.squared(self._scale))
        return weight

    def cost_of(self, other: "Batch") -> float:
        """Σ w χ² of another estimate with this one's noise and weights: what a step lowers."""
        start_residual, _ = factors_of.start_residuals(self.factors.starts, other.poses)
        moved = factors_of.motion_residuals(self.factors.motions, other.poses).residual
        chi2 = np.sum(elementary.squared(other.seen.residual) * self._precision, axis=1)
        return (
            float(
                np.einsum(
                    "ni,nij,nj->", start_residual, self.factors.starts.information, start_residual
                )
            )
            + float(np.einsum("ni,nij,nj->", moved, self.factors.motions.information, moved))
            + float(dense.product(self._weight, chi2))
        )

    @property
    def cost(self) -> float:
        """Σ w χ² of all factors; about `dof` where the models are right."""
        return self.cost_of(self)

    @property
    def dof(self) -> int:
        """Numbers in all factors less the number of unknowns: 2 n − 2 L, since there are as many
        starts and motions as poses.
        """
        return 2 * len(self.age) - 2 * len(self.ids)

    @cached_property
    def normal_equations(self) -> tuple[Values, Values]:
        """A = Σ w JᵀP⁻¹J in the layout of the factors' pattern, and the gradient Σ w JᵀP⁻¹r.

        Unknowns: ξ of each pose, then the landmarks.
        """
        starts, motions = self.factors.starts, self.factors.motions
        start_residual, of_start = factors_of.start_residuals(starts, self.poses)
        moved, before, after = factors_of.motion_residuals(motions, self.poses)
        seen, of_pose, of_landmark = self.seen
        start = dense.product(of_start.transpose(0, 2, 1), starts.information)
        before_, after_ = (
            dense.product(J.transpose(0, 2, 1), motions.information) for J in (before, after)
        )
        precision = self._weight[:, None, None] * self._precision[:, None, :]
        pose_ = of_pose.transpose(0, 2, 1) * precision
        landmark_ = of_landmark.transpose(0, 2, 1) * precision
        values = self.factors.assembled(
            (
                dense.product(start, of_start),
                dense.product(before_, before),
                dense.product(after_, before),
                dense.product(after_, after),
                dense.product(pose_, of_pose),
                dense.product(landmark_, of_pose),
                dense.product(landmark_, of_landmark),
            )
        )
        gradient = self.factors.gathered(
            (
                dense.product(start, start_residual[:, :, None]),
                dense.product(before_, moved[:, :, None]),
                dense.product(after_, moved[:, :, None]),
                dense.product(pose_, seen[:, :, None]),
                dense.product(landmark_, seen[:, :, None]),
            )
        )
        return values, gradient

    @property
    def diagonal(self) -> Int64[np.ndarray, " n"]:
        """The places of the information matrix' diagonal among its values."""
        return self.factors.pattern.diagonal

    @cached_property
    def posterior(self) -> sparse.Cholesky:
        """Cholesky factor of the information matrix at this estimate."""
        return self.factorised(self.normal_equations[0])

    def factorised(self, values: Values) -> sparse.Cholesky:
        """Cholesky factor of a matrix in the layout of the factors' pattern."""
        return sparse.factorised(self.factors.analysis, values)

    def moved(self, step: Values) -> "Batch":
        """Pose ∘ Exp(ξ), landmark + δ: one iteration later."""
        split = 3 * len(self.poses)
        motions = factors_of.exponentials(step[:split].reshape(-1, 3))
        return replace(
            self,
            poses=factors_of.composed(self.poses, motions),
            landmarks=self.landmarks + step[split:].reshape(-1, 2),
            age=self.age + 1,
        )

    @cached_property
    def newton_step(self) -> Values:
        """−A⁻¹g: ξ of each pose, then the landmarks' δ."""
        step: Values = -sparse.solved(self.posterior, self.normal_equations[1][:, None])[:, 0]
        return step

    @property
    def newton_decrement(self) -> float:
        """√(gᵀA⁻¹g): how far the next Newton step goes, in standard deviations."""
        return math.sqrt(
            max(-float(dense.product(self.normal_equations[1], self.newton_step)), 0.0)
        )

    def converged(self, least_decrement: float) -> bool:
        """Whether every robust scale is at its end and the next step goes no farther than that."""
        return self.narrow and self.newton_decrement <= least_decrement

    @cached_property
    def selected_covariance(self) -> Values:
        """Entries of the covariance in the layout of the factors' pattern."""
        return sparse.selected_inverse(self.posterior)

    @property
    def renewed(self) -> "Batch":
        """Every measurement's robust scale begins anew."""
        return replace(self, age=np.zeros_like(self.age))


def initial_state(
    starts: Mapping[str, tuple[Pose, Matrix | None]], robust_c: float | None
) -> Batch:
    """The robots' start poses with their covariances in (x, y, θ); None: exactly known."""
    mean = np.array([pose for pose, _ in starts.values()]).reshape(-1, 3)
    order = np.arange(len(starts))
    information = np.array([_start_information(*start) for start in starts.values()]).reshape(
        -1, 3, 3
    )
    none, nothing = np.empty(0, np.int64), np.empty(0)
    factors = Factors(
        len(starts),
        0,
        Starts(order, mean, information),
        Motions(none, none, np.empty((0, 3)), np.empty((0, 3, 3))),
        Measurements(none, none, nothing, nothing, np.empty((0, 3))),
    )
    ids = np.empty(0, np.uint32)
    return Batch(
        robots=tuple(starts),
        factors=factors,
        poses=mean,
        pose_robot=order,
        landmarks=np.empty((0, 2)),
        ids=ids,
        age=none,
        robust_c=robust_c,
    )


def _start_information(pose: Pose, covariance: Matrix | None) -> Matrix:
    if covariance is None:
        return np.eye(3) / elementary.squared(EXACT_SIGMA)
    G = tangent(pose[2])
    own = dense.product(dense.product(G.T, covariance), G)
    return information(0.5 * (own + own.T), "a start pose")


def extended(batch: Batch, turns: Sequence[RobotStep]) -> Batch:
    """The batch with more turns, in the given order.

    A new pose is dead-reckoned from the robot's newest one, a new landmark is where its first
    measurement puts it. Raises ValueError for a robot that has no start.
    """
    newest = {
        robot: int(np.flatnonzero(batch.pose_robot == k)[-1])
        for k, robot in enumerate(batch.robots)
    }
    poses = list(batch.poses)
    place = {id_: k for k, id_ in enumerate(batch.ids.tolist())}
    landmarks = list(batch.landmarks)
    before, seen = [], []
    for turn in turns:
        if turn.robot not in newest:
            raise ValueError(f"{turn.robot} has no start")
        before.append(newest[turn.robot])
        pose = compose(poses[newest[turn.robot]], turn.increment.mean)
        newest[turn.robot] = len(poses)
        poses.append(pose)
        for id_, r, b in zip(turn.ids.tolist(), turn.ranges, turn.bearings, strict=True):
            if id_ not in place:
                place[id_] = len(landmarks)
                landmarks.append(located(pose, float(r), float(b)))
            seen.append(place[id_])
    factors = batch.factors
    after = np.arange(len(batch.poses), len(poses))
    motions, measurements = factors.motions, factors.measurements
    counts = [len(turn.ids) for turn in turns]
    floor = elementary.squared(np.diag(FLOOR_SIGMAS))
    added = Motions(
        np.array(before, np.int64),
        after,
        np.array([turn.increment.mean for turn in turns]).reshape(-1, 3),
        np.array(
            [information(turn.increment.covariance + floor, "a motion") for turn in turns]
        ).reshape(-1, 3, 3),
    )
    looks = Measurements(
        np.repeat(after, counts),
        np.array(seen, np.int64),
        np.concatenate([np.empty(0), *(turn.ranges for turn in turns)]),
        np.concatenate([np.empty(0), *(turn.bearings for turn in turns)]),
        _variances(turns, counts),
        of_each([(count, turn.own) for count, turn in zip(counts, turns, strict=True)]),
    )
    return replace(
        batch,
        factors=Factors(
            len(poses),
            len(landmarks),
            factors.starts,
            Motions(*(np.concatenate(each) for each in zip(motions, added, strict=True))),
            Measurements(*(np.concatenate(each) for each in zip(measurements, looks, strict=True))),
        ),
        poses=np.array(poses),
        pose_robot=np.concatenate(
            [
                batch.pose_robot,
                np.array([batch.robots.index(turn.robot) for turn in turns], np.int64),
            ]
        ),
        landmarks=np.array(landmarks).reshape(-1, 2),
        ids=np.array(list(place), np.uint32),
        age=np.concatenate([batch.age, np.zeros(len(seen), np.int64)]),
    )


def _variances(turns: Sequence[RobotStep], counts: Sequence[int]) -> Float[np.ndarray, "n 3"]:
    """Of each measurement; ones of those that claim their own, whose residuals are whitened."""
    found = np.array([variances(turn.sensor) for turn in turns]).reshape(-1, 3)
    found = np.repeat(found, counts, axis=0)
    claims = np.repeat(np.array([turn.own.shape[1] > 0 for turn in turns], np.bool_), counts)
    found[claims] = 1.0, 0.0, 1.0
    return found


def solved(batch: Batch, iterations: int, least_decrement: float) -> Batch:
    """The estimate after at most so many iterations of Gauss-Newton, ended where it has converged.

    A step that does not lower the cost is shortened, then damped. Where no damping helps it ends,
    too: `converged` tells.
    """
    damping = 0.0
    for _ in range(iterations):
        if batch.converged(least_decrement) or damping == STUCK:
            break
        batch, (damping, _) = iterated(batch, damping)
    return batch


def landmark_gaussian(batch: Batch) -> LandmarkGaussian:
    """Mean and joint marginal covariance of all landmarks."""
    order = np.argsort(batch.ids)
    unknowns = 3 * len(batch.poses) + (2 * order[:, None] + np.arange(2)).ravel()
    covariance = sparse.inverse_columns(batch.posterior, unknowns)[unknowns]
    return LandmarkGaussian(
        batch.ids[order], batch.landmarks[order], 0.5 * (covariance + covariance.T)
    )


def pose_gaussian(batch: Batch, robot: str) -> PoseGaussian:
    """Mean and marginal covariance of the robot's newest pose, in (x, y, θ).

    Raises ValueError for a robot that is not in the batch.
    """
    newest = np.flatnonzero(batch.pose_robot == batch.robots.index(robot))[-1:]
    unknowns = 3 * int(newest[0]) + np.arange(3)
    own = sparse.inverse_columns(batch.posterior, unknowns)[unknowns]
    G = tangent(batch.poses[newest[0], 2])
    covariance = dense.product(dense.product(G, own), G.T)
    return PoseGaussian(batch.poses[newest[0]], 0.5 * (covariance + covariance.T))


def trajectory(
    batch: Batch, robot: str
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 3 3"]]:
    """The robot's poses from its start on, each with its marginal covariance in (x, y, θ)."""
    own = np.flatnonzero(batch.pose_robot == batch.robots.index(robot))
    pattern, entries = batch.factors.pattern, batch.selected_covariance
    blocks = np.array([pattern.diagonal_block(entries, int(k)) for k in own])
    G = np.array([tangent(heading) for heading in batch.poses[own, 2]])
    return batch.poses[own], dense.product(dense.product(G, blocks), G.transpose(0, 2, 1))
