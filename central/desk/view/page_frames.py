"""Frames for the page: one JSON object per event, in log order.

t: seconds of team time since the first measurement. Poses and errors are rows of numbers, maps and
particles base64 of little-endian float32 and uint32. Frames, by `k`: now: team time of all active
robots. pose: rows x, y, heading, xx, xy, yy, heading variance. outside: whether the robot is
outside the team's map; its poses are then not sent. frame: the pose frame changes. err: rows of
three errors, three 3σ bounds, NEES per dof. truth: rows x, y, heading. map: `changes` since the
saved maps: number of unchanged landmarks, then landmark, state, place in the saved map,
displacement, its sigma [m], χ², expected observations. path: `ends`: of submaps alone. align: x, y,
theta of the truth's frame in another map frame, or null. see: rows of landmark (−1 without
identity) or teammate, ahead [m], left [m]. link: a submap (to) or a prior (from) `central`. wait:
start-up states. bytes: [key, t, messages, bytes] of one second. ev: event. eof: end of the log.
"""

import base64
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from teamslam.central.config import UNREADABLE
from teamslam.central.desk.drawing import ROBOT_COLOURS
from teamslam.central.desk.evaluation.association import members_of
from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.central.desk.evaluation.events import EventDetector, is_awaited
from teamslam.central.desk.evaluation.running import DisplayedPoses, Estimate, TruthAlignment
from teamslam.central.desk.names import data_set_of
from teamslam.central.desk.view.drawn import Landmarks, centre_particles, landmarks_of
from teamslam.central.desk.view.node import FORGET_NS, ViewerNode
from teamslam.central.unnamed_landmarks import SHOWN, STEPS
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, ids, stamps
from teamslam.team.wire.bus import Sample

SPACING_NS = 100_000_000  # least time between poses sent to the page
MAP_SPACING_NS = 1_000_000_000  # least time between maps sent to the page
SEEN_NS = 500_000_000  # least time between measurements of one landmark sent to the page
CHANNELS = frozenset(
    (*ViewerNode.listens, ch.ALIVE, ch.ROBOT_CONFIG, ch.OBSERVATIONS, ch.SIGHTINGS)
)
"""Channels whose messages `PageFrames.take` converts."""
_OF_A_SET = ("set_submaps", "set_agrees")
_BEGIN = frozenset((*ch.SENSORS, ch.TRUTH))


def title_of(team: str, metadata: Mapping[str, str], name: str) -> str:
    """Page title: data set, or scenario and seed; file."""
    text = metadata.get("scenario", "{}")
    if data_set := data_set_of(text):
        return f"{data_set} · {name}"
    try:
        scenario = str(msgspec.json.decode(text)["name"])
    except (*UNREADABLE, LookupError, TypeError):
        scenario = team
    seed = f", seed {metadata['seed']}" if "seed" in metadata else ""
    return f"{scenario}{seed} · {name}"


class _Sensor(msgspec.Struct, frozen=True):
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    max_range: float | None = None
    field_of_view: float | None = None


class _Robot(msgspec.Struct, frozen=True):
    """The part of a robot's configuration that the page draws."""

    sensor: _Sensor = _Sensor()


@dataclass
class _Stream(DisplayedPoses):
    outside: bool = False
    frame: str | None = None
    pose_ns: int | None = None
    truth_ns: int | None = None
    mount: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    seen_ns: dict[int | str, int] = field(default_factory=dict)
    rows: dict[str, tuple[list[float], list[float | str]]] = field(default_factory=dict)

    def add(self, kind: str, t: float, row: Sequence[float | str]) -> None:
        times, values = self.rows.setdefault(kind, ([], []))
        times.append(t)
        values += row


