"""Evaluate a run from its log: every figure, against the recorded truth.

A figure without its inputs is None. Metres and radians; NEES per degree of freedom, 1 if the
covariance is right.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from teamslam.central.desk.evaluation.association import (
    AssociationResult,
    association_json,
    association_result,
)
from teamslam.central.desk.evaluation.causes import absent_robots, warning_objects
from teamslam.central.desk.evaluation.clocks import Timed, clock_warning, separate_times_warning
from teamslam.central.desk.evaluation.errors import (
    MapErrors,
    Path,
    PoseErrors,
    distance_rmse,
    interpolate_truth,
    map_errors,
    pose_errors,
    rigid_alignment,
    transform_points,
)
from teamslam.central.desk.evaluation.gps import gps_median
from teamslam.central.desk.evaluation.log import Collected, Traffic, collect_log
from teamslam.central.desk.evaluation.matching import Gospa, Matching, gospa, half_spacing, nearest
from teamslam.central.desk.evaluation.peers import PeerResult, peer_json, peer_results
from teamslam.central.desk.evaluation.robot import Consumption, RobotLog, consumption, robot_log
from teamslam.central.desk.evaluation.running import TruthFrames
from teamslam.central.desk.evaluation.states import RobotState, not_in_the_map, robot_states
from teamslam.central.desk.evaluation.verdicts import verdicts_given
from teamslam.central.desk.names import data_set_name, in_order, not_joined, short
from teamslam.central.diagnosis import describe, to_object
from teamslam.central.team_config import TeamConfig, team_config
from teamslam.team import translate
from teamslam.team.config import SURVEY_FRAME, UNNAMED, RobotConfig
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.former_names import with_current_names
from teamslam.team.pairs import PAIRS
from teamslam.team.recording.check import holes
from teamslam.team.recording.reader import Log
from teamslam.team.shapes import Bool, Float, UInt32
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample

UPLINK = {
    "submap": (ch.SUBMAP, ch.SIGHTING_FACTOR),
    "own/map": (ch.OWN_MAP,),
    "measurements": ch.SENSORS,
}
"""Channels of each uplink name in `PAIRS`."""


@dataclass(frozen=True, kw_only=True)
class MapResult:
    """Final map: L landmarks by id and their joint covariance (blocks unless `joint`).

    truth: true positions, zero without truth; known: rows with truth; errors: of those.
    cost_per_dof: χ² of the join. covariance_scale: factor by which the submap covariances should be
    multiplied; None: unknown. withdrawn: robots left out. lost: incomplete robots. gospa: of all
    landmarks after truth_from_map. matching: how unnamed landmarks got true positions; None: by
    identity or label. changes: states of the landmarks against saved maps. diagnosis: causes of
    misfit, the best one first.
    """

    rule: str
    digest: str
    payload_sha256: str
    frame: str
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Matrix
    joint: bool
    truth: Float[np.ndarray, "L 2"]
    known: Bool[np.ndarray, " L"]
    errors: MapErrors | None
    cost_per_dof: float | None
    reasons: tuple[str, ...]
    joined: tuple[str, ...] = ()
    withdrawn: tuple[str, ...] = ()
    covariance_scale: float | None = None
    lost: tuple[str, ...] = ()
    gospa: Gospa | None = None
    matching: Matching | None = None
    changes: tuple[m.LandmarkChange, ...] = ()
    diagnosis: tuple[m.Diagnosis, ...] = ()


USUAL = ("hybrid", "join")
"""Default estimator and rule."""
TeamMotion = tuple[Float[np.ndarray, "3"], str]
"""Rigid motion from map to truth, and what it aligns."""


@dataclass(frozen=True, kw_only=True)
class RobotResult:
    """One robot: its measurements, their dispositions, and its poses against the truth.

    smoothed: final map's poses at submap ends. online: poses published during the run, given the
    team map (`online_channel`: "team/pose"), or from own measurements if never in the team's frame.
    aligned_rmse_m, online_aligned_rmse_m: after the rigid motion that aligns the map (`alignment`:
    "map"), or without true landmarks all smoothed paths ("paths"), or without a map the robot's own
    path ("trajectory"). own_map: last own map, unaligned. outside: running poses are not in the
    team's frame, so there is no online path.
    """

    consumption: Consumption
    uplink_bytes: int | None
    truth: Path
    smoothed_path: Path
    smoothed: PoseErrors | None
    online_path: Path
    online: PoseErrors | None
    online_channel: str | None
    final_pose_nees_per_dof: float | None
    aligned_rmse_m: float | None
    alignment: str | None
    online_aligned_rmse_m: float | None
    own_map: MapErrors | None = None
    outside: bool = False

    @property
    def uplink_bytes_per_step(self) -> float | None:
        """Uplink bytes of the rule's channel per odometry interval."""
        steps = self.consumption.steps
        return None if self.uplink_bytes is None or not steps else self.uplink_bytes / steps


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A run: scenario (None: not in the log), map, robots and traffic.

    true_landmarks: all, measured or not. notes: remarks of the world, and messages set aside.
    faults: number of messages set aside. unsound: number of invalid samples. arbitrary_frame: no
    mapped robot has a known initial pose, so only aligned errors are meaningful. decisions:
    closures and merges by unnamed landmarks. verdicts: an operator's, as text. states: of every
    robot in the final map. data_set: folder or file name; empty for a simulated world. clocks:
    clock offsets and separate measurement times, as text.
    """

    scenario: TeamConfig | None
    map: MapResult | None
    robots: Mapping[str, RobotResult]
    true_landmarks: Float[np.ndarray, "T 2"]
    channels: Mapping[str, Traffic]
    notes: tuple[str, ...]
    unsound: int
    cost_by_robot: Mapping[str, float]
    faults: int = 0
    scale_by_robot: Mapping[str, float] = field(default_factory=dict)
    arbitrary_frame: bool = False
    peers: Mapping[str, PeerResult] = field(default_factory=dict)
    disagreement: tuple[str, ...] = ()
    association: AssociationResult | None = None
    decisions: tuple[m.AssociationDecision, ...] = ()
    verdicts: tuple[str, ...] = ()
    gps_median_m: float | None = None
    data_set: str = ""
    states: Mapping[str, RobotState] = field(default_factory=dict)
    clocks: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for every command that shows the result: robots missing from the map, causes of
        misfit, the map's own warnings, clock offsets.
        """
        causes = () if self.map is None else map(describe, self.map.diagnosis)
        return (*not_in_the_map(self.states), *causes, *self.other_warnings)

    @property
    def other_warnings(self) -> tuple[str, ...]:
        """Warnings beside missing robots and causes of misfit."""
        reasons = () if self.map is None else self.map.reasons
        of_map = (short(each) for each in reasons if not any(not_joined([each])))
        lost = (f"{name} lost: {of.why}" for name, of in self.states.items() if of.state == "lost")
        return (*lost, *of_map, *self.clocks)

    @property
    def title(self) -> str:
        """Data set name, or scenario and seed."""
        if self.scenario is None:
            return "a run whose scenario is not known"
        return self.data_set or f"{self.scenario.name}, seed {self.scenario.seed}"

    @property
    def method(self) -> str:
        """Estimator and rule; empty for a data set with the defaults."""
        if self.scenario is None:
            return ""
        chosen = self.scenario.estimator, self.scenario.fusion
        return "" if self.data_set and chosen == USUAL else " + ".join(chosen)

    @property
    def matched_by(self) -> str:
        """Method that matched unnamed landmarks to true ones; may be empty."""
        return "" if self.map is None or self.map.matching is None else str(self.map.matching)


