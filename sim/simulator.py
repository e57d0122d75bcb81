"""A simulated world: true paths, odometry with noise in it, readings of landmarks and teammates.

Nothing here comes from the estimator: the motion and the sensor are written again in `sim.paths`
and `sim.sensing`, so that an error in either half shows. Every stream of random numbers is named by
(seed, robot, purpose): a further robot changes nobody else's noise.
"""

import hashlib
from collections.abc import Iterator, Sequence
from itertools import chain
from math import atan2

import numpy as np
from jaxtyping import Float, Int64

from sim.paths import Drive, Limits, Pose, Step, driven, followed
from sim.sensing import Visible, readings, visible
from sim.streams import (
    Detections,
    Intervals,
    RobotStream,
    StartPose,
    WorldStreams,
    grouped,
    robot_stream,
)
from sim.worlds import SimulatedWorld
from team.config import MotionModel, MotionNoise, RobotConfig


def simulated(world: SimulatedWorld, robots: Sequence[RobotConfig], seed: int) -> WorldStreams:
    """The streams of a team in a simulated world, from stamp 0; landmarks are numbered from 1.

    Robot i follows path i; without one, or if its motion slips or goes in arcs, it steers: to its
    path's way-points or to random ones. Each step ends with one message of the landmarks seen,
    perhaps empty, and one of the teammates seen, if any.
    """
    landmarks = _landmarks(world, seed)
    ids = np.arange(1, len(landmarks) + 1, dtype=np.uint32)
    drives = [_drive(world, robot, i, seed) for i, robot in enumerate(robots)]
    stamps = np.rint(np.arange(world.steps + 1) * (world.step_s * 1e9)).astype(np.int64)
    streams = tuple(
        _stream(world, robots, drives, i, landmarks, stamps, seed) for i in range(len(robots))
    )
    return WorldStreams(streams, ids, landmarks, source=f"simulated world, seed {seed}")


def generator(seed: int, *names: str) -> np.random.Generator:
    """The stream of random numbers of one purpose, e.g. (seed, robot, "odometry")."""
    digest = hashlib.sha256("/".join(names).encode()).digest()
    words = np.random.SeedSequence([seed, int.from_bytes(digest[:16], "little")])
    return np.random.Generator(np.random.Philox(words))


def _landmarks(world: SimulatedWorld, seed: int) -> Float[np.ndarray, "L 2"]:
    if world.landmark_count:
        uniform = generator(seed, "world", "landmarks").random((world.landmark_count, 2))
        return uniform * world.size_m
    return np.array(world.landmarks, dtype=np.float64).reshape(-1, 2)


def _drive(world: SimulatedWorld, robot: RobotConfig, index: int, seed: int) -> Drive:
    """The true motion of one robot."""
    motion = robot.motion
    turn_rate = min(world.turn_rate_rad_s, motion.yaw_rate_limit or np.inf)
    path = np.array(world.paths[index]) if index < len(world.paths) else None
    slips = motion.final_turn != MotionNoise() or motion.lateral != MotionNoise()
    if path is not None and motion.kind == "turn-then-drive" and not slips:
        return followed(path, world.steps)
    way_points = _random_way_points(world, robot.id, seed) if path is None else _each(path)
    first, second = next(way_points), next(way_points)
    start: Pose = (*first, atan2(second[1] - first[1], second[0] - first[0]))
    limits = Limits(
        world.speed_m_s * world.step_s, turn_rate * world.step_s, world.way_point_tolerance_m
    )
    normals = generator(seed, robot.id, "slip").standard_normal((world.steps, 2))

    def slip(k: int, step: Step) -> tuple[float, float]:
        seconds, steps = np.array([world.step_s]), np.array([step])
        final_turn = deviation(motion.final_turn, seconds, steps) * normals[k, 0]
        lateral = deviation(motion.lateral, seconds, steps) * normals[k, 1]
        return final_turn.item(), lateral.item()

    return driven(start, chain([second], way_points), limits, motion.kind, world.steps, slip)


def _each(path: Float[np.ndarray, "W 2"]) -> Iterator[tuple[float, float]]:
    yield from map(tuple, path.tolist())


def _random_way_points(
    world: SimulatedWorld, robot: str, seed: int
) -> Iterator[tuple[float, float]]:
    uniform = generator(seed, robot, "way-points")
    while True:
        x, y = (uniform.random(2) * world.size_m).tolist()
        yield x, y


