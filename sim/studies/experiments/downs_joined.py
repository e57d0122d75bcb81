"""Runs after J. Downs' thesis: whole-run maps, and submaps joined by his method.

Measurements and submaps of one second, joined with the identity and aligned by singular values
(`svd-join-spherical`). A submap is a window of the hybrid estimator; his is an EKF step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from teamslam.central.desk.evaluation.errors import MapErrors, Path, map_errors, pose_errors
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, loads, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.estimators import svd_joining
from teamslam.sim.studies.estimators.svd_joining import (
    SETTINGS,
    PointPairs,
    SubmapJoining,
    mutual_sighting,
    reweight,
)
from teamslam.sim.studies.experiments.curves import estimated_poses, messages, true_landmarks
from teamslam.sim.studies.experiments.experiment import Dataset, Task
from teamslam.sim.studies.experiments.team_runs import (
    Figures,
    expected_s,
    scenario_task,
    with_robots,
    with_world,
)
from teamslam.sim.studies.rules.svd_rule import align_maps
from teamslam.sim.world.config import UtiasWorld
from teamslam.team import translate
from teamslam.team.config import Sensor
from teamslam.team.estimation.contribution import Contribution, Stream
from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.estimation.map_joining import joining
from teamslam.team.estimation.models import corrected
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, opened

STEP_S = 1.0
NEVER_S = 1e6
DRAWN_POINTS = 1000


def final_maps_only(scenario: Scenario) -> Scenario:
    """Leave out running poses, maps and broadcasts."""
    change = msgspec.structs.replace
    robots = tuple(change(robot, pose_s=NEVER_S) for robot in scenario.robots)
    central = change(scenario.central, broadcast_s=NEVER_S)
    return change(scenario, robots=robots, central=central)


def his_protocol(scenario: Scenario) -> Scenario:
    """Set steps of one second, exact initial poses, no loss or factor."""
    change = msgspec.structs.replace
    scenario = final_maps_only(scenario)
    if isinstance(scenario.world, UtiasWorld):
        scenario = with_world(scenario, start_sigma_m=0.0, start_sigma_rad=0.0)
    steps = {"window_s": STEP_S, "window_m": 0.0, "keyframe_s": STEP_S, "node_s": 0.0}
    scenario = with_robots(scenario, "front_end", **steps, biases=())
    central = change(scenario.central, tick_s=NEVER_S, covariance_factor=1.0, withdraw_above=None)
    return change(scenario, central=central)


def whole_run_task(scenario: Scenario, dataset: Dataset | None = None, note: str = "") -> Task:
    """Make the task of every robot's map and path."""
    return _task("whole_run", scenario, dataset, note)


def spherical_task(scenario: Scenario, dataset: Dataset | None = None) -> Task:
    """Make the task of his method."""
    return _task("spherical_run", his_protocol(scenario), dataset, "submaps of a step, identity")


def _task(work: str, scenario: Scenario, dataset: Dataset | None, note: str) -> Task:
    place = scenario.name if dataset is None else dataset.name
    label = f"{place}, {scenario.estimator}{f', {note}' if note else ''}, "
    label += f"{len(scenario.robots)} robots, seed {scenario.seed}"
    return scenario_task(f"downs_joined:{work}", scenario, label, expected_s(scenario), dataset)


def whole_run(scenario: Mapping[str, Any], sha256: str = "", path: str | None = None) -> Figures:
    """Errors of the robots' last maps and online paths."""
    samples = _samples(scenario, path)
    evaluation = evaluate(samples)
    return {
        "sample": _sample(samples, evaluation),
        "robots": {
            name: _map_figures(robot.own_map)
            | {"position_rmse": None if robot.online is None else robot.online.position_rmse_m}
            for name, robot in evaluation.robots.items()
        },
    }


def _sample(samples: Sequence[Sample], evaluation: Evaluation) -> Figures:
    name, robot = next(iter(evaluation.robots.items()))
    maps = [opened(s)[2] for s in samples if s.key == ch.OWN_MAP.key(name)]
    last = next((each for each in reversed(maps) if isinstance(each, m.MapEstimate)), None)
    return {
        "robot": name,
        "means": [] if last is None else translate.landmarks_of(last)[1].tolist(),
        "blocks": [] if last is None else translate.landmark_blocks_of(last).tolist(),
        "landmarks": true_landmarks(samples)[1].tolist(),
        "online": _thin(estimated_poses(samples, (ch.OWN_POSE.key(name),))[0]),
        "truth": _thin(robot.truth),
    }


