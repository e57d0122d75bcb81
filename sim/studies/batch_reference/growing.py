"""Incremental batch MAP over a team's raw measurements (Dellaert & Kaess 2006).

Minimises Σ rᵀP⁻¹r of initial poses and odometry + Σ ρ(rᵀR⁻¹r) of measurements. ρ: identity, or
Cauchy's c² log(1 + χ²/c²). R: at the predicted range, not differentiated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from typing import Any

import numpy as np

from teamslam.sim.recorded.chains import Scan
from teamslam.sim.studies.batch_reference.graph import (
    add_motion,
    add_scan,
    joint_covariance,
    load_gtsam,
    newton_step,
    optimizer_of,
    start_factor,
)
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.config import Sensor
from teamslam.team.core import located
from teamslam.team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from teamslam.team.estimation.se2 import Pose, compose, tangent
from teamslam.team.library import BatchMap, InitialPose, Keyframe, LandmarkMap, Trajectory
from teamslam.team.shapes import Float, UInt32

ROBUST_START, ROBUST_DECAY = 8.0, 0.7
"""A robust solution begins with Cauchy's scale 8 c, which narrows to c."""
_POSES = 2**32  # first key of a pose; a landmark's is its id < 2³²


class UnsolvableError(ValueError):
    """Undetermined unknown, or overflow."""


@dataclass(frozen=True, eq=False)
class GrowingBatch:
    """Estimate of all poses and landmarks.

    starts: initial poses with covariance in (x, y, θ); None: exact. poses: (x [m], y [m], θ [rad]),
    initial poses first, then one per step. robust_c: Cauchy's scale on √χ².
    """

    starts: Mapping[str, tuple[Pose, Matrix | None]]
    robust_c: float | None
    steps: tuple[RobotStep, ...]
    poses: Float[np.ndarray, "K 3"]
    landmarks: Mapping[int, Float[np.ndarray, "2"]]

    @property
    def ids(self) -> UInt32[np.ndarray, " L"]:
        """Ids of the landmarks, ascending."""
        return np.array(sorted(self.landmarks), np.uint32)

    def places(self, robot: str) -> list[int]:
        """Rows of a robot's poses, initial pose first."""
        robots = list(self.starts)
        if robot not in self.starts:
            raise ValueError(f"{robot} has no start")
        own = (len(robots) + k for k, step in enumerate(self.steps) if step.robot == robot)
        return [robots.index(robot), *own]

    @property
    def cost(self) -> float:
        """Σ of χ² of all factors, under the loss."""
        return 2.0 * float(self._graph.error(self.values))

    @property
    def dof(self) -> int:
        """2 n − 2 L for n measurements and L landmarks."""
        return 2 * sum(len(step.ids) for step in self.steps) - 2 * len(self.landmarks)

    @cached_property
    def newton_decrement(self) -> float:
        """√(gᵀH⁻¹g): length of the next Newton step."""
        try:
            return newton_step(load_gtsam(), self._graph.linearize(self.values))[1]
        except RuntimeError as error:
            raise UnsolvableError(str(error).strip()) from error

    def converged(self, least_decrement: float) -> bool:
        """Whether the next step is short enough."""
        return self.newton_decrement <= least_decrement

    @cached_property
    def values(self) -> Any:
        """The estimate as GTSAM's values."""
        gtsam = load_gtsam()
        values = gtsam.Values()
        for k, pose in enumerate(self.poses):
            values.insert(_POSES + k, gtsam.Pose2(*pose))
        for landmark, position in self.landmarks.items():
            values.insert(landmark, np.asarray(position))
        return values

    @cached_property
    def _graph(self) -> Any:
        return self.graph(self.robust_c)

    def graph(self, robust_c: float | None) -> Any:
        """Make the factors at the present estimate."""
        gtsam = load_gtsam()
        graph = gtsam.NonlinearFactorGraph()
        for k, (start, covariance) in enumerate(self.starts.values()):
            graph.push_back(start_factor(gtsam, _POSES + k, start, covariance))
        newest = {robot: k for k, robot in enumerate(self.starts)}
        for place, step in enumerate(self.steps, len(self.starts)):
            before, newest[step.robot] = newest[step.robot], place
            key = _POSES + place
            add_motion(gtsam, graph, _POSES + before, key, step.increment)
            scan = Scan(step.ids, step.ranges, step.bearings, step.own)
            seen = scan, step.sensor, self.poses[place]
            add_scan(gtsam, graph, key, *seen, self.landmarks, robust_c)
        return graph

    @cached_property
    def marginals(self) -> Any:
        """GTSAM's marginals; raises `UnsolvableError`."""
        try:
            return load_gtsam().Marginals(self._graph, self.values)
        except RuntimeError as error:
            raise UnsolvableError(str(error).strip()) from error


def initial_state(
    starts: Mapping[str, tuple[Pose, Matrix | None]], robust_c: float | None
) -> GrowingBatch:
    """Make a batch of initial poses; raises NotInstalledError."""
    load_gtsam()
    mean = np.array([pose for pose, _ in starts.values()]).reshape(-1, 3)
    return GrowingBatch(dict(starts), robust_c, (), mean, {})