def deviation(
    noise: MotionNoise, seconds: Float[np.ndarray, " K"], steps: Float[np.ndarray, "K 2"]
) -> Float[np.ndarray, " K"]:
    """σ = √(per_s² t + per_m² |distance| + per_rad² |turn|) of one noise in each step."""
    distance, turn = np.abs(steps).T
    per_s, per_m, per_rad = noise.per_s, noise.per_m, noise.per_rad
    variance = per_s**2 * seconds + per_m**2 * distance + per_rad**2 * turn
    sigma: Float[np.ndarray, " K"] = np.sqrt(variance)
    return sigma


def _odometry(
    motion: MotionModel,
    steps: Float[np.ndarray, "K 2"],
    stamps_ns: Int64[np.ndarray, " K_plus_1"],
    normals: Float[np.ndarray, "K 2"],
) -> Intervals:
    """(distance + noise)/t/forward_scale and (turn + noise)/t/yaw_scale of each true step."""
    duration_ns = np.diff(stamps_ns)
    seconds = duration_ns * 1e-9
    told_distance = steps[:, 0] + deviation(motion.forward, seconds, steps) * normals[:, 0]
    told_turn = steps[:, 1] + deviation(motion.turn, seconds, steps) * normals[:, 1]
    return Intervals(
        end_ns=stamps_ns[1:],
        duration_ns=duration_ns,
        forward=told_distance / seconds / motion.forward_scale,
        yaw_rate=told_turn / seconds / motion.yaw_scale,
    )


def _stream(
    world: SimulatedWorld,
    robots: Sequence[RobotConfig],
    drives: Sequence[Drive],
    index: int,
    landmarks: Float[np.ndarray, "L 2"],
    stamps_ns: Int64[np.ndarray, " K_plus_1"],
    seed: int,
) -> RobotStream:
    robot, drive = robots[index], drives[index]
    normals = generator(seed, robot.id, "odometry").standard_normal((world.steps, 2))
    start = None if robot.id in world.unknown_starts else StartPose(drive.poses[0].copy(), None)
    return robot_stream(
        robot.id,
        0,
        start,
        _odometry(robot.motion, drive.steps, stamps_ns, normals),
        _observations(world, robot, drive, landmarks, stamps_ns[1:], seed),
        _sightings(world, robots, drives, index, stamps_ns[1:], seed),
        [other.id for other in robots],
        stamps_ns,
        drive.poses,
    )


def _observations(
    world: SimulatedWorld,
    robot: RobotConfig,
    drive: Drive,
    landmarks: Float[np.ndarray, "L 2"],
    ends_ns: Int64[np.ndarray, " K"],
    seed: int,
) -> Detections:
    """One message a step, perhaps empty."""
    seen = _visible(world, robot, drive, landmarks[np.newaxis])
    normals = generator(seed, robot.id, "observations").standard_normal((len(seen.steps), 2))
    ranges, bearings = readings(seen, robot.sensor, normals)
    offsets = np.searchsorted(seen.steps, np.arange(len(ends_ns) + 1))
    return Detections(ends_ns, offsets, (seen.points + 1).astype(np.uint32), ranges, bearings)


def _sightings(
    world: SimulatedWorld,
    robots: Sequence[RobotConfig],
    drives: Sequence[Drive],
    index: int,
    ends_ns: Int64[np.ndarray, " K"],
    seed: int,
) -> Detections:
    """One message for each step at whose end a teammate is seen; ids index the robots."""
    robot = robots[index]
    none = np.zeros(0)
    columns = [(none.astype(np.int64), none.astype(np.uint32), none, none)]
    for i, other in enumerate(robots):
        if i != index:
            at = drives[i].poses[1:, np.newaxis, :2]
            seen = _visible(world, robot, drives[index], at)
            purpose = generator(seed, robot.id, "sightings", other.id)
            ranges, bearings = readings(
                seen, robot.sensor, purpose.standard_normal((len(seen.steps), 2))
            )
            columns.append((seen.steps, np.full(len(ranges), i), ranges, bearings))
    if not columns:
        columns.append((np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0)))
    steps, others, ranges, bearings = (
        np.concatenate(parts) for parts in zip(*columns, strict=True)
    )
    order = np.lexsort((others, steps))
    return grouped(
        ends_ns[steps[order]], others[order].astype(np.uint32), ranges[order], bearings[order]
    )


def _visible(
    world: SimulatedWorld, robot: RobotConfig, drive: Drive, points: Float[np.ndarray, "#K P 2"]
) -> Visible:
    """What the robot truly sees from the end of each step."""
    sensor = robot.sensor
    nearest = sensor.min_range if world.visible_from_m is None else world.visible_from_m
    farthest = sensor.max_range if world.visible_to_m is None else world.visible_to_m
    return visible(drive.poses[1:], points, nearest, farthest, sensor.field_of_view)
