"""One robot in a log: poses, truth, dispositions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from teamslam.central.desk.evaluation.errors import Path
from teamslam.central.desk.evaluation.log import Collected
from teamslam.team import translate
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats

REJECTED = "rejected: "
"""Prefix of a rejected measurement's disposition."""


@dataclass(frozen=True)
class RobotLog:
    """A robot's paths with covariances, and truth; each may be empty.

    online_channel: "team/pose", "central/pose", "own/pose", or None. outside: no pose is in the
    evaluated frame.
    """

    truth: Path
    smoothed: Path
    smoothed_covariances: Float[np.ndarray, "K 3 3"]
    online: Path
    online_covariances: Float[np.ndarray, "O 3 3"]
    online_channel: str | None
    outside: bool = False


@dataclass(frozen=True)
class Consumption:
    """Measurements on a robot's sensor channels, and their dispositions.

    steps: odometry intervals. published: distinct measurements. consumed, ledger: from the robot's
    `Done`. each_once: no measurement is in two submaps, and the ledger sums to consumed. gated:
    detections that windows rejected as outliers.
    """

    steps: int
    published: int
    consumed: int | None
    submaps: int
    ledger: Mapping[str, int]
    each_once: bool | None
    gated: int = 0

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected measurements by reason, most frequent first."""
        found = [
            (count, disposition.removeprefix(REJECTED))
            for disposition, count in self.ledger.items()
            if disposition.startswith(REJECTED) and count
        ]
        return {reason: count for count, reason in sorted(found, key=lambda each: -each[0])}

    @property
    def used(self) -> int | None:
        """Number of measurements in the map, or used as initial pose."""
        if not self.ledger:
            return None
        return sum(self.ledger.values()) - sum(self.rejected.values())

    @property
    def open(self) -> int | None:
        """Number of published measurements neither used nor rejected."""
        return None if self.consumed is None else self.published - self.consumed

    @property
    def not_used(self) -> str:
        """Describe rejected and open measurements with reasons."""
        parts = [f"{count} rejected ({reason})" for reason, count in self.rejected.items()]
        return ", ".join([*parts, f"{self.open} open"] if self.open else parts)


def robot_log(log: Collected, robot: str, is_in_frame: Callable[[str], bool]) -> RobotLog:
    """Collect one robot's paths; is_in_frame: whether a named frame is evaluated."""
    trajectories = log.messages(ch.TRAJECTORY, m.Trajectory, robot)
    truths = log.messages(ch.TRUTH, m.Truth, robot)
    smoothed, smoothed_covariances = _stack_paths(
        [translate.trajectory_of(t) for t in trajectories],
        [floats(t.covariances, "covariances") for t in trajectories],
    )
    online_channel, estimates, outside = None, [], False
    for channel in (ch.TEAM_POSE, ch.CENTRAL_POSE, ch.OWN_POSE):
        poses = log.messages(channel, m.PoseEstimate, robot)
        estimates = [p for p in poses if is_in_frame(p.frame)]
        outside = outside or bool(poses)
        if estimates:
            online_channel, outside = channel, False
            break
    online, online_covariances = _stack_paths(
        [(np.array([p.stamp_ns]), floats(p.pose, "pose").reshape(1, 3)) for p in estimates],
        [floats(p.covariance, "covariance") for p in estimates],
    )
    return RobotLog(
        _stack_paths([translate.trajectory_of(t) for t in truths], [])[0],
        smoothed,
        smoothed_covariances,
        online,
        online_covariances,
        None if online_channel is None else _short(online_channel),
        outside,
    )


