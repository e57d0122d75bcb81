"""Measurement streams of a log, as of a world."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.scans import count_note
from teamslam.sim.recorded.forms import forms_of, intervals_of, landmarks_of
from teamslam.sim.scenarios.scenario import Scenario, ScenarioError, loads
from teamslam.sim.world.streams import (
    Detections,
    RobotStream,
    StartPose,
    WorldStreams,
    grouped,
)
from teamslam.team import translate
from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids, stamps
from teamslam.team.wire.bus import opened

CHANNELS = (*ch.SENSORS, ch.TRUTH, ch.TRUTH_LANDMARKS, ch.TRUTH_LABELS, ch.WORLD_CONFIG)

PART = "`teamslam log cut LOG --from S --to S -o PART.mcap` makes a log of a part without that"


def measurements_in(path: Path) -> tuple[WorldStreams, Scenario]:
    """Read the measurements of a log with its scenario: its world's, or the recorder's.

    Uses the first incarnation of each robot. Raises LogError, ScenarioError.
    """
    log = open_log(path)
    messages = [opened(sample)[2] for sample in log.samples(CHANNELS)]
    configurations = [each.configuration for each in messages if isinstance(each, m.Configuration)]
    by_recorder = log.metadata.get("scenario")  # of a team without a world
    configurations = configurations or ([] if by_recorder is None else [by_recorder])
    if not configurations:
        raise ScenarioError(f"{path}: the log has no scenario of its world")
    scenario = loads(configurations[-1])
    clocks = {robot.id: robot.clock_offset_s for robot in scenario.robots}
    try:
        return recorded_streams(messages, path.name, clocks), scenario
    except ValueError as error:
        raise LogError(path, str(error), PART) from None


def recorded_streams(
    messages: Sequence[m.Message], source: str, clocks: Mapping[str, float] | None = None
) -> WorldStreams:
    """Streams of the measurements among these messages.

    clocks: corrected offset of each robot's odometry clock [s]; absent: none.
    """
    offsets = {} if clocks is None else clocks
    measurements: dict[str, dict[int, m.Measurement]] = {}
    later: dict[str, dict[int, set[int]]] = {}
    truth: dict[str, list[m.Truth]] = {}
    labels: dict[str, m.TruthLabels] = {}
    landmark_ids, landmarks = np.empty(0, np.uint32), None
    for message in messages:
        match message:
            case m.Measurement() if message.incarnation == 1:
                measurements.setdefault(message.robot, {})[message.number] = message
            case m.Measurement():
                of = later.setdefault(message.robot, {}).setdefault(message.incarnation, set())
                of.add(message.number)
            case m.TruthLabels():
                labels[message.robot] = message
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
            labels.get(robot),
            tuple(sorted(measurements)),
            offsets.get(robot, 0.0),
        )
        for robot, of in sorted(measurements.items())
    ]
    notes = [
        f"{robot}: "
        + count_note(
            sum(map(len, of.values())),
            "measurement",
            "left out: its stream began anew, and a data set has one stream of each robot",
        )
        for robot, of in sorted(later.items())
    ]
    return WorldStreams(tuple(streams), landmark_ids, landmarks, source, tuple(notes))


def _stream(
    robot: str,
    measurements: Sequence[m.Measurement],
    truth: Sequence[m.Truth],
    labels: m.TruthLabels | None,
    robots: tuple[str, ...],
    clock_offset_s: float,
) -> RobotStream:
    starts = [each for each in measurements if isinstance(each, m.InitialPose)]
    odometry = [each for each in measurements if isinstance(each, m.AnyOdometry)]
    seen = [each for each in measurements if isinstance(each, m.AnyScan | m.Detections)]
    sighted = [each for each in measurements if isinstance(each, m.Sightings)]
    fixes = [each for each in measurements if isinstance(each, m.Fix)]
    pose, covariance = translate.pose_of(starts[0]) if starts else (None, None)
    intervals = intervals_of(robot, odometry, clock_offset_s)
    mixed = (forms_of(odometry), forms_of(seen))
    truth = sorted(truth, key=lambda each: each.stamp_ns)
    times = [stamps(each.stamps, "stamps") for each in truth]
    poses = [floats(each.poses, "poses").reshape(-1, 3) for each in truth]
    return RobotStream(
        robot=robot,
        start_ns=measurements[0].stamp_ns,
        start=None if pose is None else StartPose(pose, covariance),
        intervals=intervals,
        landmark_detections=landmarks_of(seen, labels),
        teammate_detections=_detections(sighted, [_indices(each, robots) for each in sighted]),
        teammates=robots,
        fixes_ns=np.array([each.stamp_ns for each in fixes], np.int64),
        fixes=np.array([_fix(each) for each in fixes]).reshape(-1, 5),
        truth_ns=np.concatenate(times) if times else None,
        truth=np.concatenate(poses) if poses else None,
        notes=tuple(
            f"its stream has {forms}; each stays in its own form" for forms in mixed if forms
        ),
    )


def _indices(sighting: m.Sightings, robots: tuple[str, ...]) -> np.ndarray:
    return np.array([robots.index(name) for name in sighting.teammates], dtype=np.uint32)


def _fix(fix: m.Fix) -> Float[np.ndarray, "5"]:
    covariance = floats(fix.covariance, "covariance") if fix.covariance else np.full(3, np.nan)
    return np.concatenate([floats(fix.position, "position"), covariance])


def _detections(messages: Sequence[m.Sightings], names: Sequence[np.ndarray]) -> Detections:
    counts = [len(each) for each in names]
    at = np.repeat(np.array([each.stamp_ns for each in messages], dtype=np.int64), counts)
    none = [np.empty(0)]
    ranges = np.concatenate([*none, *(floats(each.ranges, "ranges") for each in messages)])
    bearings = np.concatenate([*none, *(floats(each.bearings, "bearings") for each in messages)])
    return grouped(at, np.concatenate([np.empty(0, np.uint32), *names]), ranges, bearings)
