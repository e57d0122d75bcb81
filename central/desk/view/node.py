"""Viewer node: messages in, views out."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.central.desk.drawing import colour_of
from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.central.desk.evaluation.events import Event, EventDetector
from teamslam.central.desk.evaluation.running import (
    DisplayedPoses,
    Estimate,
    TruthAlignment,
    TruthFrames,
)
from teamslam.central.desk.names import in_order
from teamslam.central.desk.view import foxglove_scene as fox
from teamslam.central.desk.view.drawn import Landmarks, Track, centre_particles, landmarks_of
from teamslam.team.estimation.se2 import Pose, compose
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch, messages as m, views
from teamslam.team.wire.arrays import floats
from teamslam.team.wire.channels import Channel

PERIOD_NS = 1_000_000_000  # team time between views of poses and errors
PATHS_EVERY = 10  # number of views per whole path
TRAIL_NS = 15_000_000_000  # length of the recent path sent with a robot
LAG_NS = 30_000_000_000  # a robot further behind the fastest does not hold back the view
MOST_PERIODS = 60  # most views per message
FORGET_NS = 10_000_000_000  # time for which an estimate waits for its truth
_MARKS_ACROSS = 45.0  # drawn robots that fit across the known extent
Motion = Pose | None


class Shown(NamedTuple):
    """View to be published: relative key, team time, payload."""

    key: str
    stamp_ns: int
    payload: bytes


@dataclass
class _Robot(DisplayedPoses):
    """One robot.

    coming: estimates after the view's time. at_ends: the smoothed poses are at the ends of submaps.
    """

    coming: deque[m.PoseEstimate] = field(default_factory=deque)
    reached_ns: int | None = None
    estimate: Estimate | None = None
    last_error: tuple[Pose, float] | None = None
    track: Track = field(default_factory=Track)
    true_track: Track = field(default_factory=Track)
    smoothed: list[tuple[float, float]] = field(default_factory=list)
    at_ends: bool = False
    cloud: m.ParticleCloud | None = None
    lost: bool = False
    done: bool = False
    status: dict[str, float] = field(default_factory=dict)

    def reach(self, stamp_ns: int) -> None:
        self.reached_ns = stamp_ns if self.reached_ns is None else max(self.reached_ns, stamp_ns)

    def leave(self) -> None:
        self.coming.clear()
        self.estimate = self.last_error = None
        self.track = Track()
        self.errors.forget_poses()

    def go_to(self, now_ns: int, frames: TruthFrames) -> None:
        while self.coming and self.coming[0].stamp_ns <= now_ns:
            self.estimate = Estimate.of(self.coming.popleft())
            x, y, _ = self.estimate.pose.tolist()
            self.track.take(self.estimate.stamp_ns, x, y)
            if frames.has(self.estimate.frame):
                self.errors.take_pose(self.estimate)
        if (known := self.errors.known()) is not None:
            self.last_error = known.errors[-1], float(known.nees[-1]) / 3.0
        true = self.errors.truth_at(now_ns)
        if true is not None:
            self.true_track.take(now_ns, float(true[0]), float(true[1]))
        self.errors.forget(now_ns - FORGET_NS)


class ViewerNode:
    """Viewer of a team: `handle` until `finished`.

    View time is that of the slowest active robot, at most LAG_NS behind the fastest.
    """

    listens = (
        ch.START, ch.TRUTH, ch.TRUTH_LANDMARKS, ch.OWN_POSE, ch.TEAM_POSE, ch.PARTICLES,
        ch.ROBOT_DONE, ch.FUSED_MAP, ch.FINAL_MAP, ch.TRAJECTORY, ch.WITHDRAWAL, ch.END,
        ch.STATUS,
    )  # fmt: skip

    def __init__(self) -> None:
        self._robots: dict[str, _Robot] = {}
        self._maps: deque[m.FusedMap] = deque()
        self._landmarks: Landmarks | None = None
        self._truth = TruthAlignment()
        self._has_map = False
        self._fused: m.FusedMap | None = None
        self._map_is_new = False
        self._status: dict[str, float] = {}
        self._detector = EventDetector()
        self._now_ns: int | None = None
        self._turn = 0
        self._low, self._high = np.full(2, math.inf), np.full(2, -math.inf)
        self.finished = False

    @property
    def now_ns(self) -> int:
        """Team time of the last view, or 0."""
        return 0 if self._now_ns is None else self._now_ns

    def handle(self, channel: Channel, message: m.Message) -> list[Shown]:
        """Process a message of a channel; return the due views."""
        out = [_log_line(event) for event in self._detector.take(message, self.now_ns)]
        self._take(channel, message)
        reached = self._reached_ns()
        if reached is None:
            return out
        begin = reached if self._now_ns is None else self._now_ns + PERIOD_NS
        begin = max(begin, reached - MOST_PERIODS * PERIOD_NS)
        for now_ns in range(begin, reached + 1, PERIOD_NS):
            out += self._views(now_ns)
        if channel is ch.FINAL_MAP and not self.finished:
            self.finished = True
            newest = (r.reached_ns for r in self._robots.values() if r.reached_ns is not None)
            out += self._views(max(newest), last=True)
        return out

    def _reached_ns(self) -> int | None:
        there = [(r, r.reached_ns) for r in self._robots.values() if r.reached_ns is not None]
        if not there:
            return None
        newest = max(at for _, at in there)
        at_work = (at for robot, at in there if not (robot.lost or robot.done))
        return max(min(at_work, default=newest), newest - LAG_NS)

    def _take(self, channel: Channel, message: m.Message) -> None:
        self._truth.take(message)
        match message:
            case m.PoseEstimate():
                self._take_pose(message, by_team=channel is ch.TEAM_POSE)
            case m.Truth():
                self._of(message.robot).errors.take_truth(message)
            case m.TruthLandmarks():
                self._extend(self._truth.landmarks.positions)
                self._map_is_new = True
            case m.FusedMap():
                self._maps.append(message)
                self._has_map = bool(message.ids)
            case m.ParticleCloud():
                self._of(message.robot).cloud = message
            case m.Trajectory():
                poses = floats(message.poses, "poses").reshape(-1, 3)
                robot = self._of(message.robot)
                robot.smoothed = [(x, y) for x, y, _ in poses.tolist()]
                robot.at_ends = bool(message.crosses)
            case m.Done():
                self._of(message.robot).done = True
            case m.Status():
                self._take_status(message)
            case m.Liveliness() if message.node.startswith("robot/"):
                self._of(message.node.removeprefix("robot/")).lost = not message.alive

    def _in_order(self) -> list[tuple[str, _Robot]]:
        return [(name, self._robots[name]) for name in in_order(self._robots)]

    def _of(self, robot: str) -> _Robot:
        return self._robots.setdefault(robot, _Robot())

    def _take_pose(self, message: m.PoseEstimate, *, by_team: bool) -> None:
        robot = self._of(message.robot)
        before = robot.by_team
        is_displayed = robot.has(message, by_team=by_team)
        if by_team and not message.in_team_frame:
            robot.leave()
        elif robot.by_team and not before:
            robot.coming = deque(p for p in robot.coming if p.stamp_ns < message.stamp_ns)
        if is_displayed:
            if message.in_team_frame or not self._has_map:
                robot.coming.append(message)
            elif robot.estimate is not None or robot.coming:
                robot.leave()
            robot.reach(message.stamp_ns)

    def _take_status(self, message: m.Status) -> None:
        if message.node == "central":
            self._status = message.figures
        elif message.node.startswith("robot/"):
            robot = self._of(message.node.removeprefix("robot/"))
            robot.status = message.figures
            if robot.reached_ns is not None:  # a robot without detections publishes only this
                robot.reach(message.stamp_ns)

    def _extend(self, points: Float[np.ndarray, "n 2"]) -> None:
        self._low = np.minimum(self._low, points.min(axis=0, initial=math.inf))
        self._high = np.maximum(self._high, points.max(axis=0, initial=-math.inf))

    def _size_m(self) -> float:
        """Drawn size of a robot: 1, 2 or 5 times a power of ten."""
        across = float((self._high - self._low).max()) / _MARKS_ACROSS
        if not 0.0 < across < math.inf:
            return 1.0
        power = 10.0 ** math.floor(math.log10(across))
        return power * next((step for step in (5.0, 2.0) if across >= step * power), 1.0)

    def _views(self, now_ns: int, *, last: bool = False) -> list[Shown]:
        self._go_to(now_ns, last=last)
        found = [Shown(key, now_ns, payload) for key, payload in self._payloads(now_ns, last=last)]
        self._turn += 1
        return found

    def _payloads(self, now_ns: int, *, last: bool) -> Iterator[tuple[str, bytes]]:
        size = self._size_m()
        motion = self._truth.map_from_truth(self._fused)
        seen = [(n, r, r.estimate) for n, r in self._in_order() if r.estimate is not None]
        if self._map_is_new:
            self._map_is_new = False
            yield from self._map_payloads(now_ns, size, motion)
        yield views.ROBOTS.key(), self._scene(now_ns, size, motion)
        poses = [(name, estimate.pose) for name, _, estimate in seen]
        yield views.TRANSFORMS.key(), fox.transforms(now_ns, poses)
        for name, robot, estimate in seen:
            yield views.POSE.key(name), fox.pose_in_map(now_ns, estimate.pose)
            yield views.ROBOT.key(name), msgspec.json.encode(_figures(robot, estimate, now_ns))
        for name, robot, estimate in seen:
            if robot.cloud is not None:
                points = transform_points(estimate.pose, centre_particles(robot.cloud))
                weights = floats(robot.cloud.weights, "weights").astype(np.float64)
                yield views.PARTICLES.key(name), fox.cloud(now_ns, points, weights, "weight")
                robot.cloud = None
        yield views.TEAM.key(), msgspec.json.encode(self._team(now_ns))
        if last or self._turn % PATHS_EVERY == 0:
            yield views.PATHS.key(), self._paths(now_ns, size, motion)

    def _go_to(self, now_ns: int, *, last: bool) -> None:
        self._now_ns = now_ns
        while self._maps and (last or self._maps[0].stamp_ns <= now_ns):
            self._fused = self._maps.popleft()
            self._landmarks = landmarks_of(self._fused)
            self._extend(self._landmarks.means)
            self._map_is_new = True
        for robot in self._robots.values():
            robot.go_to(now_ns, self._truth.frames)
            if robot.estimate is not None:
                self._extend(robot.estimate.pose[np.newaxis, :2])

    def _map_payloads(
        self, now_ns: int, size_m: float, motion: Motion
    ) -> Iterator[tuple[str, bytes]]:
        entities = []
        if len(self._truth.landmarks.ids) and motion is not None:
            true = transform_points(motion, self._truth.landmarks.positions)
            entities.append(fox.true_landmarks_entity(now_ns, true, size_m))
        if self._landmarks is not None:
            entities.append(fox.landmarks_entity(now_ns, self._landmarks, size_m))
            names = self._landmarks.ids.astype(np.float64)
            points = fox.cloud(now_ns, self._landmarks.means, names, "id")
            yield views.LANDMARKS.key(), points
        yield views.MAP.key(), fox.scene(entities)

    def _scene(self, now_ns: int, size_m: float, motion: Motion) -> bytes:
        entities = []
        for number, (name, robot) in enumerate(self._in_order()):
            true = robot.errors.truth_at(now_ns)
            if true is not None and motion is not None:
                true = compose(motion, true)
                entities.append(fox.true_robot_entity(now_ns, name, true, size_m))
            if robot.estimate is not None:
                trail = robot.track.since(now_ns - TRAIL_NS)
                entities.append(
                    fox.robot_entity(
                        now_ns, name, robot.estimate.pose, robot.estimate.covariance, trail,
                        colour_of(number), size_m, lost=robot.lost,
                    )
                )  # fmt: skip
        return fox.scene(entities)

    def _paths(self, now_ns: int, size_m: float, motion: Motion) -> bytes:
        entities = []
        for number, (name, robot) in enumerate(self._in_order()):
            colour = colour_of(number)
            true = np.array(robot.true_track.points).reshape(-1, 2)
            true = true[:0] if motion is None else transform_points(motion, true)
            lines = [
                ("true path", [(x, y) for x, y in true.tolist()], (fox.TRUTH[0], 0.5), 1.0),
                ("path", robot.track.points, (colour, 0.5), 1.5),
                ("smoothed path", [] if robot.at_ends else robot.smoothed, (colour, 1.0), 2.5),
            ]
            entities += [
                fox.path_entity(now_ns, f"{what} {name}", points, shade, pixels)
                for what, points, shade, pixels in lines
                if len(points) > 1
            ]
            if robot.at_ends:
                dots = robot.smoothed, (colour, 1.0), size_m
                entities.append(fox.dots_entity(now_ns, f"smoothed poses {name}", *dots))
        return fox.scene(entities)

    def _team(self, now_ns: int) -> views.TeamFigures:
        fit = None if self._fused is None else self._truth.fit(self._fused)
        return views.TeamFigures(
            now_ns * 1e-9,
            0 if self._landmarks is None else len(self._landmarks.ids),
            sum(not robot.lost for robot in self._robots.values()),
            msgspec.UNSET if fit is None else fit.rmse_m,
            msgspec.UNSET if fit is None or fit.nees_per_dof is None else fit.nees_per_dof,
            self._status,
        )


def _log_line(event: Event) -> Shown:
    warns = event.kind in ("lost", "refused", "warning", "withdrawn")
    line = fox.log_line(event.stamp_ns, event.node, event.text, warns=warns)
    return Shown(views.LOG.key(), event.stamp_ns, line)


def _figures(robot: _Robot, estimate: Estimate, now_ns: int) -> views.RobotFigures:
    x, y, heading = estimate.pose.tolist()
    to_x, to_y, to_heading = (3.0 * np.sqrt(np.diagonal(estimate.covariance))).tolist()
    figures = views.RobotFigures(
        now_ns * 1e-9, x, y, heading, to_x, to_y, to_heading, status=robot.status
    )
    if robot.last_error is None:
        return figures
    errors, nees = robot.last_error
    names = "error_x_m", "error_y_m", "error_heading_rad"
    named = dict(zip(names, errors.tolist(), strict=True))
    return msgspec.structs.replace(figures, **named, nees_per_dof=nees)