def evaluate(samples: Iterable[Sample]) -> Evaluation:
    """Evaluate one run from its samples in log order."""
    log = collect_log(samples)
    scenario = _scenario(log)
    truth = log.sound(log.last(ch.TRUTH_LANDMARKS))
    ids, positions = (
        translate.landmarks_of(truth)
        if isinstance(truth, m.TruthLandmarks)
        else (np.empty(0, np.uint32), np.empty((0, 2)))
    )
    association = association_result(log)
    label_of = {} if association is None else association.label_of
    final = log.sound(log.last(ch.FINAL_MAP))
    message = final if isinstance(final, m.FusedMap) else None
    uplink = None if scenario is None else _uplink(scenario)
    frames = _frames(log)
    arbitrary = _is_arbitrary(frames, message)

    def is_in_frame(frame: str) -> bool:
        if not arbitrary:
            return frames.has(frame)
        return message is None or not message.ids or frame in {"", message.frame}

    logs = {robot: robot_log(log, robot, is_in_frame) for robot in log.robots}
    truth_from_map = _motion(logs.values()) if arbitrary else np.zeros(3)
    fused = (
        None
        if message is None
        else _map_result(log, message, ids, positions, label_of, truth_from_map)
    )
    motion = _team_motion(fused, logs.values())
    robots = {
        robot: _robot_result(
            logs[robot],
            consumption(log, robot),
            _bytes(log, uplink, robot),
            motion,
            _own_map(log, robot, ids, positions),
        )
        for robot in log.robots
    }
    end = log.sound(log.last(ch.END))
    faults = log.faults()
    return Evaluation(
        scenario=scenario,
        map=fused,
        robots=robots,
        true_landmarks=positions,
        channels={key: log.traffic[key] for key in in_order(log.traffic)},
        notes=(
            *(end.notes if isinstance(end, m.End) else ()),
            *log.disagreement,
            *_never_came(log),
            *_set_aside(faults),
        ),
        unsound=log.unsound,
        cost_by_robot=_by_robot(log, "joint_cost_per_dof."),
        faults=len(faults),
        scale_by_robot=_by_robot(log, "covariance_scale."),
        arbitrary_frame=arbitrary,
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
        clocks=_clocks(log),
    )


