"""Runs after K.-C. Ma and Z. Ma's report, on a UTIAS set.

Parameters of its program: robot 1's initial pose is that of set 2, α₁ … α₆ are 0.1 for intervals of
0.02 s, the variances of range and bearing 0.0167 m² and 0.000737 rad², odometry is uncalibrated.
"""

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from teamslam.central.desk.drawing import BLACK, BLUE, GREEN, ORANGE, VERMILION
from teamslam.central.desk.evaluation.errors import Path, pose_errors
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.scenarios.scenario import Scenario, load, loads, with_options
from teamslam.sim.studies.experiments.curves import (
    estimated_poses,
    messages,
    pose_keys,
    running_maps,
    short,
    true_landmarks,
)
from teamslam.sim.studies.experiments.experiment import Dataset, Task
from teamslam.sim.studies.experiments.team_runs import Figures, TimedRun, pair_name, scenario_task
from teamslam.sim.studies.experiments.xu import Method, with_particles
from teamslam.sim.world.config import UtiasWorld
from teamslam.team import translate
from teamslam.team.config import MotionModel, RobotConfig, Sensor
from teamslam.team.shapes import Float
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats
from teamslam.team.wire.bus import Sample

FRAME_S = 0.2
FRAMES = 1400  # frames of the report, roughly five minutes
MOTION = MotionModel(alphas=(0.1,) * 6, alpha_interval_s=0.02)
SENSOR = Sensor(range_sigma=0.0167**0.5, bearing_sigma=0.000736589**0.5)
START_SIGMA = 1e-3  # standard deviation of the program's initial covariance [m, rad]
PARTICLES = 100  # the program's default; not in the report
DEAD_RECKONING = Method("dead reckoning", "dead-reckoning", "alone", 1, VERMILION, PARTICLES)
SINGLE = Method("single FastSLAM", "fastslam1", "alone", 1, BLUE, PARTICLES)
MULTI_3 = Method("multi, 3 robots", "dead-reckoning", "joint-fastslam", 3, ORANGE, PARTICLES)
MULTI_5 = MULTI_3._replace(name="multi, 5 robots", robots=5, colour=GREEN)
OURS = Method("hybrid + join, 5 robots", "hybrid", "join", 5, BLACK, None)
"""Uses the models and figures of the scenario `utias`; all others use the program's."""
_COST_S = 4.0
_LINE_POINTS = 1400


def ma_task(dataset: Dataset, method: Method, seed: int) -> Task:
    """Make the run of one method on a set's first 1400 frames."""
    scenario = _scenario(method, seed)
    pair = pair_name(method.estimator, method.fusion)
    label = f"{dataset.name}, {method.robots} robots, {pair}, seed {seed}"
    return scenario_task("ma:ma_run", scenario, label, _COST_S * method.robots, dataset)


def _scenario(method: Method, seed: int) -> Scenario:
    scenario = with_options(
        load("utias"),
        seed=seed,
        robots=method.robots,
        estimator=method.estimator,
        fusion=method.fusion,
    )
    world, replace = scenario.world, msgspec.structs.replace
    assert isinstance(world, UtiasWorld)
    world = replace(world, duration_s=FRAMES * FRAME_S)
    if method.particles is None:
        return replace(scenario, world=world)
    world = replace(
        world, odometry_delay_s=0.0, start_sigma_m=START_SIGMA, start_sigma_rad=START_SIGMA
    )
    robots = tuple(_as_in_the_program(robot) for robot in scenario.robots)
    central = replace(scenario.central, broadcast_s=1.0)
    return with_particles(
        replace(scenario, world=world, robots=robots, central=central), method.particles
    )


def _as_in_the_program(robot: RobotConfig) -> RobotConfig:
    replace = msgspec.structs.replace
    front_end = replace(
        robot.front_end, resample_below=1.0, keyframe_s=0.0, window_s=1.0, window_m=0.0, biases=()
    )
    return replace(robot, motion=MOTION, sensor=SENSOR, front_end=front_end, pose_s=FRAME_S)