def consumption(log: Collected, robot: str) -> Consumption:
    """Count one robot's measurements by disposition."""
    dones = {d.incarnation: d for d in log.messages(ch.ROBOT_DONE, m.Done, robot)}
    submaps = {(s.incarnation, s.sequence): s for s in log.messages(ch.SUBMAP, m.Submap, robot)}
    ledger: dict[str, int] = {}
    for incarnation in sorted(dones):
        for entry in dones[incarnation].ledger:
            ledger[entry.disposition] = ledger.get(entry.disposition, 0) + entry.measurements
    measurements = log.measurements.get(robot)
    consumed = sum(d.measurements for d in dones.values()) if dones else None
    return Consumption(
        0 if measurements is None else len(measurements.odometry),
        0 if measurements is None else len(measurements.all),
        consumed,
        len(submaps),
        ledger,
        None
        if consumed is None
        else sum(ledger.values()) == consumed
        and _disjoint([submaps[name] for name in sorted(submaps)]),
        sum(submap.gated for submap in submaps.values()),
    )


def _disjoint(submaps: Sequence[m.Submap]) -> bool:
    return all(
        a.incarnation != b.incarnation or a.last_measurement < b.first_measurement
        for a, b in pairwise(submaps)
    )


def _short(channel: ch.Channel) -> str:
    return channel.template.removeprefix("robot/{robot}/").removesuffix("/{robot}")


def _stack_paths(
    parts: Sequence[tuple[np.ndarray, np.ndarray]], covariances: Sequence[np.ndarray]
) -> tuple[Path, Float[np.ndarray, "K 3 3"]]:
    stamps = np.concatenate([np.empty(0, np.int64), *(stamps for stamps, _ in parts)])
    poses = np.concatenate([np.empty((0, 3)), *(poses for _, poses in parts)])
    order = np.argsort(stamps, kind="stable")
    last = np.flatnonzero(np.append(np.diff(stamps[order]) != 0, [True] * (len(stamps) > 0)))
    chosen = order[last]
    flat = np.concatenate([np.empty(0), *covariances]).reshape(-1, 3, 3)
    return Path(stamps[chosen], poses[chosen]), flat[chosen] if len(flat) else flat


_OF, _OVER, _OVER_BYTES = "set_submaps.", "set_over.", "set_over_bytes."


@dataclass(frozen=True, kw_only=True)
class PeerResult:
    """Announced conclusion of one peer.

    complete_at_s: wall time from log start to its final map. have: submaps by robot. over: new
    members by relaying node. agrees_with: number of peers with the same set.
    """

    final_map_sha256: str | None
    submaps: int
    complete_at_s: float | None
    uplink_bytes: int | None
    downlink_bytes: int | None
    agrees_with: int
    have: Mapping[str, int] = field(default_factory=dict)
    over: Mapping[str, int] = field(default_factory=dict)


def peer_results(log: Collected) -> dict[str, PeerResult]:
    """Result of every robot with a copy of the set."""
    found = {}
    for robot in log.robots:
        status = log.newest(ch.STATUS, m.Status, ch.robot_node(robot))
        figures = {} if status is None else status.figures
        if "set_submaps" not in figures:
            continue
        sample = log.latest.get(ch.CONCLUDED.key(robot))
        concluded = log.newest(ch.CONCLUDED, m.Concluded, robot)
        at_ns = 0 if sample is None else sample.wall_ns - (log.first_ns or sample.wall_ns)
        found[robot] = PeerResult(
            final_map_sha256=None if concluded is None else concluded.sha256.hex(),
            submaps=int(figures["set_submaps"]) if concluded is None else concluded.submaps,
            complete_at_s=None if concluded is None else at_ns * 1e-9,
            uplink_bytes=int(figures.get("set_uplink_bytes", 0.0)),
            downlink_bytes=int(figures.get("set_downlink_bytes", 0.0)),
            agrees_with=int(figures.get("set_agrees", 0.0)),
            have=_named(figures, _OF),
            over=_named(figures, _OVER),
        )
    return found


def _named(figures: Mapping[str, float], prefix: str) -> dict[str, int]:
    return {
        name.removeprefix(prefix): int(value)
        for name, value in figures.items()
        if name.startswith(prefix)
    }