def _clocks(log: Collected) -> tuple[str, ...]:
    """Clock warnings of each robot, from its incarnation with most measurements."""
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
    found = (clock_warning(robot, longest[robot], configs[robot]) for robot in in_order(longest))
    return tuple(filter(None, (*found, separate_times_warning(spans))))


def _config(log: Collected, robot: str) -> RobotConfig:
    announced = log.sound(log.latest.get(ch.ROBOT_CONFIG.key(robot)))
    if isinstance(announced, m.Configuration):
        with suppress(msgspec.MsgspecError):
            text = with_current_names(msgspec.json.decode(announced.configuration))
            return msgspec.convert(text, RobotConfig)
    return RobotConfig(robot)


def _frames(log: Collected) -> TruthFrames:
    frames = TruthFrames()
    for start in (each for robot in log.robots for each in log.messages(ch.START, robot)):
        if isinstance(start, m.InitialPose):
            frames.take(start)
    return frames


def _is_arbitrary(frames: TruthFrames, fused: m.FusedMap | None) -> bool:
    """Whether neither a known initial pose nor a survey fixes the final map's frame (or any frame,
    without a map).
    """
    if fused is None or not fused.members:
        return frames.none_is_known
    if fused.frame == SURVEY_FRAME:
        return False
    return not any(frames.has(translate.frame_name(x.robot, x.incarnation)) for x in fused.members)


def _never_came(log: Collected) -> list[str]:
    """Robots whose driver missed published messages, by its last status."""
    warnings = []
    for robot in log.robots:
        status = log.sound(log.latest.get(ch.STATUS.key(ch.source_node(robot))))
        figures = status.figures if isinstance(status, m.Status) else {}
        lost = figures.get("messages_lost", 0.0) + figures.get("messages_dropped", 0.0)
        if lost and math.isfinite(lost):
            warnings.append(
                f"{robot}: {lost:,.0f} messages of its topics are not in its stream, beside "
                f"{figures.get('messages', 0.0):,.0f} that are; see its driver's warnings"
            )
    return warnings


def _set_aside(faults: Sequence[m.Fault]) -> list[str]:
    """Messages that each node set aside, and the first exception, as text."""
    by_node: dict[str, list[m.Fault]] = {}
    for fault in faults:
        by_node.setdefault(fault.node, []).append(fault)
    return [
        f"{node} set {len(found)} messages aside; the first, {found[0].origin}, raised "
        f"{found[0].error} at {found[0].place}: {found[0].text}"
        for node, found in ((node, by_node[node]) for node in in_order(by_node))
    ]


def _by_robot(log: Collected, name: str) -> dict[str, float]:
    """Last values of the centre's figure of this name, by robot."""
    status = log.sound(log.latest.get(ch.STATUS.key("central")))
    if not isinstance(status, m.Status):
        return {}
    return {k.removeprefix(name): v for k, v in status.figures.items() if k.startswith(name)}