class PageFrames:
    """Convert samples to frames: `count`, `take`, `flush`."""

    def __init__(self) -> None:
        self._out: list[str] = []
        self._origin_ns: int | None = None
        self._streams: dict[str, _Stream] = defaultdict(_Stream)
        self._traffic: dict[tuple[str, int], list[int]] = {}
        self._detector = EventDetector()
        self._truth = TruthAlignment()
        self._aligned: dict[str | None, list[float] | None] = {}
        self._map: m.FusedMap | None = None
        self._has_map = False
        self._map_ns: int | None = None
        self._figures_s: dict[str, tuple[int, float, float]] = {}
        self._awaited: dict[str, list[str]] = {}
        self._newest_ns = 0

    def hello(self, team: str, metadata: Mapping[str, str], name: str, *, live: bool) -> None:
        """Emit the first frame; live: the log is being recorded."""
        title = title_of(team, metadata, name)
        self._add_frame("hello", team=team, title=title, colours=ROBOT_COLOURS, live=live)

    def count(self, sample: Sample) -> None:
        """Count a sample as traffic, or as a link."""
        channel, name = ch.channel_of(sample.key) or (None, "")
        if self._origin_ns is None and channel in _BEGIN:
            self._origin_ns = sample.stamp_ns
        place = (sample.key, int(self._t(sample.stamp_ns)))
        counted = self._traffic.setdefault(place, [0, 0])
        counted[0] += 1
        counted[1] += len(sample.payload)
        if channel in (ch.SUBMAP, ch.PRIOR):
            a, b = (name, "central") if channel is ch.SUBMAP else ("central", name)
            # A prior follows the poses before it.
            t = self._t(max(sample.stamp_ns, self._newest_ns))
            self._add_frame("link", t=t, a=a, b=b)

    def flush(self, now_ns: int | None = None) -> list[str]:
        """Return new frames; now_ns: team time of the robots."""
        for robot, stream in self._streams.items():
            self._add_errors(stream)
            for kind, (times, values) in stream.rows.items():
                self._add_frame(kind, r=robot, t=times, v=values)
            stream.rows = {}
        if self._traffic:
            rows = [[key, t, *counted] for (key, t), counted in sorted(self._traffic.items())]
            self._traffic = {}
            self._add_frame("bytes", v=rows)
        if now_ns is not None:
            self._add_frame("now", t=self._t(now_ns))
        out, self._out = self._out, []
        return out

    def end(self, notes: Sequence[str] = ()) -> list[str]:
        """Return the last frames; notes: log faults."""
        out = self.flush(self._newest_ns)
        for note in notes:
            self._add_frame("ev", t=self._t(self._newest_ns), e="warning", n="log", x=note)
        self._add_frame("eof", complete=True)
        return out + self.flush()

    def _add_frame(self, kind: str, **fields: object) -> None:
        self._out.append(json.dumps({"k": kind, **fields}, separators=(",", ":")))

    def _t(self, stamp_ns: int) -> float:
        if self._origin_ns is None:
            return 0.0
        return round(max(stamp_ns - self._origin_ns, 0) * 1e-9, 3)

    def take(self, channel: ch.Channel, message: m.Message) -> None:
        """Convert a message of one of the CHANNELS."""
        self._add_events(message)
        self._truth.take(message)
        match message:
            case m.InitialPose():
                self._align()
            case m.PoseEstimate():
                self._take_pose(message, by_team=channel is ch.TEAM_POSE)
            case m.Truth():
                self._take_truth(message)
            case m.FusedMap():
                self._take_map(message)
            case m.Status():
                self._take_status(message)
            case m.Configuration():
                self._take_sensor(message)
            case m.Observations() | m.Points() | m.Detections() | m.Sightings():
                self._take_measurements(message)
            case m.TruthLandmarks():
                true = self._truth.landmarks
                places = true.positions.ravel().tolist()
                self._add_frame("truth_map", ids=true.ids.tolist(), xy=places)
            case m.ParticleCloud():
                t, seen = self._t(message.stamp_ns), centre_particles(message)
                self._add_frame("cloud", r=message.robot, t=t, v=_base64(seen.astype("<f4")))
            case m.Trajectory():
                times = [self._t(at) for at in stamps(message.stamps, "stamps").tolist()]
                poses = floats(message.poses, "poses").tolist()
                ends = bool(message.crosses)
                self._add_frame("path", r=message.robot, t=times, v=poses, ends=ends)
                self._align()

    def _add_events(self, message: m.Message) -> None:
        if isinstance(message, m.PoseEstimate | m.FusedMap):  # the world runs ahead
            self._newest_ns = max(self._newest_ns, message.stamp_ns)
        timeless = isinstance(message, m.Liveliness | m.Status | m.Configuration)
        at_ns = self._newest_ns if timeless else message.stamp_ns
        for each in self._detector.take(message, at_ns):
            self._add_frame("ev", t=self._t(each.stamp_ns), e=each.kind, n=each.node, x=each.text)

    def _take_pose(self, message: m.PoseEstimate, *, by_team: bool) -> None:
        stream = self._streams[message.robot]
        is_displayed = stream.has(message, by_team=by_team)
        due = stream.pose_ns is None or message.stamp_ns >= stream.pose_ns + SPACING_NS
        if not (is_displayed and due):
            return
        stream.pose_ns = message.stamp_ns
        outside = self._has_map and not message.in_team_frame
        if outside != stream.outside:
            stream.outside = outside
            self._add_frame("outside", r=message.robot, t=self._t(message.stamp_ns), v=outside)
        if outside:
            return
        frame = "" if self._truth.frames.has(message.frame) else message.frame
        if stream.frame not in (None, frame):
            self._add_frame("frame", r=message.robot, t=self._t(message.stamp_ns))
        stream.frame = frame
        estimate = Estimate.of(message)
        spread = estimate.covariance[(0, 0, 1, 2), (0, 1, 1, 2)].tolist()
        row = [_short(v) for v in (*estimate.pose.tolist(), *spread)]
        stream.add("pose", self._t(message.stamp_ns), row)
        if not frame:
            stream.errors.take_pose(estimate)

    def _take_truth(self, message: m.Truth) -> None:
        stream = self._streams[message.robot]
        poses = floats(message.poses, "poses").reshape(-1, 3).tolist()
        for at, pose in zip(stamps(message.stamps, "stamps").tolist(), poses, strict=True):
            if stream.truth_ns is None or at >= stream.truth_ns + SPACING_NS:
                stream.truth_ns = at
                stream.add("truth", self._t(at), [_short(v) for v in pose])
        stream.errors.take_truth(message)

    def _take_sensor(self, message: m.Configuration) -> None:
        try:
            sensor = msgspec.json.decode(message.configuration, type=_Robot).sensor
        except UNREADABLE:
            return
        robot = message.node.removeprefix("robot/")
        self._streams[robot].mount = np.array(sensor.mount)
        within = {"range": sensor.max_range, "view": sensor.field_of_view}
        self._add_frame("sensor", r=robot, mount=sensor.mount, **within)

    def _take_measurements(
        self, message: m.Observations | m.Points | m.Detections | m.Sightings
    ) -> None:
        stream, at = self._streams[message.robot], message.stamp_ns
        if isinstance(message, m.Points):
            places = floats(message.positions, "positions").reshape(-1, 2)
        else:
            bearings = floats(message.bearings, "bearings")
            ahead_left = np.column_stack([np.cos(bearings), np.sin(bearings)])
            places = floats(message.ranges, "ranges")[:, np.newaxis] * ahead_left
        names: Sequence[int | str] = [-1] * len(places)
        if isinstance(message, m.Sightings):
            names = message.teammates
        elif not isinstance(message, m.Detections):
            names = ids(message.ids, "ids").tolist()
        due = {name for name in names if at >= stream.seen_ns.get(name, -SEEN_NS) + SEEN_NS}
        stream.seen_ns |= dict.fromkeys(due, at)
        seen = transform_points(stream.mount, places)
        for name, (x, y) in zip(names, seen.tolist(), strict=True):
            if name in due:
                stream.add("see", self._t(at), [name, round(x, 3), round(y, 3)])

    def _add_errors(self, stream: _Stream) -> None:
        errors = stream.errors.known()
        stream.errors.forget((stream.pose_ns or 0) - FORGET_NS)
        if errors is None:
            return
        for k, at in enumerate(errors.stamps_ns.tolist()):
            row = [*errors.errors[k].tolist(), *(3.0 * errors.sigmas[k]).tolist()]
            row.append(float(errors.nees[k]) / 3.0)
            stream.add("err", self._t(at), [_short(v) for v in row])

    def _take_map(self, message: m.FusedMap) -> None:
        due = self._map_ns is None or message.stamp_ns >= self._map_ns + MAP_SPACING_NS
        if not (due or message.final):
            return
        self._map_ns = message.stamp_ns
        landmarks = landmarks_of(message)
        self._has_map = len(landmarks.ids) > 0
        self._map = message if self._has_map else None
        self._align()
        fit = self._truth.fit(message)
        extra: dict[str, object] = {}
        if sets := sets_of(message):
            support = [sets.get(int(id_), (0, [])) for id_ in landmarks.ids]
            extra = {"n": [count for count, _ in support], "why": [words for _, words in support]}
        if message.changes:
            extra["changes"] = _changes_of(message, landmarks)
        self._add_frame(
            "map", t=self._t(message.stamp_ns), f=self._frame(),
            ids=_base64(landmarks.ids.astype("<u4")), xy=_base64(landmarks.means.astype("<f4")),
            c=_base64(landmarks.blocks.astype("<f4")), final=message.final, joint=message.joint,
            rmse=None if fit is None else _short(fit.rmse_m),
            nees=_short(fit.nees_per_dof) if fit and fit.nees_per_dof is not None else None,
            **extra,
        )  # fmt: skip

    def _frame(self) -> str | None:
        return None if self._map is None else self._map.frame

    def _align(self) -> None:
        found = self._truth.map_from_truth(self._map)
        motion = None if found is None else [_short(v) for v in found.tolist()]
        if motion != self._aligned.get(self._frame(), [0.0, 0.0, 0.0]):
            self._aligned[self._frame()] = motion
            self._add_frame("align", f=self._frame(), v=motion)

    def _take_status(self, message: m.Status) -> None:
        awaited = [warning for warning in message.warnings if is_awaited(warning)]
        if awaited != self._awaited.get(message.node, []):
            self._awaited[message.node] = awaited
            self._add_frame("wait", n=message.node, x=awaited)
        second = int(self._t(message.stamp_ns))
        shown = message.node == "central" or message.node.startswith("robot/")
        whole, agrees = (message.figures.get(name, 0.0) for name in _OF_A_SET)
        news = second, whole, agrees  # peers still come to agree after the streams end
        if shown and self._figures_s.get(message.node) != news:
            self._figures_s[message.node] = news
            figures = {name: _short(value) for name, value in message.figures.items()}
            self._add_frame("fig", n=message.node, t=self._t(message.stamp_ns), f=figures)