def add_steps(batch: GrowingBatch, steps: Sequence[RobotStep]) -> GrowingBatch:
    """Append steps: dead-reckon poses, place landmarks by their first measurement."""
    newest = {robot: batch.poses[batch.places(robot)[-1]] for robot in batch.starts}
    poses, landmarks = [*batch.poses], dict(batch.landmarks)
    for step in steps:
        if step.robot not in newest:
            raise ValueError(f"{step.robot} has no start")
        pose = newest[step.robot] = compose(newest[step.robot], step.increment.mean)
        poses.append(pose)
        for id_, r, b in zip(step.ids.tolist(), step.ranges, step.bearings, strict=True):
            if id_ not in landmarks:
                landmarks[id_] = located(pose, float(r), float(b))
    return replace(
        batch,
        steps=(*batch.steps, *steps),
        poses=np.array(poses).reshape(-1, 3),
        landmarks=landmarks,
    )


def solve(batch: GrowingBatch, iterations: int, least_decrement: float) -> GrowingBatch:
    """Iterate Levenberg-Marquardt; raises `UnsolvableError`."""
    for scale in _scales(batch.robust_c):
        left = iterations
        while left > 0 and not (scale == batch.robust_c and batch.converged(least_decrement)):
            found, used = _descend(batch, scale, left)
            left -= max(used, 1)
            if used == 0:
                break
            batch = found
            if scale != batch.robust_c:
                break
    if not np.isfinite(batch.poses).all():
        raise UnsolvableError("a pose is not finite")
    return batch


def _scales(robust_c: float | None) -> list[float | None]:
    if robust_c is None:
        return [None]
    scales = [ROBUST_START * robust_c]
    while scales[-1] * ROBUST_DECAY > robust_c:
        scales.append(scales[-1] * ROBUST_DECAY)
    return [*scales, robust_c]


def _descend(batch: GrowingBatch, scale: float | None, iterations: int) -> tuple[GrowingBatch, int]:
    gtsam = load_gtsam()
    optimizer = optimizer_of(gtsam, batch.graph(scale), batch.values, iterations)
    try:
        values = optimizer.optimize()
    except RuntimeError as error:
        raise UnsolvableError(str(error).strip()) from error
    poses = (values.atPose2(_POSES + k) for k in range(len(batch.poses)))
    found = replace(
        batch,
        poses=np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses]).reshape(-1, 3),
        landmarks={id_: np.asarray(values.atPoint2(id_)) for id_ in batch.landmarks},
    )
    return found, int(optimizer.iterations())


def landmark_gaussian(batch: GrowingBatch) -> LandmarkGaussian:
    """Mean and joint covariance of all landmarks."""
    ids = batch.ids
    means = np.array([batch.landmarks[id_] for id_ in ids.tolist()]).reshape(-1, 2)
    joint = joint_covariance(batch.marginals, ids.tolist()) if len(ids) else np.empty((0, 0))
    return LandmarkGaussian(ids, means, joint)


def pose_gaussian(batch: GrowingBatch, robot: str) -> PoseGaussian:
    """Mean and marginal covariance of the newest pose in (x, y, θ)."""
    place = batch.places(robot)[-1]
    return PoseGaussian(batch.poses[place], _covariance(batch, place))


def trajectory(
    batch: GrowingBatch, robot: str
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 3 3"]]:
    """Poses with marginal covariances in (x, y, θ)."""
    own = batch.places(robot)
    return batch.poses[own], np.array([_covariance(batch, place) for place in own])


def _covariance(batch: GrowingBatch, place: int) -> Matrix:
    G = tangent(batch.poses[place, 2])
    covariance = G @ np.asarray(batch.marginals.marginalCovariance(_POSES + place)) @ G.T
    symmetric: Matrix = 0.5 * (covariance + covariance.T)
    return symmetric


_BATCH_ITERATIONS, _BATCH_DECREMENT = 200, 1e-5


def solved_map(
    keyframes: Mapping[str, Sequence[Keyframe]],
    sensors: Mapping[str, Sensor],
    initial_poses: Mapping[str, InitialPose],
    robust_c: float | None,
) -> BatchMap:
    """Solve for all poses and landmarks."""
    starts = {robot: (each.pose, each.covariance) for robot, each in initial_poses.items()}
    robots = sorted(keyframes)
    steps = [
        RobotStep(robot, at.increment, sensors[robot], at.ids, at.ranges, at.bearings)
        for row in zip_longest(*(keyframes[robot] for robot in robots))
        for robot, keyframe in zip(robots, row, strict=True)
        if keyframe is not None
        for at in (keyframe.calibrated(sensors[robot]),)
    ]
    grown = add_steps(initial_state(starts, robust_c), steps)
    solution = solve(grown, _BATCH_ITERATIONS, _BATCH_DECREMENT)
    landmarks = landmark_gaussian(solution)
    return BatchMap(
        landmarks=LandmarkMap(landmarks.ids, landmarks.means, landmarks.covariance),
        trajectories={robot: Trajectory(*trajectory(solution, robot)) for robot in sorted(starts)},
        chi2=solution.cost,
        dof=solution.dof,
        converged=solution.converged(_BATCH_DECREMENT),
    )
