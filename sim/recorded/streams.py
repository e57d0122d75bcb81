"""The measurement streams of a log, as a world has them."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sim.scenarios.scenario import Scenario, ScenarioError, loads
from sim.world.streams import (
    Detections,
    Intervals,
    RobotStream,
    StartPose,
    WorldStreams,
    grouped,
    moved,
    robot_stream,
)
from team import translate
from team.recording.reader import LogError, open_log
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import floats, ids, stamps
from team.wire.bus import opened

CHANNELS = (*ch.SENSORS, ch.TRUTH, ch.TRUTH_LANDMARKS, ch.WORLD_CONFIG)

PART = "`teamslam log cut LOG --from S --to S -o PART.mcap` makes a log of a part without that"


def measurements_in(path: Path) -> tuple[WorldStreams, Scenario]:
    """The measurements of a log with its scenario: its world's, or the recorder's.

    Of each robot the first incarnation is used. Raises LogError, ScenarioError.
    """
    log = open_log(path)
    messages = [opened(sample)[2] for sample in log.samples(CHANNELS)]
    configurations = [each.configuration for each in messages if isinstance(each, m.Configuration)]
    by_recorder = log.metadata.get("scenario")  # of a team without a world
    configurations = configurations or ([] if by_recorder is None else [by_recorder])
    if not configurations:
        raise ScenarioError(f"{path}: the log does not say the world's scenario")
    scenario = loads(configurations[-1])
    clocks = {robot.id: robot.clock_offset_s for robot in scenario.robots}
    try:
        return recorded_streams(messages, path.name, clocks), scenario
    except ValueError as error:
        raise LogError(path, str(error), PART) from None


def recorded_streams(
    messages: Sequence[m.Message], source: str, clocks: Mapping[str, float] | None = None
) -> WorldStreams:
    """The streams of the measurements among these messages.

    clocks: the offset of each robot's odometry clock [s] that is corrected; absent: none.
    """
    offsets = {} if clocks is None else clocks
    measurements: dict[str, dict[int, m.Measurement]] = {}
    truth: dict[str, list[m.Truth]] = {}
    landmark_ids, landmarks = np.empty(0, np.uint32), None
    for message in messages:
        match message:
            case m.Measurement() if message.incarnation == 1:
                measurements.setdefault(message.robot, {})[message.number] = message
            case m.Truth():
                truth.setdefault(message.robot, []).append(message)
            case m.TruthLandmarks():
                landmark_ids = ids(message.ids, "ids")
                landmarks = floats(message.positions, "positions").reshape(-1, 2)
            case _:
                pass
    streams = [
        _stream(
            robot,
            [of[i] for i in sorted(of)],
            truth.get(robot, []),
            tuple(sorted(measurements)),
            offsets.get(robot, 0.0),
        )
        for robot, of in sorted(measurements.items())
    ]
    return WorldStreams(tuple(streams), landmark_ids, landmarks, source)


def _stream(
    robot: str,
    measurements: Sequence[m.Measurement],
    truth: Sequence[m.Truth],
    robots: tuple[str, ...],
    clock_offset_s: float,
) -> RobotStream:
    starts = [each for each in measurements if isinstance(each, m.InitialPose)]
    odometry = [each for each in measurements if isinstance(each, m.AnyOdometry)]
    seen = [each for each in measurements if isinstance(each, m.AnyScan)]
    sighted = [each for each in measurements if isinstance(each, m.Sightings)]
    pose, covariance = translate.pose_of(starts[0]) if starts else (None, None)
    intervals = _intervals(robot, odometry, clock_offset_s)
    truth = sorted(truth, key=lambda each: each.stamp_ns)
    times = [stamps(each.stamps, "stamps") for each in truth]
    poses = [floats(each.poses, "poses").reshape(-1, 3) for each in truth]
    return robot_stream(
        robot=robot,
        start_ns=measurements[0].stamp_ns,
        start=None if pose is None else StartPose(pose, covariance),
        intervals=intervals,
        observations=_observations(robot, seen),
        sightings=_detections(sighted, [_indices(each, robots) for each in sighted]),
        teammates=robots,
        truth_ns=np.concatenate(times) if times else None,
        truth=np.concatenate(poses) if poses else None,
    )


def _one_kind(robot: str, messages: Sequence[m.Message]) -> type[m.Message] | None:
    """The class of all of these messages; raises ValueError where they differ."""
    kinds = {type(each) for each in messages}
    if len(kinds) > 1:
        names = " and ".join(sorted(kind.__name__ for kind in kinds))
        raise ValueError(f"{robot}: its stream has {names}; one form is needed")
    return kinds.pop() if kinds else None


def _intervals(robot: str, odometry: Sequence[m.AnyOdometry], clock_offset_s: float) -> Intervals:
    ends = np.array(
        [translate.team_time_of(each, clock_offset_s) for each in odometry], dtype=np.int64
    )
    durations = np.array([each.duration_ns for each in odometry], dtype=np.int64)
    kind = _one_kind(robot, odometry)
    if kind is m.Increment:
        given = [each for each in odometry if isinstance(each, m.Increment)]
        increments = np.array([floats(each.increment, "increment") for each in given])
        claims = {bool(each.covariance) for each in given}
        if len(claims) > 1:
            raise ValueError(f"{robot}: only some of its increments have a covariance")
        if not claims.pop():
            return moved(ends, durations, increments)
        matrices = np.array([floats(each.covariance, "covariance") for each in given])
        return moved(ends, durations, increments, matrices.reshape(-1, 3, 3))
    pairs = np.array([
        (each.wheel_speed, each.steering)
        if isinstance(each, m.Steering)
        else (each.forward, each.yaw_rate)
        for each in odometry
        if not isinstance(each, m.Increment)
    ]).reshape(-1, 2)  # fmt: skip
    return Intervals(ends, durations, pairs[:, 0], pairs[:, 1], steered=kind is m.Steering)


def _observations(robot: str, messages: Sequence[m.AnyScan]) -> Detections:
    kind = _one_kind(robot, messages)
    scans = [translate.scan_of(each) for each in messages]
    full = [k for k, scan in enumerate(scans) if len(scan.ids)]
    at = np.repeat(
        np.array([each.stamp_ns for each in messages], dtype=np.int64),
        [len(scan.ids) for scan in scans],
    )
    none = np.empty(0)
    points = claimed = None
    if kind is m.Points:
        given = [floats(x.positions, "positions") for x in messages if isinstance(x, m.Points)]
        points = np.concatenate([none, *given]).reshape(-1, 2)
    claims = {bool(messages[k].covariances) for k in full}
    if len(claims) > 1:
        raise ValueError(f"{robot}: only some of its observations have covariances")
    if claims == {True}:
        own = [floats(each.covariances, "covariances") for each in messages]
        claimed = np.concatenate([none, *own]).reshape(-1, 3)
    return grouped(
        at,
        np.concatenate([np.empty(0, np.uint32), *(scan.ids for scan in scans)]),
        np.concatenate([none, *(scan.ranges for scan in scans)]),
        np.concatenate([none, *(scan.bearings for scan in scans)]),
        points,
        claimed,
    )


def _indices(sighting: m.Sightings, robots: tuple[str, ...]) -> np.ndarray:
    return np.array([robots.index(name) for name in sighting.teammates], dtype=np.uint32)


def _detections(messages: Sequence[m.Sightings], names: Sequence[np.ndarray]) -> Detections:
    counts = [len(each) for each in names]
    at = np.repeat(np.array([each.stamp_ns for each in messages], dtype=np.int64), counts)
    none = [np.empty(0)]
    ranges = np.concatenate([*none, *(floats(each.ranges, "ranges") for each in messages)])
    bearings = np.concatenate([*none, *(floats(each.bearings, "bearings") for each in messages)])
    return grouped(at, np.concatenate([np.empty(0, np.uint32), *names]), ranges, bearings)
