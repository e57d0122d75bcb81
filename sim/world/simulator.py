"""Simulated world: true paths, noisy odometry, measurements of landmarks and teammates.

Motion and sensor are independent of the estimator's, so an error in either half shows. Random
streams are keyed by (seed, robot, purpose).
"""

import hashlib
from collections.abc import Iterator, Sequence
from itertools import chain, islice

import numpy as np

from teamslam.sim.world.config import SimulatedWorld, starts_unknown
from teamslam.sim.world.measuring import (
    SHORTEST_MEASUREMENT_M,
    Visible,
    add_outliers,
    draw_covariances,
    measured_increments,
    measured_speeds,
    measured_steering,
    measurements,
    on_circle,
    persistent_errors,
    seen_from,
    slip,
    visible_points,
    with_errors,
)
from teamslam.sim.world.paths import (
    Drive,
    Limits,
    Pose,
    Step,
    follow_way_points,
    steer_to_way_points,
)
from teamslam.sim.world.streams import (
    Detections,
    Intervals,
    RobotStream,
    StartPose,
    WorldStreams,
    grouped,
    moved,
)
from teamslam.team import core
from teamslam.team.config import RobotConfig, Sensor
from teamslam.team.core import atan2, hypot
from teamslam.team.shapes import Float, Int64, UInt32

LEAST_RADIUS = 1.5  # turning radius of a simulated car, in wheel bases


def simulate(world: SimulatedWorld, robots: Sequence[RobotConfig], seed: int) -> WorldStreams:
    """Streams of a team from stamp 0; landmarks are numbered from 1.

    Robot i follows path i; without a path, or with slip or arc motion, it steers to way-points.
    Each step ends with one, possibly empty, landmark message, and one of teammates if any is seen.
    With a late odometry clock, team time starts later: no stamp is negative.
    """
    landmarks = _landmarks(world, seed)
    ids = np.arange(1, len(landmarks) + 1, dtype=np.uint32)
    drives = _until_all_stand(
        world, [_drive(world, robot, i, seed) for i, robot in enumerate(robots)]
    )
    steps = len(drives[0].steps)
    begin_ns = max(0, *(_clock_ns(robot) for robot in robots))
    stamps = begin_ns + np.rint(np.arange(steps + 1) * (world.step_s * 1e9)).astype(np.int64)
    streams = tuple(
        _stream(world, robots, drives, i, landmarks, stamps, seed) for i in range(len(robots))
    )
    return WorldStreams(streams, ids, landmarks, source=f"simulated world, seed {seed}")


def _clock_ns(robot: RobotConfig) -> int:
    return round(robot.clock_offset_s * 1e9)


def generator(seed: int, *names: str) -> np.random.Generator:
    """Random generator of one purpose, e.g. (seed, robot, "odometry")."""
    digest = hashlib.sha256("/".join(names).encode()).digest()
    words = np.random.SeedSequence([seed, int.from_bytes(digest[:16], "little")])
    return np.random.Generator(np.random.Philox(words))


def _landmarks(world: SimulatedWorld, seed: int) -> Float[np.ndarray, "L 2"]:
    if world.landmark_count and world.layout != "uniform":
        return _laid_out(world, generator(seed, "world", "landmarks"))
    if world.landmark_count:
        uniform = generator(seed, "world", "landmarks").random((world.landmark_count, 2))
        return _places(world, uniform)
    return np.array(world.landmarks, dtype=np.float64).reshape(-1, 2)