def _thin(path: Path) -> list[list[float]]:
    every = max(1, len(path.poses) // DRAWN_POINTS)
    points: list[list[float]] = path.poses[::every, :2].round(3).tolist()
    return points


def spherical_run(
    scenario: Mapping[str, Any], sha256: str = "", path: str | None = None
) -> Figures:
    """Errors of joined maps and smoothed paths, and of the team."""
    samples = _samples(scenario, path)
    evaluation = evaluate(samples)
    ids, positions = true_landmarks(samples)
    truth = dict(zip(ids.tolist(), positions, strict=True))
    robots, maps, paths = {}, {}, {}
    for name in evaluation.robots:
        submaps = _submaps(samples, name)
        if not submaps:
            continue
        state = _join(name, _start(samples, name), submaps)
        found = svd_joining.landmark_gaussian(state)
        maps[name, 0] = found
        paths[name] = _path(name, state, submaps)
        robots[name] = _map_figures(_errors(found, truth)) | {
            "position_rmse": _path_error(evaluation, name, paths[name]),
            "submaps": len(submaps),
        }
    if not maps:
        return {"robots": {}, "team": _map_figures(None), "reasons": []}
    sensors = {
        robot["id"]: msgspec.convert(robot["sensor"], Sensor) for robot in scenario["robots"]
    }
    sightings = _mutual(samples, sensors, paths)
    team, reasons = align_maps(min(maps), maps, full=False, sightings=sightings)
    return {
        "robots": robots,
        "team": _map_figures(_errors(team, truth)),
        "sightings": sum(len(pairs.in_a) for pairs in sightings.values()),
        "with_covariances": _map_figures(None if evaluation.map is None else evaluation.map.errors),
        "reasons": list(reasons),
    }


def _samples(scenario: Mapping[str, Any], path: str | None) -> list[Sample]:
    resolved = with_options(loads(msgspec.json.encode(scenario).decode()), dataset=path)
    return list(run_team(resolved, streams_of(resolved)))


def _submaps(samples: Sequence[Sample], robot: str) -> list[m.Submap]:
    submaps = [opened(s)[2] for s in samples if s.key == ch.SUBMAP.key(robot)]
    by_sequence = {each.sequence: each for each in submaps if isinstance(each, m.Submap)}
    return [by_sequence[sequence] for sequence in sorted(by_sequence)]


def _start(samples: Sequence[Sample], robot: str) -> Float[np.ndarray, "3"]:
    for sample in samples:
        if sample.key == ch.START.key(robot):
            message = opened(sample)[2]
            if isinstance(message, m.InitialPose):
                pose = translate.pose_of(message)[0]
                return np.zeros(3) if pose is None else pose
    return np.zeros(3)


def _join(robot: str, start: Float[np.ndarray, "3"], submaps: Sequence[m.Submap]) -> SubmapJoining:
    initial_state = svd_joining.initial_state({robot: start})
    contributions = [
        Contribution(robot, 0, k, k, reweight(translate.local_map_of(s).without_nodes, "identity"))
        for k, s in enumerate(submaps)
    ]
    return svd_joining.solve(
        replace(
            initial_state, fold=joining.fold_submaps(initial_state.fold, contributions, SETTINGS)
        )
    )


def _path(robot: str, state: SubmapJoining, submaps: Sequence[m.Submap]) -> Path:
    graph = state.fold.main.graph
    ends = graph.offset[np.array(graph.streams[robot, 0][1:])]
    poses = state.fold.main.state[ends[:, None] + np.arange(3)]
    return Path(np.array([submap.stamp_ns for submap in submaps], dtype=np.int64), poses)


def _path_error(evaluation: Evaluation, robot: str, path: Path) -> float | None:
    unit = np.broadcast_to(np.eye(3), (len(path.poses), 3, 3))
    errors = pose_errors(path, unit, evaluation.robots[robot].truth)
    return None if errors is None else errors.position_rmse_m


def _mutual(
    samples: Sequence[Sample], sensors: Mapping[str, Sensor], paths: Mapping[str, Path]
) -> dict[tuple[Stream, Stream], PointPairs]:
    looks = {name: _looks(samples, name, sensors[name]) for name in paths}
    found: dict[tuple[Stream, Stream], PointPairs] = {}
    for a in sorted(paths):
        for b in sorted(paths):
            steps = sorted(looks[a].get(b, {}).keys() & looks[b].get(a, {}).keys()) if a < b else []
            pairs = [
                mutual_sighting(
                    paths[a].poses[at_a],
                    *looks[a][b][step],
                    paths[b].poses[at_b],
                    *looks[b][a][step],
                )
                for step in steps
                if (at_a := _at(paths[a], step)) is not None
                and (at_b := _at(paths[b], step)) is not None
            ]
            if pairs:
                found[(a, 0), (b, 0)] = PointPairs(
                    *(np.concatenate(each) for each in zip(*pairs, strict=True))
                )
    return found


def _looks(
    samples: Sequence[Sample], robot: str, sensor: Sensor
) -> dict[str, dict[int, tuple[float, float]]]:
    found: dict[str, dict[int, tuple[float, float]]] = {}
    for message in messages(samples, ch.SIGHTINGS.key(robot)):
        if isinstance(message, m.Sightings):
            teammates, *read = translate.detections_of(message)
            ranges, bearings = corrected(sensor, *read)
            for name, seen, bearing in zip(teammates, ranges, bearings, strict=True):
                look = float(seen) - sensor.marker_range_offset, float(bearing)
                found.setdefault(name, {})[round(message.stamp_ns / STEP_S * 1e-9)] = look
    return found


def _at(path: Path, step: int) -> int | None:
    stamp_ns = round(step * STEP_S * 1e9)
    nearest = int(np.argmin(np.abs(path.stamps_ns - stamp_ns)))
    near = abs(int(path.stamps_ns[nearest]) - stamp_ns) <= 0.5e9 * STEP_S
    return nearest if near else None


def _errors(
    found: LandmarkGaussian, truth: Mapping[int, Float[np.ndarray, "2"]]
) -> MapErrors | None:
    known = [k for k, id_ in enumerate(found.ids.tolist()) if id_ in truth]
    if not known:
        return None
    rows = np.repeat(2 * np.array(known), 2) + np.tile([0, 1], len(known))
    positions = np.array([truth[int(found.ids[k])] for k in known])
    return map_errors(found.means[known], found.covariance[np.ix_(rows, rows)], positions)


def _map_figures(errors: MapErrors | None) -> Figures:
    return {
        "rmse": None if errors is None else errors.rmse_m,
        "rmse_aligned": None if errors is None else errors.aligned_rmse_m,
        "nees": None if errors is None else errors.nees_per_dof,
        "landmarks": 0 if errors is None else errors.count,
    }
