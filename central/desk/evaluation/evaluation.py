"""Evaluate a run from its log, against the recorded truth."""

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.central.desk.evaluation.association import association_result
from teamslam.central.desk.evaluation.clocks import (
    Late,
    Timed,
    lateness,
    separate_times_warning,
)
from teamslam.central.desk.evaluation.errors import (
    MapErrors,
    Path,
    distance_rmse,
    interpolate_truth,
    pose_errors,
    rigid_alignment,
    transform_points,
)
from teamslam.central.desk.evaluation.gps import gps_median
from teamslam.central.desk.evaluation.log import Collected, collect_log
from teamslam.central.desk.evaluation.map_result import map_result, own_map
from teamslam.central.desk.evaluation.mirrored import mirrored_cause
from teamslam.central.desk.evaluation.peers import peer_results
from teamslam.central.desk.evaluation.results import Evaluation, MapResult, RobotResult
from teamslam.central.desk.evaluation.robot import Consumption, RobotLog, consumption, robot_log
from teamslam.central.desk.evaluation.running import TrueLandmarks, TruthFrames
from teamslam.central.desk.evaluation.states import robot_states
from teamslam.central.desk.evaluation.verdicts import verdicts_given
from teamslam.central.desk.names import data_set_name, in_order
from teamslam.central.team_config import TeamConfig, team_config
from teamslam.team import translate
from teamslam.team.config import SURVEY_FRAME, RobotConfig
from teamslam.team.former_names import with_current_names
from teamslam.team.pairs import PAIRS
from teamslam.team.recording.check import holes
from teamslam.team.recording.reader import Log
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample

UPLINK = {
    "submap": (ch.SUBMAP, ch.SIGHTING_FACTOR),
    "own/map": (ch.OWN_MAP,),
    "measurements": ch.SENSORS,
}
"""Channels of each uplink name in `PAIRS`."""


TeamMotion = tuple[Float[np.ndarray, "3"], str]
"""Rigid motion from map to truth, and the aligned points or paths."""


def evaluate(samples: Iterable[Sample]) -> Evaluation:
    """Evaluate one run from its samples in log order."""
    log = collect_log(samples)
    scenario = _scenario(log)
    truth = log.newest(ch.TRUTH_LANDMARKS, m.TruthLandmarks)
    true = TrueLandmarks() if truth is None else TrueLandmarks.of(truth)
    association = association_result(log)
    label_of = {} if association is None else association.label_of
    message = log.newest(ch.FINAL_MAP, m.FusedMap)
    frames = _frames(log)
    arbitrary = _is_arbitrary(frames, message)

    def is_in_frame(frame: str) -> bool:
        if not arbitrary:
            return frames.has(frame)
        return message is None or not message.ids or frame in {"", message.frame}

    logs = {robot: robot_log(log, robot, is_in_frame) for robot in log.robots}
    truth_from_map = _motion(logs.values()) if arbitrary else np.zeros(3)
    fused = None
    if message is not None:
        fused = map_result(log, message, true, label_of, truth_from_map)
    motion = _team_motion(fused, logs.values())
    robots = {
        robot: _robot_result(
            logs[robot],
            consumption(log, robot),
            _uplink_bytes(log, scenario, robot),
            motion,
            own_map(log, robot, true),
        )
        for robot in log.robots
    }
    end = log.newest(ch.END, m.End)
    faults = log.of_all(ch.FAULT, m.Fault)
    streams = _streams(log)
    return Evaluation(
        scenario=scenario,
        map=fused,
        robots=robots,
        true_landmarks=true.positions,
        channels={key: log.traffic[key] for key in in_order(log.traffic)},
        notes=(
            *(() if end is None else end.notes),
            *log.disagreement,
            *_warn_of_missing(log),
            *_set_aside(faults),
        ),
        unsound=log.unsound,
        cost_by_robot=_by_robot(log, "joint_cost_per_dof."),
        faults=len(faults),
        scale_by_robot=_by_robot(log, "covariance_scale."),
        arbitrary_frame=arbitrary,
        truth_from_map=None if motion is None else motion[0],
        peers=peer_results(log),
        disagreement=log.disagreement,
        association=association,
        decisions=() if message is None else message.decisions,
        states=robot_states(
            log, message, () if scenario is None else [each.id for each in scenario.robots]
        ),
        verdicts=verdicts_given(log),
        data_set=_data_set(log),
        gps_median_m=gps_median(log, {name: each.smoothed_path for name, each in robots.items()}),
        separate_times=streams.separate_times,
        mirrored=streams.mirrored,
        lateness=streams.lateness,
        recorded_ns=log.first_ns,
    )


class _Streams(NamedTuple):
    """Findings in the measurements alone."""

    mirrored: tuple[m.Diagnosis, ...]
    lateness: Mapping[str, Late]
    separate_times: tuple[str, ...]


def _streams(log: Collected) -> _Streams:
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
    return _Streams(
        tuple(filter(None, (mirrored_cause(*each) for each in of))),
        {robot: found for robot, found in offsets if found is not None},
        tuple(filter(None, (separate_times_warning(spans),))),
    )


def _config(log: Collected, robot: str) -> RobotConfig:
    announced = log.newest(ch.ROBOT_CONFIG, m.Configuration, robot)
    if announced is not None:
        with suppress(msgspec.MsgspecError):
            text = with_current_names(msgspec.json.decode(announced.configuration))
            return msgspec.convert(text, RobotConfig)
    return RobotConfig(robot)


