"""One robot in a log: poses, truth, dispositions."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from teamslam.central.desk.evaluation.errors import MapErrors, Path, pose_errors
from teamslam.central.desk.evaluation.log import Collected
from teamslam.central.desk.evaluation.results import Consumption, PeerResult, RobotResult
from teamslam.team import translate
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats


def robot_result(
    log: Collected,
    robot: str,
    uplink_bytes: int | None,
    own_map: MapErrors | None,
    is_in_frame: Callable[[str], bool],
) -> RobotResult:
    """Evaluate one robot, unaligned; is_in_frame: whether a named frame is evaluated."""
    trajectories = log.messages(ch.TRAJECTORY, m.Trajectory, robot)
    truths = log.messages(ch.TRUTH, m.Truth, robot)
    truth, _ = _stack_paths([translate.trajectory_of(t) for t in truths], [])
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
            of = channel.template.removeprefix("robot/{robot}/").removesuffix("/{robot}")
            online_channel, outside = of, False
            break
    online, online_covariances = _stack_paths(
        [(np.array([p.stamp_ns]), floats(p.pose, "pose").reshape(1, 3)) for p in estimates],
        [floats(p.covariance, "covariance") for p in estimates],
    )
    return RobotResult(
        consumption=_consumption(log, robot),
        uplink_bytes=uplink_bytes,
        truth=truth,
        smoothed_path=smoothed,
        smoothed=pose_errors(smoothed, smoothed_covariances, truth),
        online_path=online,
        online=pose_errors(online, online_covariances, truth),
        online_channel=online_channel,
        own_map=own_map,
        outside=outside,
    )


def _consumption(log: Collected, robot: str) -> Consumption:
    dones = {d.incarnation: d for d in log.messages(ch.ROBOT_DONE, m.Done, robot)}
    submaps = {(s.incarnation, s.sequence): s for s in log.messages(ch.SUBMAP, m.Submap, robot)}
    ledger: dict[str, int] = {}
    for incarnation in sorted(dones):
        for entry in dones[incarnation].ledger:
            ledger[entry.disposition] = ledger.get(entry.disposition, 0) + entry.measurements
    measurements = log.measurements.get(robot, {})
    consumed = sum(d.measurements for d in dones.values()) if dones else None
    are_disjoint = all(
        a.incarnation != b.incarnation or a.last_measurement < b.first_measurement
        for a, b in pairwise(submaps[name] for name in sorted(submaps))
    )
    return Consumption(
        steps=sum(measurements.values()),
        published=len(measurements),
        consumed=consumed,
        submaps=len(submaps),
        ledger=ledger,
        each_once=None if consumed is None else are_disjoint and sum(ledger.values()) == consumed,
        gated=sum(submap.gated for submap in submaps.values()),
    )


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


def peer_results(log: Collected) -> dict[str, PeerResult]:
    """Result of every robot with a copy of the set."""
    found = {}
    for robot in log.robots:
        node = ch.robot_node(robot)
        figures = log.figures(node)
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
            have={name: int(n) for name, n in log.figures(node, "set_submaps.").items()},
            over={name: int(n) for name, n in log.figures(node, "set_over.").items()},
        )
    return found
