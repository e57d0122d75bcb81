"""Worlds with each form of measurement, and the NEES of their submaps.

A mutant makes the stated covariances wrong.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.sim.calibration.data import messages_of
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.simulator import simulate
from teamslam.sim.world.streams import RobotStream, WorldStreams
from teamslam.team import translate
from teamslam.team.config import FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.hybrid_slam.pipeline import HybridSlam
from teamslam.team.estimation.hybrid_slam.window import ClosedWindow
from teamslam.team.estimation.se2 import between, inverse, transformed
from teamslam.team.wire import messages as m
from tests.support import state_error

PROBABILITY = 0.999
WINDOW_S = 8.0
MOTION = MotionModel(
    forward=MotionNoise(0.02, 0.04), turn=MotionNoise(0.01, 0.02), lateral=MotionNoise(0.01, 0.03)
)
CAR = MotionModel(
    "ackermann", turn=MotionNoise(0.002), lateral=MotionNoise(0.01), forward=MotionNoise(0.01),
    wheel_base=2.83, wheel_offset=0.76, shares=(0.08, 0.06, 0.01), shares_interval_s=1.0,
)  # fmt: skip
MOUNT = (3.78, 0.5, -0.4)
SENSOR = Sensor(range_sigma=0.1, bearing_sigma=0.02, max_range=25.0)
FRONT = FrontEnd(particles=400, window_s=WINDOW_S)


class Case(NamedTuple):
    world: SimulatedWorld
    robot: RobotConfig
    mutants: Mapping[str, Callable[[RobotConfig, WorldStreams], tuple[RobotConfig, RobotStream]]]


def _world(**fields: object) -> SimulatedWorld:
    plain = SimulatedWorld(
        steps=16, size_m=30.0, landmark_count=12, speed_m_s=1.0, turn_rate_rad_s=0.4,
        visible_from_m=1.0, visible_to_m=12.0,
    )  # fmt: skip
    return msgspec.structs.replace(plain, **fields)


def _robot(motion: MotionModel = MOTION, **sensor: object) -> RobotConfig:
    of_robot = msgspec.structs.replace(SENSOR, **sensor)
    return RobotConfig("r1", motion=motion, sensor=of_robot, front_end=FRONT)


def _other_mount(robot: RobotConfig, world: WorldStreams) -> tuple[RobotConfig, RobotStream]:
    x, y, heading = robot.sensor.mount
    sensor = msgspec.structs.replace(robot.sensor, mount=(x, y + 0.4, heading + 0.05))
    return msgspec.structs.replace(robot, sensor=sensor), world.streams[0]


def _turned(robot: RobotConfig, world: WorldStreams) -> tuple[RobotConfig, RobotStream]:
    seen = world.streams[0].landmark_detections
    turned = seen.covariances[:, ::-1] * np.array([1.0, -1.0, 1.0])
    return robot, replace(world.streams[0], landmark_detections=replace(seen, covariances=turned))


def _less_lateral(robot: RobotConfig, world: WorldStreams) -> tuple[RobotConfig, RobotStream]:
    told = world.streams[0].intervals
    less = told.covariances.copy()
    less[:, 1, :] *= 0.1
    less[:, :, 1] *= 0.1
    return robot, replace(world.streams[0], intervals=replace(told, covariances=less))


def _no_shares(robot: RobotConfig, world: WorldStreams) -> tuple[RobotConfig, RobotStream]:
    motion = msgspec.structs.replace(robot.motion, shares=None)
    return msgspec.structs.replace(robot, motion=motion), world.streams[0]


CASES: Mapping[str, Case] = {
    "speeds": Case(_world(), _robot(), {}),
    "increments": Case(
        _world(odometry="increments", odometry_claims=True, odometry_correlation=0.6),
        _robot(),
        {"less lateral": _less_lateral},
    ),
    "increments without covariance": Case(
        _world(odometry="increments"),
        _robot(),
        {},
    ),
    "points": Case(
        _world(landmark_form="points", landmark_claims=(0.4, 3.0)),
        _robot(),
        {"turned by a right angle": _turned},
    ),
    "ranges with own covariances": Case(
        _world(landmark_claims=(0.4, 3.0)),
        _robot(),
        {},
    ),
    "mount": Case(_world(), _robot(mount=MOUNT), {"another mount": _other_mount}),
    "car": Case(
        _world(odometry="steering", speed_m_s=2.0),
        _robot(CAR, mount=MOUNT),
        {"no shares": _no_shares},
    ),
}  # fmt: skip


def closed_windows(robot: RobotConfig, stream: RobotStream) -> Iterator[ClosedWindow]:
    slam = HybridSlam(robot, 1)
    for message in messages_of(stream):
        if isinstance(message, m.AnyScan | m.Detections):
            slam.observe(message.stamp_ns, translate.scan_of(message))
        elif isinstance(message, m.AnyOdometry):
            closed = slam.drive(translate.interval_of(message, robot))
            if closed is not None:
                yield closed


def window_nees(closed: ClosedWindow, world: WorldStreams) -> tuple[float, int]:
    stream = world.streams[0]
    start, end = (
        stream.truth[int(np.searchsorted(stream.truth_ns, at))]
        for at in (closed.start_ns, closed.end_ns)
    )
    away = inverse(start)
    places = [transformed(away, world.landmarks[i - 1]) for i in closed.local.ids.tolist()]
    truth = np.concatenate((between(start, end), *places))
    return nees(state_error(closed.local.mean, truth), closed.local.covariance), len(truth)


def mean_nees(case: Case, seeds: int, mutant: str | None = None) -> tuple[float, float, float]:
    total, dof = 0.0, 0
    for seed in range(seeds):
        world = simulate(case.world, [case.robot], seed)
        told = case.mutants[mutant](case.robot, world) if mutant else (case.robot, world.streams[0])
        for closed in closed_windows(*told):
            squared, numbers = window_nees(closed, world)
            total, dof = total + squared, dof + numbers
    low, high = chi2_interval(dof, PROBABILITY, 1)
    return total / dof, low, high
