"""Errors over team time: online poses, and robot 1's first landmark in the newest fused map, or
else its own.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from teamslam.central.desk.evaluation.errors import Path, PoseErrors, pose_errors
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.scenarios.scenario import Scenario, loads
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments.experiment import Task
from teamslam.sim.studies.experiments.team_runs import Figures, TimedRun, expected_s, pair_name
from teamslam.sim.world.streams import Detections, RobotStream, WorldStreams
from teamslam.team import translate
from teamslam.team.pairs import PAIRS
from teamslam.team.shapes import Float, UInt32
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats
from teamslam.team.wire.bus import Sample, opened

STEP_S = 1.0  # length [s] of a step of the thesis' world
Map = m.FusedMap | m.MapEstimate
DIGITS = 5  # significant digits of a stored curve


def curves_task(
    scenario: Scenario,
    team_scenario: Scenario | None = None,
    label: str = "",
    *,
    late: bool = False,
    shots: Sequence[int] = (),
) -> Task:
    """Make the task of the curves of one run.

    late: measurements are those of the step before. shots: steps whose maps and paths are stored.
    """
    return Task(
        "teamslam.sim.studies.experiments.curves:curves_run",
        {"world": msgspec.to_builtins(scenario)}
        | ({} if team_scenario is None else {"team_scenario": msgspec.to_builtins(team_scenario)})
        | ({"late": True} if late else {})
        | ({"shots": list(shots)} if shots else {}),
        f"{'maps of ' if shots else ''}{label or scenario.name}, "
        f"{pair_name(scenario.estimator, scenario.fusion)}, seed {scenario.seed}",
        expected_s(scenario),
    )


def curves_run(
    world: Mapping[str, Any],
    team_scenario: Mapping[str, Any] | None = None,
    late: bool = False,
    shots: Sequence[int] = (),
) -> Figures:
    """Curves of poses and first landmark, the map at `shots`."""
    scenario = loads(msgspec.json.encode(world).decode())
    team = scenario if team_scenario is None else loads(msgspec.json.encode(team_scenario).decode())
    streams = streams_of(scenario)
    samples = list(TimedRun().samples(team, a_step_late(streams) if late else streams))
    evaluation = evaluate(samples)
    ids, positions = true_landmarks(samples)
    truth = dict(zip(ids.tolist(), positions, strict=True))
    first = scenario.robots[0].id
    maps = running_maps(samples, first)
    paths = {name: estimated_poses(samples, pose_keys(team, name)) for name in evaluation.robots}
    found: Figures = {
        "poses": {
            name: _pose_curve(errors)
            for name, robot in evaluation.robots.items()
            if (errors := pose_errors(*paths[name], robot.truth)) is not None
        },
        "landmark": _landmark_curve(samples, maps, first, truth),
        "map": {
            "time_s": short(np.array([each.stamp_ns * 1e-9 for each in maps])),
            "error_m": short(np.array([_map_rmse(each, truth) for each in maps])),
        },
    }
    if shots:
        lines = {n: (paths[n][0], robot.truth) for n, robot in evaluation.robots.items()}
        found["shots"] = [_shot(step, maps, lines, truth) for step in shots]
        found["landmarks"] = positions.tolist()
    return found


def true_landmarks(
    samples: Iterable[Sample],
) -> tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    """Ids and positions [m] of landmarks."""
    for message in messages(samples, ch.TRUTH_LANDMARKS.key()):
        if isinstance(message, m.TruthLandmarks):
            return translate.landmarks_of(message)
    return np.empty(0, np.uint32), np.empty((0, 2))


def messages(samples: Iterable[Sample], key: str) -> Iterable[m.Message]:
    """Messages of one key, in order."""
    return (opened(sample)[2] for sample in samples if sample.key == key)


def a_step_late(streams: WorldStreams) -> WorldStreams:
    """Delay each message of landmarks by one."""
    return replace(streams, streams=tuple(_a_step_late(stream) for stream in streams.streams))


def _a_step_late(stream: RobotStream) -> RobotStream:
    seen = stream.landmark_detections
    rows = int(seen.offsets[-2])
    late = Detections(
        seen.stamps_ns[1:], seen.offsets[:-1], seen.ids[:rows], seen.ranges[:rows],
        seen.bearings[:rows],
    )  # fmt: skip
    return replace(stream, landmark_detections=late)


def pose_keys(scenario: Scenario, robot: str) -> tuple[str, ...]:
    """Keys of a robot's online poses; later keys have precedence."""
    if PAIRS[scenario.estimator, scenario.fusion] == "measurements":
        return (ch.CENTRAL_POSE.key(robot),)
    return (ch.OWN_POSE.key(robot), ch.TEAM_POSE.key(robot))


