"""Evaluate a run from its log, against the recorded truth."""

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np

from teamslam.central.config import UNREADABLE
from teamslam.central.desk.evaluation.association import association_result
from teamslam.central.desk.evaluation.clocks import (
    Late,
    Timed,
    lateness,
    mirrored_cause,
    separate_times_warning,
)
from teamslam.central.desk.evaluation.errors import (
    Covariance,
    MapErrors,
    Path,
    Points,
    align_paths,
    associate_truth,
    map_errors,
    moved_rmse,
    pose_errors,
    transform_points,
)
from teamslam.central.desk.evaluation.log import Collected, collect_log
from teamslam.central.desk.evaluation.matching import Gospa, gospa, half_spacing, nearest
from teamslam.central.desk.evaluation.results import (
    Consumption,
    Evaluation,
    MapResult,
    PeerResult,
    RobotResult,
)
from teamslam.central.desk.evaluation.states import robot_states, verdicts_given
from teamslam.central.desk.left_out import describe_spans, is_kept, spans_left_out
from teamslam.central.desk.names import data_set_of, in_order
from teamslam.central.diagnosis import contradicts
from teamslam.team import translate
from teamslam.team.config import UNNAMED, RobotConfig
from teamslam.team.estimation.se2 import Pose
from teamslam.team.former_names import with_current_names
from teamslam.team.pairs import PAIRS
from teamslam.team.recording.check import MOST_HOLES, Finding
from teamslam.team.recording.reader import Log
from teamslam.team.shapes import Bool, Float, Int64
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, stamps
from teamslam.team.wire.bus import Sample

UPLINK = {
    "submap": (ch.SUBMAP, ch.SIGHTING_FACTOR),
    "own/map": (ch.OWN_MAP,),
    "measurements": ch.SENSORS,
}
"""Channels of each uplink name in `PAIRS`."""


TeamMotion = tuple[Pose, str]
"""Rigid motion from map to truth, and the aligned points or paths."""


def evaluate(samples: Iterable[Sample]) -> Evaluation:
    """Evaluate one run from its samples."""
    return evaluate_collected(collect_log(samples))


def evaluate_collected(log: Collected) -> Evaluation:
    """Evaluate one run from the collected contents of its log."""
    association = association_result(log)
    robots = {robot: _robot_result(log, robot) for robot in log.robots}
    fused = None
    if log.final_map is not None:
        label_of = {} if association is None else association.label_of
        truth_from_map = _align_robots(robots.values()) if log.is_arbitrary else np.zeros(3)
        fused = _map_result(log, log.final_map, label_of, truth_from_map)
    motion = _team_motion(fused, robots.values())
    robots = {name: _aligned(robot, motion) for name, robot in robots.items()}
    end, world = log.newest(ch.END, m.End), log.newest(ch.WORLD_CONFIG, m.Configuration)
    faults = log.of_all(ch.FAULT, m.Fault)
    mirrored, late, separate_times = _examine_streams(log)
    return Evaluation(
        scenario=log.scenario,
        map=fused,
        robots=robots,
        true_landmarks=log.true_landmarks.positions,
        channels={key: log.traffic[key] for key in in_order(log.traffic)},
        notes=(
            *(() if end is None else end.notes),
            *log.disagreement,
            *_warn_of_missing(log),
            *_set_aside(faults),
            *(n for name, each in robots.items() for n in describe_spans(name, each.left_out)),
        ),
        unsound=log.unsound,
        cost_by_robot=log.figures("central", "joint_cost_per_dof."),
        faults=len(faults),
        scale_by_robot=log.figures("central", "covariance_scale."),
        arbitrary_frame=log.is_arbitrary,
        truth_from_map=None if motion is None else motion[0],
        peers=_peer_results(log),
        disagreement=log.disagreement,
        association=association,
        decisions=() if log.final_map is None else log.final_map.decisions,
        states=robot_states(log),
        verdicts=verdicts_given(log),
        data_set="" if world is None else data_set_of(world.configuration),
        gps_median_m=_gps_median(log, {name: each.smoothed_path for name, each in robots.items()}),
        separate_times=separate_times,
        mirrored=mirrored,
        lateness=late,
        recorded_ns=log.first_ns,
    )


