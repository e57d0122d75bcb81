"""Measurement streams of a log, as of a world."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.detections_table import merge_detections
from teamslam.sim.datasets.tables import count_note
from teamslam.sim.scenarios.scenario import Scenario, ScenarioError, loads
from teamslam.sim.world.streams import (
    NO_LABEL,
    Detections,
    Intervals,
    RobotStream,
    StartPose,
    WorldStreams,
    grouped,
)
from teamslam.team import translate
from teamslam.team.core import Scan
from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.shapes import Float, Int64, UInt32
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids, stamps
from teamslam.team.wire.bus import opened

CHANNELS = (*ch.SENSORS, ch.TRUTH, ch.TRUTH_LANDMARKS, ch.TRUTH_LABELS, ch.WORLD_CONFIG)

PART = "`teamslam log cut LOG --from S --to S -o PART.mcap` makes a log of a part without that"


def measurements_in(path: Path) -> tuple[WorldStreams, Scenario]:
    """Measurements of a log's first incarnations, with its scenario; raises LogError,
    ScenarioError.
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
    """Streams of these messages.

    clocks: corrected offset of each odometry clock [s].
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
    mixed = (_forms_of(odometry), _forms_of(seen))
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


FORM_NAMES = {
    m.Odometry: "speeds",
    m.Steering: "wheel speeds and steering",
    m.Increment: "motions",
    m.Observations: "ranges and bearings",
    m.Points: "points",
    m.Detections: "detections without identities",
}
"""Names of the forms of measurements."""


def _forms_of(messages: Sequence[m.Measurement]) -> str:
    kinds = [type(each) for each in messages]
    counts = {kind: kinds.count(kind) for kind in FORM_NAMES if kind in kinds}
    if len(counts) < 2:
        return ""
    return ", ".join(f"{count} of {FORM_NAMES[kind]}" for kind, count in counts.items())


def intervals_of(robot: str, odometry: Sequence[m.AnyOdometry], clock_offset_s: float) -> Intervals:
    """Intervals in their own forms; raises ValueError if speeds are of two kinds.

    clock_offset_s: corrected offset of the odometry's clock [s].
    """
    ends = [translate.team_time_of(each, clock_offset_s) for each in odometry]
    speeds = np.zeros((len(odometry), 2))
    motions, claims = np.full((len(odometry), 3), np.nan), np.full((len(odometry), 3, 3), np.nan)
    for k, each in enumerate(odometry):
        match each:
            case m.Increment():
                motions[k] = floats(each.increment, "increment")
                if each.covariance:
                    claims[k] = floats(each.covariance, "covariance").reshape(3, 3)
            case m.Steering():
                speeds[k] = each.wheel_speed, each.steering
            case m.Odometry():
                speeds[k] = each.forward, each.yaw_rate
    kinds = {type(each) for each in odometry} - {m.Increment}
    if len(kinds) > 1:
        raise ValueError(
            f"{robot}: its odometry has {_forms_of(odometry)}; speeds are of one kind in a stream"
        )
    return Intervals(
        end_ns=np.array(ends, dtype=np.int64),
        duration_ns=np.array([each.duration_ns for each in odometry], dtype=np.int64),
        forward=speeds[:, 0],
        yaw_rate=speeds[:, 1],
        steered=kinds == {m.Steering},
        increments=None if np.isnan(motions).all() else motions,
        covariances=None if np.isnan(claims).all() else claims,
    )


def landmarks_of(
    messages: Sequence[m.AnyScan | m.Detections], labels: m.TruthLabels | None
) -> Detections:
    """Scans with and without identities; labels: for the latter."""
    named = [each for each in messages if not isinstance(each, m.Detections)]
    unnamed = [each for each in messages if isinstance(each, m.Detections) and each.ranges]
    seen = _scans(named, [translate.scan_of(each) for each in named])
    if not unnamed:
        return seen
    scans = [translate.scan_of(each) for each in unnamed]
    known = {} if labels is None else _index_by_time(labels)
    nothing = np.empty(0, np.uint32)
    own = [
        given if len(given) == len(scan.ids) else np.full(len(scan.ids), NO_LABEL, np.uint32)
        for each, scan in zip(unnamed, scans, strict=True)
        for given in (known.get(each.stamp_ns, nothing),)
    ]
    found = _scans(
        unnamed, [Scan(i, s.ranges, s.bearings, s.own) for s, i in zip(scans, own, strict=True)]
    )
    signatures = [floats(each.signatures, "signatures") for each in unnamed]
    whole = all(each.signatures for each in unnamed)
    counts = [len(scan.ids) for scan in scans]
    classes = [translate.classes_of(m_, n) for m_, n in zip(unnamed, counts, strict=True)]
    alike = len({rows.shape[1] for rows in classes}) == 1 and classes[0].shape[1] > 0
    hidden = replace(
        found,
        points=None,
        hidden=np.ones(len(unnamed), np.bool_),
        signatures=np.concatenate(signatures) if whole else None,
        classes=np.concatenate(classes) if alike else None,
    )
    return merge_detections(seen, hidden)


def _index_by_time(labels: m.TruthLabels) -> Mapping[int, UInt32[np.ndarray, " R"]]:
    ends = np.cumsum(ids(labels.counts, "counts").astype(np.int64))
    parts = np.split(ids(labels.labels, "labels").astype(np.uint32), ends[:-1])
    return dict(zip(stamps(labels.stamps, "stamps").tolist(), parts, strict=True))


def _scans(messages: Sequence[m.AnyScan | m.Detections], scans: Sequence[Scan]) -> Detections:
    counts = [len(scan.ids) for scan in scans]
    points: list[Float[np.ndarray, "R 2"]] = [np.empty((0, 2))]
    claims: list[Float[np.ndarray, "R 3"]] = [np.empty((0, 3))]
    for each, count in zip(messages, counts, strict=True):
        unknown = np.full((count, 3), np.nan)
        at = unknown[:, :2]
        if isinstance(each, m.Points):
            at = floats(each.positions, "positions").reshape(-1, 2)
        points.append(at)
        own = floats(each.covariances, "covariances").reshape(-1, 3)
        claims.append(own if each.covariances else unknown)
    places, covariances = np.concatenate(points), np.concatenate(claims)
    offsets: Int64[np.ndarray, " M_plus_1"] = np.concatenate(([0], np.cumsum(counts)))
    nothing = np.empty(0)
    return Detections(
        stamps_ns=np.array([each.stamp_ns for each in messages], dtype=np.int64),
        offsets=offsets.astype(np.int64),
        ids=np.concatenate([np.empty(0, np.uint32), *(scan.ids for scan in scans)]),
        ranges=np.concatenate([nothing, *(scan.ranges for scan in scans)]),
        bearings=np.concatenate([nothing, *(scan.bearings for scan in scans)]),
        points=None if np.isnan(places).all() else places,
        covariances=None if np.isnan(covariances).all() else covariances,
    )