def _frames(log: Collected) -> TruthFrames:
    frames = TruthFrames()
    for start in log.of_all(ch.START, m.InitialPose):
        frames.take(start)
    return frames


def _is_arbitrary(frames: TruthFrames, fused: m.FusedMap | None) -> bool:
    if fused is None or not fused.members:
        return frames.none_is_known
    if fused.frame == SURVEY_FRAME:
        return False
    return not any(frames.has(translate.frame_name(x.robot, x.incarnation)) for x in fused.members)


def _warn_of_missing(log: Collected) -> list[str]:
    warnings = []
    for robot in log.robots:
        status = log.newest(ch.STATUS, m.Status, ch.source_node(robot))
        figures = {} if status is None else status.figures
        lost = figures.get("messages_lost", 0.0) + figures.get("messages_dropped", 0.0)
        if lost and math.isfinite(lost):
            warnings.append(
                f"{robot}: {lost:,.0f} messages of its topics are not in its stream, beside "
                f"{figures.get('messages', 0.0):,.0f} that are; see its driver's warnings"
            )
    return warnings


def _set_aside(faults: Sequence[m.Fault]) -> list[str]:
    by_node: dict[str, list[m.Fault]] = {}
    for fault in faults:
        by_node.setdefault(fault.node, []).append(fault)
    return [
        f"{node} set {len(found)} messages aside; the first, {found[0].origin}, raised "
        f"{found[0].error} at {found[0].place}: {found[0].text}"
        for node, found in ((node, by_node[node]) for node in in_order(by_node))
    ]


def _by_robot(log: Collected, name: str) -> dict[str, float]:
    status = log.newest(ch.STATUS, m.Status, "central")
    if status is None:
        return {}
    return {k.removeprefix(name): v for k, v in status.figures.items() if k.startswith(name)}


def add_holes(evaluation: Evaluation, log: Log) -> Evaluation:
    """Add a note for every gap of the log."""
    lost = tuple(f"the log is not whole, {finding}" for finding in holes(log))
    return replace(evaluation, notes=(*evaluation.notes, *lost))


def _scenario(log: Collected) -> TeamConfig | None:
    message = log.newest(ch.WORLD_CONFIG, m.Configuration)
    if message is None:
        return None
    try:
        return team_config(message.configuration)
    except ValueError:
        return None


class _Place(msgspec.Struct):
    path: str = ""


class _World(msgspec.Struct):
    world: _Place


def _data_set(log: Collected) -> str:
    message = log.newest(ch.WORLD_CONFIG, m.Configuration)
    if message is None:
        return ""
    try:
        return data_set_name(msgspec.json.decode(message.configuration, type=_World).world.path)
    except (msgspec.MsgspecError, UnicodeEncodeError):
        return ""


def _uplink_bytes(log: Collected, team: TeamConfig | None, robot: str) -> int | None:
    """Bytes of the channels that the team's rule consumes; None for an invalid pair."""
    named = None if team is None else PAIRS.get((team.estimator, team.fusion))
    if named is None:
        return None
    keys = (channel.key(robot) for channel in UPLINK[named])
    return sum(log.traffic[key].bytes for key in keys if key in log.traffic)


def _robot_result(
    log: RobotLog,
    used: Consumption,
    uplink_bytes: int | None,
    team_motion: TeamMotion | None,
    own_map: MapErrors | None,
) -> RobotResult:
    smoothed = pose_errors(log.smoothed, log.smoothed_covariances, log.truth)
    ends_known = smoothed is not None and smoothed.stamps_ns[-1] == log.smoothed.stamps_ns[-1]
    motion, alignment = team_motion or (_motion([log]), "trajectory")
    aligned = None if motion is None else _moved_rmse(motion, log.smoothed, log.truth)
    return RobotResult(
        consumption=used,
        uplink_bytes=uplink_bytes,
        truth=log.truth,
        smoothed_path=log.smoothed,
        smoothed=smoothed,
        online_path=log.online,
        online=pose_errors(log.online, log.online_covariances, log.truth),
        online_channel=log.online_channel,
        final_pose_nees_per_dof=float(smoothed.nees[-1]) / 3.0
        if smoothed is not None and ends_known
        else None,
        aligned_rmse_m=aligned,
        alignment=None if aligned is None else alignment,
        online_aligned_rmse_m=None
        if team_motion is None
        else _moved_rmse(team_motion[0], log.online, log.truth),
        own_map=own_map,
        outside=log.outside,
    )


def _moved_rmse(motion: Float[np.ndarray, "3"], path: Path, truth: Path) -> float | None:
    true_poses, known = interpolate_truth(truth, path.stamps_ns)
    if not known.any():
        return None
    return distance_rmse(transform_points(motion, path.poses[known, :2]), true_poses[known, :2])


def _team_motion(fused: MapResult | None, logs: Iterable[RobotLog]) -> TeamMotion | None:
    if fused is None:
        return None
    if fused.errors is not None and fused.errors.truth_from_map is not None:
        return fused.errors.truth_from_map, "map"
    motion = _motion(logs)
    return None if motion is None else (motion, "paths")


def _motion(logs: Iterable[RobotLog]) -> Float[np.ndarray, "3"] | None:
    true_places, places = [np.empty((0, 2))], [np.empty((0, 2))]
    for log in logs:
        truth, known = interpolate_truth(log.truth, log.smoothed.stamps_ns)
        true_places.append(truth[known, :2])
        places.append(log.smoothed.poses[known, :2])
    return rigid_alignment(np.concatenate(true_places), np.concatenate(places))