def _examine_streams(
    log: Collected,
) -> tuple[tuple[m.Diagnosis, ...], dict[str, Late], tuple[str, ...]]:
    longest: dict[str, Timed] = {}
    spans: dict[str, tuple[int, int]] = {}
    configs = {robot: _config(log, robot) for robot, _ in log.timed}
    for (robot, _), timed in sorted(log.timed.items()):
        if robot not in longest or len(timed.ids) > len(longest[robot].ids):
            longest[robot] = timed
        span = timed.span_ns(configs[robot].clock_offset_s)
        if span is not None:
            first, last = spans.get(robot, span)
            spans[robot] = min(first, span[0]), max(last, span[1])
    of = [(robot, longest[robot], configs[robot]) for robot in in_order(longest)]
    offsets = ((robot, lateness(timed, config)) for robot, timed, config in of)
    return (
        tuple(filter(None, (mirrored_cause(*each) for each in of))),
        {robot: found for robot, found in offsets if found is not None},
        tuple(filter(None, (separate_times_warning(spans),))),
    )


def _config(log: Collected, robot: str) -> RobotConfig:
    announced = log.newest(ch.ROBOT_CONFIG, m.Configuration, robot)
    if announced is not None:
        with suppress(*UNREADABLE):
            text = with_current_names(msgspec.json.decode(announced.configuration))
            return msgspec.convert(text, RobotConfig)
    return RobotConfig(robot)


def _warn_of_missing(log: Collected) -> list[str]:
    warnings = []
    for robot in log.robots:
        figures = log.figures(ch.source_node(robot))
        lost = figures.get("messages_lost", 0.0) + figures.get("messages_dropped", 0.0)
        if lost and math.isfinite(lost):
            warnings.append(
                f"{robot}: {lost:,.0f} messages of its topics are not in its stream, beside "
                f"{figures.get('messages', 0.0):,.0f} that are; see its driver's warnings"
            )
    return warnings


def _set_aside(faults: Sequence[m.Fault]) -> list[str]:
    counts = Counter(fault.node for fault in faults)
    first = {fault.node: fault for fault in reversed(faults)}
    return [
        f"{node} set {counts[node]} messages aside; the first, {first[node].origin}, raised "
        f"{first[node].error} at {first[node].place}: {first[node].text}"
        for node in in_order(counts)
    ]


def add_holes(evaluation: Evaluation, log: Log, found: Sequence[Finding]) -> Evaluation:
    """Add notes on the first gaps of the log, and on their number."""
    lost = [f"the log is not whole, {finding}" for finding in found[:MOST_HOLES]]
    if more := len(found) - len(lost):
        lost.append(
            f"the log is not whole, {more} more finding{'s' * (more > 1)}: `teamslam log check "
            f"{log.path}` names all"
        )
    return replace(evaluation, notes=(*evaluation.notes, *lost))


def _uplink_bytes(log: Collected, robot: str) -> int | None:
    team = log.scenario
    named = None if team is None else PAIRS.get((team.estimator, team.fusion))
    if named is None:
        return None
    keys = (channel.key(robot) for channel in UPLINK[named])
    return sum(log.traffic[key].bytes for key in keys if key in log.traffic)


def _aligned(robot: RobotResult, team_motion: TeamMotion | None) -> RobotResult:
    smoothed, online = (
        [path.poses for path in associate_truth(path, robot.truth)]
        for path in (robot.smoothed_path, robot.online_path)
    )
    motion, alignment = team_motion or (_align_robots([robot]), "trajectory")
    aligned = moved_rmse(motion, *smoothed)
    return replace(
        robot,
        aligned_rmse_m=aligned,
        alignment=None if aligned is None else alignment,
        online_aligned_rmse_m=team_motion and moved_rmse(team_motion[0], *online),
    )


def _team_motion(fused: MapResult | None, robots: Iterable[RobotResult]) -> TeamMotion | None:
    if fused is None:
        return None
    if fused.errors is not None and fused.errors.truth_from_map is not None:
        return fused.errors.truth_from_map, "map"
    motion = _align_robots(robots)
    return None if motion is None else (motion, "paths")


def _align_robots(robots: Iterable[RobotResult]) -> Pose | None:
    return align_paths((robot.smoothed_path, robot.truth) for robot in robots)


LEAST = 10
GAP_NS = 1_500_000_000  # largest gap between fixes that is interpolated
SHIFTS_S = np.arange(-1.0, 1.01, 0.25)
ROUNDS = 20
NEAREST_M = 0.1  # least distance [m] in the weights 1/d

Fixes = tuple[Int64[np.ndarray, " G"], Float[np.ndarray, "G 2"]]


def _gps_median(log: Collected, paths: Mapping[str, Path]) -> float | None:
    """Median distance [m] of smoothed poses from the other sensor's positions.

    Fits one rigid motion, lever arm and time shift per team by least absolute distances.
    """
    fixes: dict[str, Fixes] = {}
    for robot in paths:
        for message in log.messages(ch.TRUTH_POSITIONS, m.TruthPositions, robot)[:1]:
            at_ns = stamps(message.stamps, "stamps").astype(np.int64)
            if len(at_ns) > 1:
                places = floats(message.positions, "positions").astype(np.float64)
                fixes[robot] = at_ns, places.reshape(-1, 2)
    medians = [_median(fixes, paths, float(shift)) for shift in SHIFTS_S]
    return min((each for each in medians if each is not None), default=None)


