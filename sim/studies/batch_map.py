"""Batch MAP of `team.batch_map`."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest

from teamslam.sim.studies.batch_reference import growing as batch
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.config import Sensor
from teamslam.team.library import BatchMap, InitialPose, Keyframe, LandmarkMap, Trajectory

_BATCH_ITERATIONS, _BATCH_DECREMENT = 200, 1e-5


def solved_map(
    keyframes: Mapping[str, Sequence[Keyframe]],
    sensors: Mapping[str, Sensor],
    initial_poses: Mapping[str, InitialPose],
    robust_c: float | None,
) -> BatchMap:
    """Solve for all poses and landmarks, as `teamslam.team.library.batch_map`."""
    starts = {robot: (each.pose, each.covariance) for robot, each in initial_poses.items()}
    robots = sorted(keyframes)
    steps = [
        RobotStep(robot, at.increment, sensors[robot], at.ids, at.ranges, at.bearings)
        for row in zip_longest(*(keyframes[robot] for robot in robots))
        for robot, keyframe in zip(robots, row, strict=True)
        if keyframe is not None
        for at in (keyframe.calibrated(sensors[robot]),)
    ]
    grown = batch.add_steps(batch.initial_state(starts, robust_c), steps)
    solution = batch.solve(grown, _BATCH_ITERATIONS, _BATCH_DECREMENT)
    landmarks = batch.landmark_gaussian(solution)
    return BatchMap(
        landmarks=LandmarkMap(landmarks.ids, landmarks.means, landmarks.covariance),
        trajectories={
            robot: Trajectory(*batch.trajectory(solution, robot)) for robot in sorted(starts)
        },
        chi2=solution.cost,
        dof=solution.dof,
        converged=solution.converged(_BATCH_DECREMENT),
    )
