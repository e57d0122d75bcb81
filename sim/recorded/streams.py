"""The measurement streams of a log, as a world has them."""

from collections.abc import Mapping, Sequence

import numpy as np

from sim.world.streams import (
    Detections,
    Intervals,
    RobotStream,
    StartPose,
    WorldStreams,
    grouped,
    robot_stream,
)
from team import translate
from team.wire import messages as m
from team.wire.arrays import floats, ids, stamps


def recorded_streams(
    messages: Sequence[m.Message], source: str, clocks: Mapping[str, float] | None = None
) -> WorldStreams:
    """The streams that these messages make, whatever else is among them.

    clocks: the offset of each robot's odometry [s] that is to be put right; absent: none.
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
    odometry = [each for each in measurements if isinstance(each, m.Odometry)]
    seen = [each for each in measurements if isinstance(each, m.Observations)]
    sighted = [each for each in measurements if isinstance(each, m.Sightings)]
    pose, covariance = translate.pose_of(starts[0]) if starts else (None, None)
    intervals = Intervals(
        np.array(
            [translate.motion_of(each, clock_offset_s)[0] for each in odometry], dtype=np.int64
        ),
        np.array([each.duration_ns for each in odometry], dtype=np.int64),
        np.array([each.forward for each in odometry]),
        np.array([each.yaw_rate for each in odometry]),
    )
    truth = sorted(truth, key=lambda each: each.stamp_ns)
    times = [stamps(each.stamps, "stamps") for each in truth]
    poses = [floats(each.poses, "poses").reshape(-1, 3) for each in truth]
    return robot_stream(
        robot=robot,
        start_ns=measurements[0].stamp_ns,
        start=None if pose is None else StartPose(pose, covariance),
        intervals=intervals,
        observations=_detections(seen, [ids(each.ids, "ids") for each in seen]),
        sightings=_detections(sighted, [_indices(each, robots) for each in sighted]),
        teammates=robots,
        truth_ns=np.concatenate(times) if times else None,
        truth=np.concatenate(poses) if poses else None,
    )


def _indices(sighting: m.Sightings, robots: tuple[str, ...]) -> np.ndarray:
    return np.array([robots.index(name) for name in sighting.teammates], dtype=np.uint32)


def _detections(
    messages: Sequence[m.Observations] | Sequence[m.Sightings], names: Sequence[np.ndarray]
) -> Detections:
    counts = [len(each) for each in names]
    at = np.repeat(np.array([each.stamp_ns for each in messages], dtype=np.int64), counts)
    none = [np.empty(0)]
    ranges = np.concatenate([*none, *(floats(each.ranges, "ranges") for each in messages)])
    bearings = np.concatenate([*none, *(floats(each.bearings, "bearings") for each in messages)])
    return grouped(at, np.concatenate([np.empty(0, np.uint32), *names]), ranges, bearings)