def _median(fixes: Mapping[str, Fixes], paths: Mapping[str, Path], shift_s: float) -> float | None:
    poses, there = [], []
    for robot, (at_ns, places) in fixes.items():
        path = paths[robot]
        shifted_ns = path.stamps_ns + round(shift_s * 1e9)
        after = np.searchsorted(at_ns, shifted_ns)
        inside = (after > 0) & (after < len(at_ns))
        after = np.clip(after, 1, len(at_ns) - 1)
        inside &= at_ns[after] - at_ns[after - 1] <= GAP_NS
        columns = [np.interp(shifted_ns[inside], at_ns, places[:, i]) for i in range(2)]
        there.append(np.column_stack(columns))
        poses.append(path.poses[inside])
    if sum(map(len, poses)) < LEAST:
        return None
    return float(np.median(distances(np.concatenate(poses), np.concatenate(there))))


def distances(
    poses: Float[np.ndarray, "n 3"], there: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """‖there − (A (t + R(θ) lever) + b)‖ after the best rigid motion (A, b) and lever.

    With A = [[u, −v], [v, u]] the model is linear in (u, v, b, A lever); then u² + v² = 1 is
    restored.
    """
    n = len(poses)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    one, none = np.ones(n), np.zeros(n)
    J = np.zeros((n, 2, 6))
    J[:, 0] = np.column_stack((poses[:, 0], -poses[:, 1], one, none, c, -s))
    J[:, 1] = np.column_stack((poses[:, 1], poses[:, 0], none, one, s, c))
    weights, found = np.ones(n), np.zeros(n)
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        A = (J * root[:, :, None]).reshape(2 * n, 6)
        solved = np.linalg.lstsq(A, (there * root).ravel(), rcond=None)[0]
        turn = solved[:2] / max(float(np.hypot(*solved[:2])), 1e-9)
        rest = there - J[:, :, :2] @ turn
        solved = np.linalg.lstsq(A[:, 2:], (rest * root).ravel(), rcond=None)[0]
        found = np.hypot(*(rest - J[:, :, 2:] @ solved).T)
        weights = 1.0 / np.maximum(found, NEAREST_M)
    return found


def _map_result(
    log: Collected, message: m.FusedMap, label_of: Mapping[int, int], truth_from_map: Pose | None
) -> MapResult:
    true = log.true_landmarks
    ids, means = translate.landmarks_of(message)
    covariance = translate.landmark_covariance_of(message)
    labels = np.array([label_of.get(i, i) for i in ids.tolist()], np.uint32)
    truth, known = true.match(labels)
    matching = None
    unnamed = np.flatnonzero((ids >= UNNAMED) & ~known)
    if not label_of and truth_from_map is not None and len(unnamed):
        free = true.positions[~np.isin(true.ids, ids)]
        found = nearest(transform_points(truth_from_map, means[unnamed]), free)
        if found is not None:
            rows, matching = found
            truth[unnamed[rows >= 0]] = free[rows[rows >= 0]]
            known[unnamed[rows >= 0]] = True
    errors = _errors(means, covariance, truth, known)
    return MapResult(
        rule=message.rule,
        digest=message.digest.hex(),
        payload_sha256=hashlib.sha256(log.latest[ch.FINAL_MAP.key()].sample.payload).hexdigest(),
        frame=message.frame,
        ids=ids,
        means=means,
        covariance=covariance,
        joint=message.joint,
        truth=truth,
        known=known,
        errors=errors,
        cost_per_dof=message.chi2 / message.dof if message.dof > 0 else None,
        reasons=message.reasons,
        diagnosis=tuple(
            _name_points(log, each)
            for each in message.diagnosis
            if not _is_refuted(each, errors, arbitrary=log.is_arbitrary)
        ),
        joined=message.joined,
        covariance_scale=message.covariance_scale or None,
        gospa=_gospa(means, errors, true.positions),
        matching=matching,
        changes=message.changes,
    )


def _name_points(log: Collected, found: m.Diagnosis) -> m.Diagnosis:
    """Add the frame of points to the remedy of a contradiction."""
    robots = in_order({robot for (robot, _), timed in log.timed.items() if timed.has_points})
    of = [robot for robot in robots if found.robot in ("", robot)]
    if not of or not contradicts(found):
        return found
    frame = f"points are in the sensor's frame (ahead, left): check those of {', '.join(of)}"
    return msgspec.structs.replace(found, remedy=f"{found.remedy}; {frame}")


def _is_refuted(found: m.Diagnosis, errors: MapErrors | None, *, arbitrary: bool) -> bool:
    """Whether the errors, in an arbitrary frame those of shape, exceed what a cause allows."""
    if found.cause != "noise_overestimated" or errors is None:
        return False
    if not arbitrary:
        return errors.nees_per_dof > 1.0
    return errors.shape is not None and errors.shape.nees_per_landmark > 2.0


def _gospa(
    means: Points, errors: MapErrors | None, positions: Float[np.ndarray, "T 2"]
) -> Gospa | None:
    cut_off_m = half_spacing(positions)
    if errors is None or errors.truth_from_map is None or not cut_off_m:
        return None
    return gospa(transform_points(errors.truth_from_map, means), positions, cut_off_m)


def _own_map(log: Collected, robot: str) -> MapErrors | None:
    message = log.newest(ch.OWN_MAP, m.MapEstimate, robot)
    if message is None:
        return None
    ids, means = translate.landmarks_of(message)
    truth, known = log.true_landmarks.match(ids)
    return _errors(means, translate.landmark_covariance_of(message), truth, known)


def _errors(
    means: Points, covariance: Covariance, truth: Points, known: Bool[np.ndarray, " n"]
) -> MapErrors | None:
    rows = np.flatnonzero(np.repeat(known, 2))
    if not known.any():
        return None
    return map_errors(means[known], covariance[np.ix_(rows, rows)], truth[known])


def _robot_result(log: Collected, robot: str) -> RobotResult:
    trajectories = log.messages(ch.TRAJECTORY, m.Trajectory, robot)
    truths = log.messages(ch.TRUTH, m.Truth, robot)
    truth, _ = _stack_paths([translate.trajectory_of(t) for t in truths], [])
    smoothed, smoothed_covariances = _stack_paths(
        [translate.trajectory_of(t) for t in trajectories],
        [floats(t.covariances, "covariances") for t in trajectories],
    )
    causes = () if log.final_map is None else log.final_map.diagnosis
    left_out = spans_left_out(causes, robot, smoothed.stamps_ns.tolist())
    kept = is_kept(smoothed.stamps_ns, left_out)
    smoothed = Path(smoothed.stamps_ns[kept], smoothed.poses[kept])
    if len(smoothed_covariances):
        smoothed_covariances = smoothed_covariances[kept]
    online_channel, estimates, outside = None, [], False
    for channel in (ch.TEAM_POSE, ch.CENTRAL_POSE, ch.OWN_POSE):
        poses = log.messages(channel, m.PoseEstimate, robot)
        estimates = [p for p in poses if log.is_in_frame(p.frame)]
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
        uplink_bytes=_uplink_bytes(log, robot),
        truth=truth,
        smoothed_path=smoothed,
        smoothed=pose_errors(smoothed, smoothed_covariances, truth),
        online_path=online,
        online=pose_errors(online, online_covariances, truth),
        online_channel=online_channel,
        own_map=_own_map(log, robot),
        outside=outside,
        left_out=left_out,
    )


