"""Measurement streams of a log, as of a world."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from teamslam.team.wire import channels as ch, messages as m
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


@dataclass
class _Robot:
    """Messages of one robot; later: (incarnation, number) of measurements of later incarnations."""

    measurements: dict[int, m.Measurement] = field(default_factory=dict)
    later: set[tuple[int, int]] = field(default_factory=set)
    truth: list[m.Truth] = field(default_factory=list)
    labels: m.TruthLabels | None = None


def recorded_streams(
    messages: Sequence[m.Message], source: str, clocks: Mapping[str, float] | None = None
) -> WorldStreams:
    """Streams of these messages.

    clocks: corrected offset of each odometry clock [s].
    """
    offsets = {} if clocks is None else clocks
    found: dict[str, _Robot] = defaultdict(_Robot)
    landmark_ids, landmarks = np.empty(0, np.uint32), None
    for message in messages:
        match message:
            case m.Measurement() if message.incarnation == 1:
                found[message.robot].measurements[message.number] = message
            case m.Measurement():
                found[message.robot].later.add((message.incarnation, message.number))
            case m.TruthLabels():
                found[message.robot].labels = message
            case m.Truth():
                found[message.robot].truth.append(message)
            case m.TruthLandmarks():
                landmark_ids = ids(message.ids, "ids")
                landmarks = floats(message.positions, "positions").reshape(-1, 2)
    robots = tuple(sorted(robot for robot, of in found.items() if of.measurements))
    streams = [_stream(robot, found[robot], robots, offsets.get(robot, 0.0)) for robot in robots]
    why = "left out: its stream began anew, and a data set has one stream of each robot"
    notes = [
        f"{robot}: {count_note(len(of.later), 'measurement', why)}"
        for robot, of in sorted(found.items())
        if of.later
    ]
    return WorldStreams(tuple(streams), landmark_ids, landmarks, source, tuple(notes))


def _stream(robot: str, of: _Robot, robots: tuple[str, ...], clock_offset_s: float) -> RobotStream:
    measurements = [of.measurements[number] for number in sorted(of.measurements)]
    starts = [each for each in measurements if isinstance(each, m.InitialPose)]
    odometry = [each for each in measurements if isinstance(each, m.AnyOdometry)]
    seen = [each for each in measurements if isinstance(each, m.AnyScan | m.Detections)]
    sighted = [each for each in measurements if isinstance(each, m.Sightings)]
    fixes = [each for each in measurements if isinstance(each, m.Fix)]
    pose, covariance = translate.pose_of(starts[0]) if starts else (None, None)
    mixed = (_forms_of(odometry), _forms_of(seen))
    truth = sorted(of.truth, key=lambda each: each.stamp_ns)
    times = [stamps(each.stamps, "stamps") for each in truth]
    poses = [floats(each.poses, "poses").reshape(-1, 3) for each in truth]
    return RobotStream(
        robot=robot,
        start_ns=measurements[0].stamp_ns,
        start=None if pose is None else StartPose(pose, covariance),
        intervals=intervals_of(robot, odometry, clock_offset_s),
        landmark_detections=landmarks_of(seen, of.labels),
        teammate_detections=_sightings(sighted, robots),
        teammates=robots,
        fixes_ns=np.array([each.stamp_ns for each in fixes], np.int64),
        fixes=np.array([_fix(each) for each in fixes]).reshape(-1, 5),
        truth_ns=np.concatenate(times) if times else None,
        truth=np.concatenate(poses) if poses else None,
        notes=tuple(
            f"its stream has {forms}; each stays in its own form" for forms in mixed if forms
        ),
    )


def _fix(fix: m.Fix) -> Float[np.ndarray, "5"]:
    covariance = floats(fix.covariance, "covariance") if fix.covariance else np.full(3, np.nan)
    return np.concatenate([floats(fix.position, "position"), covariance])


def _sightings(messages: Sequence[m.Sightings], robots: tuple[str, ...]) -> Detections:
    at = [each.stamp_ns for each in messages for _ in each.teammates]
    seen = [robots.index(name) for each in messages for name in each.teammates]
    none = [np.empty(0)]
    ranges = np.concatenate([*none, *(floats(each.ranges, "ranges") for each in messages)])
    bearings = np.concatenate([*none, *(floats(each.bearings, "bearings") for each in messages)])
    return grouped(np.array(at, np.int64), np.array(seen, np.uint32), ranges, bearings)


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
    counts: Counter[object] = Counter(map(type, messages))
    forms = [f"{counts[kind]} of {name}" for kind, name in FORM_NAMES.items() if counts[kind]]
    return ", ".join(forms) if len(forms) > 1 else ""


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