def _changes_of(message: m.FusedMap, landmarks: Landmarks) -> dict[str, object]:
    places = dict(zip(landmarks.ids.tolist(), landmarks.means.tolist(), strict=True))
    rows = []
    for each in message.changes:
        if each.state != "unchanged" and each.landmark in places:
            x, y = places[each.landmark]
            figures = each.dx, each.dy, each.sigma, each.chi2, each.expected
            row = [_short(v) for v in (x - each.dx, y - each.dy, *figures)]
            rows.append([each.landmark, each.state, *row])
    unchanged = sum(each.state == "unchanged" for each in message.changes)
    return {"unchanged": unchanged, "rows": rows}


def _short(value: float) -> float:
    return float(f"{value:.7g}")


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def sets_of(fused: m.FusedMap) -> dict[int, tuple[int, list[str]]]:
    """Number of submaps and members of each landmark, in a running map at most SHOWN.

    A member such as `r1/1/12/7` is robot, incarnation, submap, local landmark.
    """
    found: dict[int, tuple[set[tuple[str, int, int]], list[str]]] = {}
    steps = (step for table in fused.memberships for step in table.steps)
    tables = (floats(table.figures, "figures").reshape(-1, 3) for table in fused.memberships)
    figures = (row for table in tables for row in table.tolist())
    rows = zip(members_of(fused), steps, figures, strict=True)
    for ((robot, incarnation, sequence, local), identity), step, (llr, rival, sd) in rows:
        submaps, words = found.setdefault(identity, (set(), []))
        submaps.add((robot, incarnation, sequence))
        name = f"{robot}/{incarnation}/{sequence}/{local}"
        if not 0 < step < len(STEPS):
            words.append(name)
            continue
        against = f", its best rival {rival:.1f}" if rival > -1e299 else ", no rival"
        words.append(
            f"{name}: {STEPS[step]}, log-likelihood ratio {min(llr, 1e6):.1f}{against}, "
            f"sd {sd:.2f} m"
        )
    return {number: (len(submaps), words[:SHOWN]) for number, (submaps, words) in found.items()}