def _consumption(log: Collected, robot: str) -> Consumption:
    dones = {d.incarnation: d for d in log.messages(ch.ROBOT_DONE, m.Done, robot)}
    submaps = {(s.incarnation, s.sequence): s for s in log.messages(ch.SUBMAP, m.Submap, robot)}
    ledger = Counter[str]()
    for incarnation in sorted(dones):
        for entry in dones[incarnation].ledger:
            ledger[entry.disposition] += entry.measurements
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
    """Join by stamp; the last of equal stamps counts."""
    stamps = np.concatenate([np.empty(0, np.int64), *(stamps for stamps, _ in parts)])
    poses = np.concatenate([np.empty((0, 3)), *(poses for _, poses in parts)])
    chosen = len(stamps) - 1 - np.unique(stamps[::-1], return_index=True)[1]
    flat = np.concatenate([np.empty(0), *covariances]).reshape(-1, 3, 3)
    return Path(stamps[chosen], poses[chosen]), flat[chosen] if len(flat) else flat


def _peer_results(log: Collected) -> dict[str, PeerResult]:
    found = {}
    for robot in log.robots:
        node = ch.robot_node(robot)
        figures = log.figures(node)
        if "set_submaps" not in figures:
            continue
        latest = log.latest.get(ch.CONCLUDED.key(robot))
        concluded = log.newest(ch.CONCLUDED, m.Concluded, robot)
        wall_ns = 0 if latest is None else latest.sample.wall_ns
        at_ns = wall_ns - (log.first_ns or wall_ns)
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