def estimated_poses(
    samples: Iterable[Sample], keys: Sequence[str]
) -> tuple[Path, Float[np.ndarray, "K 3 3"]]:
    """Poses and covariances; later keys have precedence."""
    by_stamp: dict[str, dict[int, m.PoseEstimate]] = {key: {} for key in keys}
    for sample in samples:
        if sample.key in by_stamp:
            message = opened(sample)[2]
            if isinstance(message, m.PoseEstimate):
                by_stamp[sample.key][message.stamp_ns] = message
    newest = {stamp_ns: pose for key in keys for stamp_ns, pose in by_stamp[key].items()}
    estimates = [newest[stamp_ns] for stamp_ns in sorted(newest)]
    return Path(
        np.array(sorted(newest), dtype=np.int64),
        np.array([floats(p.pose, "pose") for p in estimates]).reshape(-1, 3),
    ), np.array([floats(p.covariance, "covariance") for p in estimates]).reshape(-1, 3, 3)


def _pose_curve(found: PoseErrors) -> Figures:
    errors, sigmas = found.errors, found.sigmas
    return {
        "time_s": short(found.stamps_ns * 1e-9),
        "error_m": short(np.hypot(errors[:, 0], errors[:, 1])),
        "sigma_m": short(np.hypot(sigmas[:, 0], sigmas[:, 1])),
        "heading_error_deg": short(np.degrees(np.abs(errors[:, 2]))),
        "heading_sigma_deg": short(np.degrees(sigmas[:, 2])),
        "nees": short(found.nees / 3.0),
    }


def running_maps(samples: Sequence[Sample], robot: str) -> list[Map]:
    """Fused maps with landmarks, or else the robot's."""
    for key in (ch.FUSED_MAP.key(), ch.OWN_MAP.key(robot)):
        published = messages(samples, key)
        maps = [
            each for each in published if isinstance(each, m.FusedMap | m.MapEstimate) and each.ids
        ]
        if maps:
            return maps
    return []


def _map_rmse(estimate: Map, truth: Mapping[int, Float[np.ndarray, "2"]]) -> float:
    ids, means = translate.landmarks_of(estimate)
    true = np.array([truth[int(landmark)] for landmark in ids])
    return float(np.sqrt(((means - true) ** 2).sum(axis=1).mean()))


def _shot(
    step: int,
    maps: Sequence[Map],
    lines: Mapping[str, tuple[Path, Path]],
    truth: Mapping[int, Float[np.ndarray, "2"]],
) -> Figures:
    now_ns = round(step * STEP_S * 1e9)
    newest = next((each for each in reversed(maps) if each.stamp_ns <= now_ns), None)
    return {
        "step": step,
        "means": [] if newest is None else translate.landmarks_of(newest)[1].tolist(),
        "blocks": [] if newest is None else translate.landmark_blocks_of(newest).tolist(),
        "rmse_m": None if newest is None else _map_rmse(newest, truth),
        "paths": {
            name: {
                kind: path.poses[path.stamps_ns <= now_ns, :2].round(2).tolist()
                for kind, path in (("online", online), ("truth", true))
            }
            for name, (online, true) in lines.items()
        },
    }


def _landmark_curve(
    samples: Sequence[Sample],
    maps: Sequence[Map],
    robot: str,
    truth: Mapping[int, Float[np.ndarray, "2"]],
) -> Figures | None:
    landmark = next(
        (
            int(translate.scan_of(message).ids[0])
            for message in messages(samples, ch.OBSERVATIONS.key(robot))
            if isinstance(message, m.AnyScan) and message.ids
        ),
        None,
    )
    if landmark is None or not maps:
        return None
    times, errors, sigmas = [], [], []
    for fused in maps:
        ids, means = translate.landmarks_of(fused)
        place = np.flatnonzero(ids == landmark)
        if not len(place):
            continue
        k = int(place[0])
        covariance = translate.landmark_covariance_of(fused)[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        times.append(fused.stamp_ns * 1e-9)
        errors.append(float(np.hypot(*(means[k] - truth[landmark]))))
        sigmas.append(float(np.sqrt(np.trace(covariance))))
    return {
        "id": landmark,
        "time_s": short(np.array(times)),
        "error_m": short(np.array(errors)),
        "sigma_m": short(np.array(sigmas)),
    }


def short(values: Float[np.ndarray, " K"]) -> list[float]:
    """Round to DIGITS digits, for JSON."""
    return [float(f"{value:.{DIGITS}g}") for value in values.tolist()]