def _places(world: SimulatedWorld, uniform: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    if world.radius_m is None:
        return uniform * world.size_m
    radius, direction = world.radius_m * uniform[:, 0], 2.0 * np.pi * uniform[:, 1]
    return np.column_stack((radius * core.cos(direction), radius * core.sin(direction)))


def _drive(world: SimulatedWorld, robot: RobotConfig, index: int, seed: int) -> Drive:
    motion = robot.motion
    turn_rate = min(world.turn_rate_rad_s, motion.yaw_rate_limit or np.inf)
    path = np.array(world.paths[index]) if index < len(world.paths) else None
    if path is not None and motion.kind == "turn-then-drive" and not motion.slips:
        return follow_way_points(path, world.steps)
    start, way_points = _route(world, robot.id, path, seed)
    limits = Limits(
        world.speed_m_s * world.step_s,
        turn_rate * world.step_s,
        world.way_point_tolerance_m,
        world.steering == "turn-first",
        LEAST_RADIUS * motion.wheel_base if motion.kind == "ackermann" and motion.wheel_base else 0,
    )
    normals = generator(seed, robot.id, "slip").standard_normal((world.steps, 2))

    def slipped(k: int, step: Step) -> tuple[float, float]:
        return slip(motion, step, world.step_s, normals[k])

    return steer_to_way_points(start, way_points, limits, motion.kind, world.steps, slipped)


def _route(
    world: SimulatedWorld, robot: str, path: Float[np.ndarray, "W 2"] | None, seed: int
) -> tuple[Pose, Iterator[tuple[float, float]]]:
    way_points = (
        _random_way_points(world, robot, seed)
        if path is None
        else ((x, y) for x, y in path.tolist())
    )
    if path is None and world.radius_m is not None:
        return (0.0, 0.0, 0.0), way_points
    first, second = next(way_points), next(way_points)
    start: Pose = (*first, atan2(second[1] - first[1], second[0] - first[0]))
    return start, chain((second,), way_points)


def _random_way_points(
    world: SimulatedWorld, robot: str, seed: int
) -> Iterator[tuple[float, float]]:
    def endless() -> Iterator[tuple[float, float]]:
        uniform = generator(seed, robot, "way-points")
        while True:
            x, y = _places(world, uniform.random((1, 2)))[0].tolist()
            yield x, y

    starts = 0 if world.radius_m is not None else 1
    count = world.way_point_count
    return islice(endless(), starts + count) if count else endless()


def _until_all_stand(world: SimulatedWorld, drives: Sequence[Drive]) -> list[Drive]:
    if not world.way_point_count:
        return list(drives)
    moving = [np.flatnonzero(drive.steps.any(axis=1)) for drive in drives]
    last = max((int(steps[-1]) + 1 for steps in moving if len(steps)), default=1)
    return [Drive(drive.poses[: last + 1], drive.steps[:last]) for drive in drives]


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
    unknown = starts_unknown(world, robot.id)
    start = None if unknown else StartPose(drive.poses[0].copy(), None)
    return RobotStream(
        robot=robot.id,
        start_ns=int(stamps_ns[0]),
        start=start,
        intervals=_odometry(world, robot, drive, stamps_ns, seed),
        landmark_detections=_observations(world, robot, drive, landmarks, stamps_ns, seed),
        teammate_detections=_sightings(world, robots, drives, index, stamps_ns[1:], seed),
        teammates=tuple(other.id for other in robots),
        truth_ns=stamps_ns,
        truth=drive.poses,
        clock_offset_ns=_clock_ns(robot),
    )


def _odometry(
    world: SimulatedWorld,
    robot: RobotConfig,
    drive: Drive,
    stamps_ns: Int64[np.ndarray, " K_plus_1"],
    seed: int,
) -> Intervals:
    count = len(drive.steps)
    if world.odometry == "increments":
        return _increments(world, robot, drive, stamps_ns, seed)
    normals = generator(seed, robot.id, "odometry").standard_normal((count, 2))
    of_wheels = generator(seed, robot.id, "wheels").standard_normal((count, 2))
    duration_ns = np.diff(stamps_ns)
    forward, yaw_rate = measured_speeds(
        robot.motion, drive.steps, duration_ns * 1e-9, normals, of_wheels
    )
    if world.odometry == "steering":
        if robot.motion.kind != "ackermann":
            raise ValueError(
                f'world.odometry = "steering" is a car\'s: {robot.id} needs '
                f'motion.kind = "ackermann", not "{robot.motion.kind}"'
            )
        forward, yaw_rate = measured_steering(robot.motion, forward, yaw_rate)
        return Intervals(stamps_ns[1:], duration_ns, forward, yaw_rate, steered=True)
    return Intervals(stamps_ns[1:], duration_ns, forward, yaw_rate)


def _increments(
    world: SimulatedWorld,
    robot: RobotConfig,
    drive: Drive,
    stamps_ns: Int64[np.ndarray, " K_plus_1"],
    seed: int,
) -> Intervals:
    normals = generator(seed, robot.id, "increments").standard_normal((len(drive.steps), 3))
    duration_ns = np.diff(stamps_ns)
    correlation = world.odometry_correlation if world.odometry_claims else 0.0
    increments, covariances = measured_increments(
        robot.motion, drive.poses, drive.steps, duration_ns * 1e-9, normals, correlation
    )
    if not world.odometry_claims:
        return moved(stamps_ns[1:], duration_ns, increments)
    return moved(stamps_ns[1:], duration_ns, increments, covariances / world.claims_factor)


def _observations(
    world: SimulatedWorld,
    robot: RobotConfig,
    drive: Drive,
    landmarks: Float[np.ndarray, "L 2"],
    stamps_ns: Int64[np.ndarray, " K_plus_1"],
    seed: int,
) -> Detections:
    first = 0 if world.observe_at_start else 1
    at_ns = stamps_ns[first:]
    seen = _visible(world, robot, drive.poses[first:], landmarks[np.newaxis])
    offsets = np.searchsorted(seen.steps, np.arange(len(at_ns) + 1))
    ids = (seen.points + 1).astype(np.uint32)
    if world.landmark_claims is not None:
        return _add_claims(world, robot, seen, (at_ns, offsets, ids), seed)
    ranges, bearings = _read(world, robot.sensor, seen, seed, robot.id, "observations")
    if world.landmark_form == "points":
        points = np.column_stack([ranges * core.cos(bearings), ranges * core.sin(bearings)])
        return Detections(at_ns, offsets, ids, ranges, bearings, points)
    clean = Detections(at_ns, offsets, ids, ranges, bearings)
    if not world.outlier_share:
        return clean
    return add_outliers(
        clean,
        world.outlier_share,
        world.outlier_kind,
        _span(world, robot.sensor),
        robot.sensor.field_of_view,
        len(landmarks),
        generator(seed, robot.id, "garbage").random((len(ids), 3)),
    )


def _add_claims(
    world: SimulatedWorld,
    robot: RobotConfig,
    seen: Visible,
    messages: tuple[
        Int64[np.ndarray, " M"], Int64[np.ndarray, " M_plus_1"], UInt32[np.ndarray, " V"]
    ],
    seed: int,
) -> Detections:
    assert world.landmark_claims is not None
    points = world.landmark_form == "points"
    random = generator(seed, robot.id, "claims")
    uniform, normals = (
        random.random((len(seen.steps), 3)),
        random.standard_normal((len(seen.steps), 2)),
    )
    covariances = draw_covariances(
        seen, robot.sensor, world.landmark_claims, uniform, points=points
    )
    claims = covariances / world.claims_factor
    if points:
        ahead = np.column_stack([core.cos(seen.bearings), core.sin(seen.bearings)])
        xy = with_errors(seen.ranges[:, np.newaxis] * ahead, covariances, normals)
        polar = core.hypot(xy[:, 0], xy[:, 1]), core.atan2(xy[:, 1], xy[:, 0])
        return Detections(*messages, *polar, xy, claims)
    true = np.column_stack([seen.ranges, seen.bearings])
    ranges, bearings = with_errors(true, covariances, normals).T
    return Detections(
        *messages,
        np.maximum(ranges, SHORTEST_MEASUREMENT_M),
        on_circle(bearings),
        covariances=claims,
    )


def _read(
    world: SimulatedWorld, sensor: Sensor, seen: Visible, seed: int, *names: str
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    errors = generator(seed, *names).standard_normal((len(seen.steps), 2))
    if sensor.range_white < 1.0 or sensor.bearing_white < 1.0:
        lasting = generator(seed, *names, "persistent").standard_normal((len(seen.steps), 2))
        errors = persistent_errors(seen, sensor, world.step_s, np.column_stack((errors, lasting)))
    return measurements(seen, sensor, errors)


def _sightings(
    world: SimulatedWorld,
    robots: Sequence[RobotConfig],
    drives: Sequence[Drive],
    index: int,
    ends_ns: Int64[np.ndarray, " K"],
    seed: int,
) -> Detections:
    robot = robots[index]
    none = np.zeros(0)
    columns = [(none.astype(np.int64), none.astype(np.uint32), none, none)]
    for i in _find_within_reach(world, robot, drives, index):
        other = robots[i]
        if i != index:
            at = drives[i].poses[1:, np.newaxis, :2]
            seen = _visible(world, robot, drives[index].poses[1:], at)
            ranges, bearings = _read(
                world, robot.sensor, seen, seed, robot.id, "sightings", other.id
            )
            columns.append((seen.steps, np.full(len(ranges), i), ranges, bearings))
    steps, others, ranges, bearings = (
        np.concatenate(parts) for parts in zip(*columns, strict=True)
    )
    order = np.lexsort((others, steps))
    return grouped(
        ends_ns[steps[order]], others[order].astype(np.uint32), ranges[order], bearings[order]
    )


def _find_within_reach(
    world: SimulatedWorld, robot: RobotConfig, drives: Sequence[Drive], index: int
) -> list[int]:
    _, farthest = _limits(world, robot.sensor)
    reach = 1.001 * (farthest + hypot(*robot.sensor.mount[:2])) + 1e-6
    at = np.stack([drive.poses[1:, :2] for drive in drives])
    near = (np.abs(at - at[index]) <= reach).all(axis=2).any(axis=1)
    return np.flatnonzero(near).tolist()


def _visible(
    world: SimulatedWorld,
    robot: RobotConfig,
    poses: Float[np.ndarray, "K 3"],
    points: Float[np.ndarray, "#K P 2"],
) -> Visible:
    sensor = robot.sensor
    nearest, farthest = _limits(world, sensor)
    if sensor.is_mounted:
        poses = seen_from(poses, sensor.mount)
    return visible_points(poses, points, nearest, farthest, sensor.field_of_view)


def _limits(world: SimulatedWorld, sensor: Sensor) -> tuple[float, float]:
    nearest = sensor.min_range if world.visible_from_m is None else world.visible_from_m
    farthest = sensor.max_range if world.visible_to_m is None else world.visible_to_m
    return nearest, farthest


def _span(world: SimulatedWorld, sensor: Sensor) -> tuple[float, float]:
    nearest, farthest = _limits(world, sensor)
    across = hypot(world.size_m, world.size_m) if world.radius_m is None else 2.0 * world.radius_m
    return nearest, max(nearest, min(farthest, across))


INNER = 0.1  # least wall distance of a landmark, as a share of a room's side


def _laid_out(world: SimulatedWorld, rng: np.random.Generator) -> Float[np.ndarray, "L 2"]:
    if world.layout == "twins":
        return _twins(world, rng)
    side = world.size_m / world.rooms
    each = max(world.landmark_count // world.rooms**2, 1)
    pattern = side * rng.uniform(INNER, 1.0 - INNER, (each, 2))
    corners = side * np.stack(np.divmod(np.arange(world.rooms**2), world.rooms), axis=1)
    return np.asarray((corners[:, None] + pattern[None]).reshape(-1, 2))


def _twins(world: SimulatedWorld, rng: np.random.Generator) -> Float[np.ndarray, "L 2"]:
    count = world.landmark_count
    first = rng.uniform(0.0, world.size_m, ((count + 1) // 2, 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(first))
    second = first + world.twin_m * np.column_stack((core.cos(angle), core.sin(angle)))
    return np.asarray(np.concatenate((first, second))[:count])