def ma_run(scenario: Mapping[str, Any], sha256: str, path: str) -> Figures:
    """Errors over frames of paths and map, and the last map."""
    resolved = with_options(loads(msgspec.json.encode(scenario).decode()), dataset=path)
    samples = list(TimedRun().samples(resolved))
    evaluation = evaluate(samples)
    paths = {
        name: (*estimated_poses(samples, pose_keys(resolved, name)), robot.truth)
        for name, robot in evaluation.robots.items()
    }
    start_ns = min(
        int(estimate.stamps_ns[0]) for estimate, _, _ in paths.values() if len(estimate.stamps_ns)
    )
    ids, positions = true_landmarks(samples)
    truth = dict(zip(ids.tolist(), positions, strict=True))
    robots = {name: _robot(*estimate, start_ns) for name, estimate in paths.items()}
    first = resolved.robots[0].id
    return {
        "robots": robots,
        "map": _map(samples, first, truth, start_ns),
        "clouds": _clouds(samples, first),
        "truth": positions.tolist(),
    }


def _frames(stamps_ns: np.ndarray, start_ns: int) -> list[float]:
    return short((stamps_ns - start_ns) * 1e-9 / FRAME_S)


def _robot(
    estimate: Path, covariances: Float[np.ndarray, "K 3 3"], true: Path, start_ns: int
) -> Figures:
    thinned = max(1, -(-len(estimate.poses) // _LINE_POINTS))
    end_ns = int(estimate.stamps_ns[-1]) if len(estimate.stamps_ns) else 0
    there = (true.stamps_ns >= start_ns) & (true.stamps_ns <= end_ns)
    every = max(1, -(-int(there.sum()) // _LINE_POINTS))
    found = pose_errors(estimate, covariances, true)
    return {
        "line": estimate.poses[::thinned, :2].round(3).tolist(),
        "truth": true.poses[there][::every, :2].round(3).tolist(),
        "end_block": covariances[-1, :2, :2].tolist() if len(covariances) else None,
        "curve": None
        if found is None
        else {
            "time_s": _frames(found.stamps_ns, start_ns),
            "error_m": short(np.hypot(found.errors[:, 0], found.errors[:, 1])),
            "sigma_m": short(np.hypot(found.sigmas[:, 0], found.sigmas[:, 1])),
            "nees": [found.nees_per_dof],
        },
    }


def _map(
    samples: list[Sample], robot: str, truth: Mapping[int, np.ndarray], start_ns: int
) -> Figures | None:
    maps = running_maps(samples, robot)
    if not maps:
        return None
    errors, sigmas = [], []
    for each in maps:
        ids, means = translate.landmarks_of(each)
        true = np.array([truth[int(landmark)] for landmark in ids])
        blocks = translate.landmark_blocks_of(each)
        errors.append(float(np.hypot(*(means - true).T).mean()))
        sigmas.append(float(np.sqrt(np.trace(blocks, axis1=1, axis2=2)).mean()))
    _, means = translate.landmarks_of(maps[-1])
    return {
        "curve": {
            "time_s": _frames(np.array([each.stamp_ns for each in maps]), start_ns),
            "error_m": short(np.array(errors)),
            "sigma_m": short(np.array(sigmas)),
        },
        "means": means.tolist(),
        "blocks": translate.landmark_blocks_of(maps[-1]).tolist(),
    }


def _clouds(samples: list[Sample], robot: str) -> list[list[list[float]]]:
    clouds = [
        floats(message.poses, "poses").reshape(-1, 3)[:, :2].round(3).tolist()
        for message in messages(samples, ch.PARTICLES.key(robot))
        if isinstance(message, m.ParticleCloud)
    ]
    every = max(1, len(clouds) // 8)
    return clouds[::-1][::every][:8]