def add_holes(evaluation: Evaluation, log: Log) -> Evaluation:
    """Add a note for every gap of the log."""
    lost = tuple(f"the log is not whole, {finding}" for finding in holes(log))
    return replace(evaluation, notes=(*evaluation.notes, *lost))


def to_json(evaluation: Evaluation, extra: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Figures under their JSON names; `extra` replaces or adds figures."""
    scenario, fused = evaluation.scenario, evaluation.map
    errors = None if fused is None else fused.errors
    shape = None if errors is None else errors.shape
    figures = {
        "scenario": None if scenario is None else scenario.name,
        "data_set": evaluation.data_set or None,
        "seed": None if scenario is None else scenario.seed,
        "estimator": None if scenario is None else scenario.estimator,
        "fusion": None if scenario is None else scenario.fusion,
        "landmarks": None if fused is None else len(fused.ids),
        "landmarks_with_truth": None if errors is None else errors.count,
        "landmark_matching": None
        if fused is None or fused.matching is None
        else asdict(fused.matching),
        "landmark_rmse_m": None if errors is None else errors.rmse_m,
        "landmark_rmse_aligned_m": None if errors is None else errors.aligned_rmse_m,
        "map_nees_per_dof": None if errors is None else errors.nees_per_dof,
        "map_nees_band": None if errors is None else list(errors.band),
        "map_nees_in_band": None if errors is None else errors.in_band,
        "shape_nees_per_landmark": None if shape is None else shape.nees_per_landmark,
        "shape_coverage_95": None if shape is None else shape.coverage,
        "landmark_coverage_95": None if errors is None else errors.coverage,
        "map_covariance": None if fused is None else "joint" if fused.joint else "blocks",
        "joint_cost_per_dof": None if fused is None else fused.cost_per_dof,
        "joint_cost_per_dof_by_robot": dict(evaluation.cost_by_robot),
        "covariance_scale": None if fused is None else fused.covariance_scale,
        "covariance_scale_by_robot": dict(evaluation.scale_by_robot),
        "final_map_digest": None if fused is None else fused.digest,
        "final_map_sha256": (
            None if fused is None or evaluation.disagreement else fused.payload_sha256
        ),
        "peers_that_differ": list(evaluation.disagreement),
        "final_map_frame": None if fused is None else fused.frame,
        "frame_is_arbitrary": evaluation.arbitrary_frame,
        "diagnosis": [] if fused is None else [to_object(each) for each in fused.diagnosis],
        "not_joined": absent_robots(evaluation.states, "not joined"),
        "warnings": warning_objects(evaluation.other_warnings),
        "joined": [] if fused is None else list(fused.joined),
        "changes": [] if fused is None else [change_json(each) for each in fused.changes],
        "withdrawn": absent_robots(evaluation.states, "withdrawn"),
        "robot_states": {name: of._asdict() for name, of in evaluation.states.items()},
        "robots": {name: _robot_json(robot) for name, robot in evaluation.robots.items()},
        "peers": {name: peer_json(peer) for name, peer in evaluation.peers.items()},
        "channels": {
            key: {"messages": traffic.messages, "bytes": traffic.bytes}
            for key, traffic in evaluation.channels.items()
        },
        "association": None
        if evaluation.association is None
        else association_json(evaluation.association),
        "association_decisions": [msgspec.structs.asdict(each) for each in evaluation.decisions],
        "reference_rmse_m": None
        if errors is None or evaluation.association is None
        else errors.aligned_rmse_m,
        "verdicts": list(evaluation.verdicts),
        "gps_median_m": evaluation.gps_median_m,
        "gospa": None if fused is None or fused.gospa is None else asdict(fused.gospa),
        "unsound_messages": evaluation.unsound,
        "notes": list(evaluation.notes),
        "faults": evaluation.faults,
    }
    return figures | dict(extra or {})


def change_json(change: m.LandmarkChange) -> dict[str, Any]:
    """A landmark's state against the saved maps; `expected`: observations of one that is gone."""
    return {
        "landmark": change.landmark,
        "state": change.state,
        "dx_m": change.dx,
        "dy_m": change.dy,
        "sigma_m": change.sigma,
        "chi2": change.chi2,
        "expected": change.expected,
    }


def _robot_json(robot: RobotResult) -> dict[str, Any]:
    used, smoothed, online = robot.consumption, robot.smoothed, robot.online
    own = robot.own_map
    return {
        "steps": used.steps,
        "measurements_published": used.published,
        "measurements_consumed": used.consumed,
        "measurements_used": used.used,
        "measurements_rejected": used.rejected,
        "measurements_open": used.open,
        "measurements_used_once": used.each_once,
        "ledger": dict(used.ledger),
        "submaps": used.submaps,
        "position_rmse_m": None if smoothed is None else smoothed.position_rmse_m,
        "heading_rmse_rad": None if smoothed is None else smoothed.heading_rmse_rad,
        "pose_nees_per_dof": None if smoothed is None else smoothed.nees_per_dof,
        "pose_coverage_95": None if smoothed is None else smoothed.coverage,
        "final_pose_nees_per_dof": robot.final_pose_nees_per_dof,
        "position_rmse_aligned_m": robot.aligned_rmse_m,
        "aligned_by": robot.alignment,
        "online_position_rmse_m": None if online is None else online.position_rmse_m,
        "online_heading_rmse_rad": None if online is None else online.heading_rmse_rad,
        "online_pose_nees_per_dof": None if online is None else online.nees_per_dof,
        "online_pose_coverage_95": None if online is None else online.coverage,
        "online_position_rmse_aligned_m": robot.online_aligned_rmse_m,
        "online_channel": robot.online_channel,
        "online_in_team_frame": not robot.outside,
        "own_map_landmarks": None if own is None else own.count,
        "own_map_rmse_m": None if own is None else own.rmse_m,
        "own_map_rmse_aligned_m": None if own is None else own.aligned_rmse_m,
        "own_map_nees_per_dof": None if own is None else own.nees_per_dof,
        "own_map_nees_in_band": None if own is None else own.in_band,
        "uplink_bytes": robot.uplink_bytes,
        "uplink_bytes_per_step": robot.uplink_bytes_per_step,
    }


def _scenario(log: Collected) -> TeamConfig | None:
    message = log.sound(log.last(ch.WORLD_CONFIG))
    if not isinstance(message, m.Configuration):
        return None
    try:
        return team_config(message.configuration)
    except ValueError:
        return None


class _Place(msgspec.Struct):
    path: str = ""


class _World(msgspec.Struct):
    """Part of a scenario that names a data set."""

    world: _Place


def _data_set(log: Collected) -> str:
    message = log.sound(log.last(ch.WORLD_CONFIG))
    if not isinstance(message, m.Configuration):
        return ""
    try:
        return data_set_name(msgspec.json.decode(message.configuration, type=_World).world.path)
    except (msgspec.MsgspecError, UnicodeEncodeError):
        return ""


def _uplink(team: TeamConfig) -> tuple[ch.Channel, ...] | None:
    """Channels that the team's rule consumes; None for an invalid pair."""
    named = PAIRS.get((team.estimator, team.fusion))
    return None if named is None else UPLINK[named]


def _bytes(log: Collected, uplink: tuple[ch.Channel, ...] | None, robot: str) -> int | None:
    if uplink is None:
        return None
    keys = [channel.key(robot) for channel in uplink]
    return sum(log.traffic[key].bytes for key in keys if key in log.traffic)


def _map_result(
    log: Collected,
    message: m.FusedMap,
    true_ids: UInt32[np.ndarray, " T"],
    positions: Float[np.ndarray, "T 2"],
    label_of: Mapping[int, int],
    truth_from_map: Float[np.ndarray, "3"] | None,
) -> MapResult:
    """Final map and its errors.

    truth_from_map: motion after which landmarks without identity or label are matched to the
    nearest true ones; None: unknown.
    """
    sample = log.last(ch.FINAL_MAP)
    assert sample is not None
    ids, means = translate.landmarks_of(message)
    covariance = translate.landmark_covariance_of(message)
    labels = np.array([label_of.get(i, i) for i in ids.tolist()], np.uint32)
    truth, known = _truth_of(labels, true_ids, positions)
    matching = None
    if not label_of and truth_from_map is not None:
        at = transform_points(truth_from_map, means)
        matching = _match_unnamed(ids, at, true_ids, positions, truth, known)
    errors = _errors(means, covariance, truth, known)
    return MapResult(
        rule=message.rule,
        digest=message.digest.hex(),
        payload_sha256=hashlib.sha256(sample.payload).hexdigest(),
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
        diagnosis=tuple(each for each in message.diagnosis if not _is_refuted(each, errors)),
        joined=message.joined,
        withdrawn=message.withdrawn,
        covariance_scale=message.covariance_scale or None,
        lost=message.lost,
        gospa=_gospa(means, errors, positions),
        matching=matching,
        changes=message.changes,
    )


def _is_refuted(found: m.Diagnosis, errors: MapErrors | None) -> bool:
    """Whether the truth refutes that covariances are too large: an error common to all submaps,
    such as a late clock, does not show in their differences.
    """
    is_small = found.cause == "noise_overestimated"
    return is_small and errors is not None and errors.nees_per_dof > 1.0


def _match_unnamed(
    ids: UInt32[np.ndarray, " L"],
    means: Float[np.ndarray, "L 2"],
    true_ids: UInt32[np.ndarray, " T"],
    positions: Float[np.ndarray, "T 2"],
    truth: Float[np.ndarray, "L 2"],
    known: Bool[np.ndarray, " L"],
) -> Matching | None:
    """Fill in true positions of unnamed landmarks from the nearest unidentified true landmarks."""
    unnamed = np.flatnonzero((ids >= UNNAMED) & ~known)
    free = positions[~np.isin(true_ids, ids)]
    found = nearest(means[unnamed], free) if len(unnamed) else None
    if found is None:
        return None
    rows, matching = found
    near = rows >= 0
    truth[unnamed[near]] = free[rows[near]]
    known[unnamed[near]] = True
    return matching


def _gospa(
    means: Float[np.ndarray, "L 2"], errors: MapErrors | None, positions: Float[np.ndarray, "T 2"]
) -> Gospa | None:
    cut_off_m = half_spacing(positions)
    if errors is None or errors.truth_from_map is None or not cut_off_m:
        return None
    return gospa(transform_points(errors.truth_from_map, means), positions, cut_off_m)


def _own_map(
    log: Collected,
    robot: str,
    true_ids: UInt32[np.ndarray, " T"],
    positions: Float[np.ndarray, "T 2"],
) -> MapErrors | None:
    message = log.sound(log.latest.get(ch.OWN_MAP.key(robot)))
    if not isinstance(message, m.MapEstimate):
        return None
    ids, means = translate.landmarks_of(message)
    truth, known = _truth_of(ids, true_ids, positions)
    return _errors(means, translate.landmark_covariance_of(message), truth, known)


def _truth_of(
    ids: UInt32[np.ndarray, " L"],
    true_ids: UInt32[np.ndarray, " T"],
    positions: Float[np.ndarray, "T 2"],
) -> tuple[Float[np.ndarray, "L 2"], Bool[np.ndarray, " L"]]:
    """True positions of the landmarks (zero where unknown) and a mask of known ones."""
    truth = np.zeros((len(ids), 2))
    known = np.isin(ids, true_ids)
    truth[known] = positions[np.searchsorted(true_ids, ids[known])]
    return truth, known


def _errors(
    means: Float[np.ndarray, "L 2"],
    covariance: Matrix,
    truth: Float[np.ndarray, "L 2"],
    known: Bool[np.ndarray, " L"],
) -> MapErrors | None:
    rows = np.flatnonzero(np.repeat(known, 2))
    if not known.any():
        return None
    return map_errors(means[known], covariance[np.ix_(rows, rows)], truth[known])


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
    """Rigid motion of the team's map onto the truth, and its source."""
    if fused is None:
        return None
    if fused.errors is not None and fused.errors.truth_from_map is not None:
        return fused.errors.truth_from_map, "map"
    motion = _motion(logs)
    return None if motion is None else (motion, "paths")


def _motion(logs: Iterable[RobotLog]) -> Float[np.ndarray, "3"] | None:
    """Rigid motion that aligns smoothed with true positions."""
    true_places, places = [np.empty((0, 2))], [np.empty((0, 2))]
    for log in logs:
        truth, known = interpolate_truth(log.truth, log.smoothed.stamps_ns)
        true_places.append(truth[known, :2])
        places.append(log.smoothed.poses[known, :2])
    return rigid_alignment(np.concatenate(true_places), np.concatenate(places))
