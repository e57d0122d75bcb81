"""Section 3.5 of W. Xu's thesis: a particle filter localises on a known map.

As figures 3.2 to 3.5 (Fox et al. 2000): the filter's three steps after a stretch without
measurements, and an unknown start.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from teamslam.central.desk.drawing import BLACK, BLUE, RED, ROBOT_COLOURS, TRUTH_COLOUR, VERMILION
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load, loads, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.estimators import localisation
from teamslam.sim.studies.estimators.localisation import Localisation
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.sim.studies.experiments.curves import true_landmarks
from teamslam.sim.studies.experiments.drawing import as_map, figure, spread
from teamslam.sim.studies.experiments.experiment import (
    Options,
    Outcome,
    Picture,
    Results,
    Table,
    Task,
    combine_outcomes,
)
from teamslam.sim.studies.experiments.team_runs import Figures, with_world
from teamslam.sim.studies.experiments.xu import ErrorFigure, Method, Panel, with_particles
from teamslam.sim.studies.rules.team_keyframes import RobotKeyframe, TeamKeyframes
from teamslam.sim.world.config import SimulatedWorld
from teamslam.team import core, translate
from teamslam.team.estimation.consistency import nees
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import generator
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import opened

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.axes import Axes

STRETCH = ((28.715, 33.276), (51.298, 53.539), (64.3, 67.3))
"""Part of robot 1's path, as in figure 3.2."""
STRETCH_STEPS = 49
BLIND_CLOUDS = 6
PARTICLES = 1000
ANYWHERE_PARTICLES = 20_000
ANYWHERE_STEPS = (0, 1, 40)
DRAWN = 2000
STAGES = ("prediction", "update", "resampling")
_COST_S = 1.0

DEAD = Method("dead reckoning", "dead-reckoning", "alone", 1, VERMILION, None)
FEW = Method("localisation, 50 particles", "localisation", "alone", 1, BLUE, 50)
MANY = Method("localisation, 1000 particles", "localisation", "alone", 1, BLACK, PARTICLES)
ERRORS = ErrorFigure(
    "Thesis, section 3.5: pose error on the known map",
    "pose",
    (Panel("", (DEAD, FEW, MANY), {}),),
    (),
)


def outcome(options: Options, results: Results) -> Outcome:
    """Pictures of the steps, the unknown start, the errors."""
    stages = results.of_all([_stages_task(options, seed) for seed in options.seeds])
    anywhere = results.of_all([_anywhere_task(options, seed) for seed in options.seeds])
    errors = ERRORS.outcome(options, results)
    pictures = []
    if stages:
        pictures += [
            Picture(name, caption, partial(_draw_stage, stages[0], name))
            for name, caption in zip(STAGES, _captions(stages[0]), strict=True)
        ]
    if anywhere:
        pictures.append(
            Picture(
                "anywhere",
                "Figure 3.5 (a), (b), (c): a start anywhere, with the farthest landmark read at "
                f"each step. Dots: one in ten of {ANYWHERE_PARTICLES} particles; the circle is the "
                "true position. "
                f"Seed {options.seeds[0]}.",
                partial(_draw_anywhere, anywhere[0]),
            )
        )
    columns = ("step", "distance [m]", "10 … 90 %", "σ [m]", "NEES/dof", "ESS", "different poses")
    rows = []
    if stages and anywhere:
        rows += [(f"blind for {STRETCH_STEPS} steps, {n}", *_row(stages, n)) for n in STAGES]
        rows += [(f"anywhere, step {n}", *_row(anywhere, str(n))) for n in ANYWHERE_STEPS]
    table = Table(
        f"Thesis, section 3.5: the filter's steps, {options.seed_count}",
        columns,
        tuple(rows),
        "distance: of the particles' mean from the true position; σ: √(σx² + σy²) of the "
        "particles; medians over the seeds; NEES: of the position, mean over the seeds, 1 is "
        "right; ESS: effective sample size, eq. 3.25",
    )
    figures = {
        "stages": {name: _numbers(stages, name) for name in STAGES} if stages else {},
        "anywhere": {str(s): _numbers(anywhere, str(s)) for s in ANYWHERE_STEPS}
        if anywhere
        else {},
    }
    remarks = (
        "The thesis takes its figures 3.2 to 3.5 from Fox et al. 2000, made with a laser or sonar "
        "in a building; here they are made on its own world of 18 landmarks with its own noise. "
        f"It names no number of particles for them: {PARTICLES} here, {ANYWHERE_PARTICLES} for a "
        "start anywhere, since enough of them must fit the first measurements.",
        "Resampling changes no information: mean and spread stay, but many particles become copies "
        "of few; the next motion spreads them again.",
    )
    first = Outcome(
        "Thesis, section 3.5: particle-filter localisation on a known map",
        figures,
        (table,) if table.rows else (),
        tuple(pictures),
        remarks=remarks,
    )
    return combine_outcomes(
        first.title, (first, replace(errors, figures={"errors": errors.figures}))
    )


def _stages_task(options: Options, seed: int) -> Task:
    scenario = with_world(_alone(seed, PARTICLES), paths=(STRETCH,), steps=STRETCH_STEPS)
    return _task("stages_run", scenario, options, seed)


def _anywhere_task(options: Options, seed: int) -> Task:
    scenario = _alone(seed, ANYWHERE_PARTICLES)
    assert isinstance(scenario.world, SimulatedWorld)
    leg = _cut_first_leg(scenario.world)
    scenario = with_world(scenario, steps=ANYWHERE_STEPS[-1], paths=(leg,))
    return _task("anywhere_run", scenario, options, seed)


def _cut_first_leg(world: SimulatedWorld) -> tuple[tuple[float, float], ...]:
    (x, y), (to_x, to_y) = world.paths[0][:2]
    part = ANYWHERE_STEPS[-1] / float(np.hypot(to_x - x, to_y - y))
    return (x, y), (x + part * (to_x - x), y + part * (to_y - y))


def _alone(seed: int, particles: int) -> Scenario:
    scenario = with_options(
        load("thesis"), seed=seed, robots=1, estimator="localisation", fusion="alone"
    )
    return with_particles(scenario, particles)


def _task(work: str, scenario: Scenario, options: Options, seed: int) -> Task:
    return Task(
        f"teamslam.sim.studies.experiments.xu_localisation:{work}",
        {"world": msgspec.to_builtins(scenario), "clouds": seed == options.seeds[0]},
        f"thesis, section 3.5, {work.partition('_')[0]}, seed {seed}",
        _COST_S,
    )


@dataclass(frozen=True)
class _Run:
    scenario: Scenario
    keyframes: list[RobotKeyframe]
    start: np.ndarray
    ids: np.ndarray
    landmarks: Float[np.ndarray, "L 2"]
    truth: Mapping[int, np.ndarray]


def _run_of(world: Mapping[str, Any]) -> _Run:
    scenario = loads(msgspec.json.encode(world).decode())
    config = scenario.robots[0]
    samples = list(run_team(scenario, streams_of(scenario)))
    cut = TeamKeyframes([config.id])
    cut.configure(config.id, config)
    for message in (opened(sample)[2] for sample in samples):
        match message:
            case m.Measurement() if not isinstance(message, m.Sightings):
                cut.put(message)
            case m.End():
                cut.end(message)
            case _:
                pass
    starts = cut.starts
    assert starts is not None
    pose, _ = translate.pose_of(starts[config.id][1])
    ids, landmarks = true_landmarks(samples)
    truth = evaluate(samples).robots[config.id].truth
    return _Run(
        scenario,
        [step[0] for step in cut.steps()],
        np.zeros(3) if pose is None else pose,
        ids,
        landmarks,
        dict(zip(truth.stamps_ns.tolist(), truth.poses, strict=True)),
    )


def stages_run(world: Mapping[str, Any], clouds: bool) -> Figures:
    """Predict over the stretch, weigh by one measurement, resample."""
    run = _run_of(world)
    robot = run.scenario.robots[0]
    random = generator(run.scenario.seed, robot.id, 0, 0)
    state = replace(
        localisation.initial_state(run.start, PARTICLES, run.ids, run.landmarks), resample_below=0.0
    )
    blind = [state]
    for each in run.keyframes:
        step = RobotStep(robot.id, each.increment, robot.sensor)
        blind.append(localisation.filter_step(blind[-1], step, random))
    last = run.keyframes[-1]
    true = run.truth[last.stamp_ns]
    # The landmark farthest to the left: as in figure 3.3.
    ids, ranges, bearings = last.scan.ids, last.scan.ranges, last.scan.bearings
    k = int(np.argmax(bearings))
    measurement = ids[k : k + 1], ranges[k : k + 1], bearings[k : k + 1]
    step = RobotStep(robot.id, Increment.identity(), robot.sensor, *measurement)
    weighed = localisation.filter_step(blind[-1], step, random)
    cloud, _ = fastslam.resampled(weighed.cloud, random)
    resampled = replace(weighed, cloud=cloud)
    found: Figures = {
        name: _summary(each, true)
        for name, each in zip(STAGES, (blind[-1], weighed, resampled), strict=True)
    }
    if clouds:
        places = np.linspace(0, len(run.keyframes), BLIND_CLOUDS + 1).round().astype(int)[1:]
        found["clouds"] = {
            "blind": [_cloud(blind[k].cloud, DRAWN // BLIND_CLOUDS) for k in places],
            "blind_steps": places.tolist(),
            "update": _cloud(weighed.cloud, DRAWN),
            "resampling": _cloud(resampled.cloud, DRAWN),
        }
        found["path"] = [run.start[:2].tolist()] + [
            run.truth[each.stamp_ns][:2].tolist() for each in run.keyframes
        ]
        found["true"] = true.tolist()
        found["landmarks"] = run.landmarks.tolist()
        found["read"] = {
            "landmark": run.landmarks[np.searchsorted(run.ids, measurement[0][0])].tolist(),
            "range_m": float(measurement[1][0]),
        }
    return found


def anywhere_run(world: Mapping[str, Any], clouds: bool) -> Figures:
    """Localise from a uniform cloud."""
    run = _run_of(world)
    config = run.scenario.robots[0]
    assert isinstance(run.scenario.world, SimulatedWorld)
    random = generator(run.scenario.seed, config.id, 0, 0)
    side = run.scenario.world.size_m
    state = localisation.initial_state_anywhere(
        np.zeros(2), np.full(2, side), ANYWHERE_PARTICLES, run.ids, run.landmarks, random
    )
    found: Figures = {"0": _summary(state, run.start)}
    drawn = [_cloud(state.cloud, DRAWN)]
    poses = [run.start.tolist()]
    for k, each in enumerate(run.keyframes, 1):
        ids, ranges, bearings = each.scan.ids, each.scan.ranges, each.scan.bearings
        far = np.argsort(ranges)[-1:]  # all of them would localise at once
        measurements = ids[far], ranges[far], bearings[far]
        step = RobotStep(config.id, each.increment, config.sensor, *measurements)
        state = localisation.filter_step(state, step, random)
        if k in ANYWHERE_STEPS:
            true = run.truth[each.stamp_ns]
            found[str(k)] = _summary(state, true)
            # The next resampling removes particles without weight.
            drawn.append(_cloud(fastslam.resampled(state.cloud, random)[0], DRAWN))
            poses.append(true.tolist())
    if clouds:
        found |= {"clouds": drawn, "poses": poses, "landmarks": run.landmarks.tolist()}
    return found


def _summary(state: Localisation, true: np.ndarray) -> Figures:
    mean, covariance = localisation.pose_gaussian(state)
    off = mean[:2] - true[:2]
    return {
        "distance_m": float(np.hypot(*off)),
        "sigma_m": float(np.sqrt(np.trace(covariance[:2, :2]))),
        "heading_error_deg": float(abs(np.degrees(wrapped(mean[2] - true[2])))),
        "nees_per_dof": nees(off, covariance[:2, :2]) / 2.0,
        "effective": core.effective_sample_size(state.cloud.log_weights),
        "different": len(np.unique(state.cloud.poses, axis=0)),
    }


def _cloud(particles: Particles, most: int) -> Figures:
    every = max(1, len(particles.poses) // most)
    weights = np.exp(particles.log_weights[::every])
    return {
        "points": particles.poses[::every, :2].round(2).tolist(),
        "weights": (weights / weights.max()).round(4).tolist(),
    }


def _row(runs: list[Figures], name: str) -> tuple[str, ...]:
    found = _numbers(runs, name)
    distance = found["distance_m"]
    return (
        f"{distance['median']:.2f}",
        f"{distance['p10']:.2f} … {distance['p90']:.2f}",
        f"{found['sigma_m']['median']:.2f}",
        f"{found['nees_per_dof']:.2f}",
        f"{found['effective']['median']:.0f}",
        f"{found['different']['median']:.0f}",
    )


def _numbers(runs: list[Figures], name: str) -> Figures:
    def over_runs(key: str) -> Float[np.ndarray, " S"]:
        return np.array([run[name][key] for run in runs], dtype=np.float64)

    return {
        key: spread(over_runs(key))
        for key in ("distance_m", "sigma_m", "heading_error_deg", "effective", "different")
    } | {"nees_per_dof": float(over_runs("nees_per_dof").mean())}


def _captions(run: Figures) -> tuple[str, str, str]:
    steps = ", ".join(map(str, run["clouds"]["blind_steps"]))
    return (
        f"As figure 3.2, prediction: the particles after {steps} steps without a measurement, "
        "from a start that is known exactly at the lower left; grey: the true path.",
        "As figure 3.3, update: one measurement of the landmark in the circle of its range; the "
        "darker a particle, the higher its weight.",
        "As figure 3.4, resampling: particles in proportion to their weights, all with the same "
        "weight again.",
    )


def _draw_stage(run: Figures, name: str, path: Path) -> None:
    picture = figure(7.5, 7.2)
    axis = picture.add_subplot()
    clouds = run["clouds"]
    axis.plot(*np.array(run["path"]).T, color=TRUTH_COLOUR, linewidth=1.0, label="true path")
    if name == "prediction":
        for k, cloud in enumerate(clouds["blind"]):
            _scatter(axis, cloud, "particles" if not k else None)
    else:
        _scatter(axis, clouds[name], "particles")
        (x, y), radius = run["read"]["landmark"], run["read"]["range_m"]
        turns = np.linspace(0.0, 2.0 * np.pi, 200)
        axis.plot(
            x + radius * np.cos(turns), y + radius * np.sin(turns), color=ROBOT_COLOURS[1],
            linewidth=1.0, linestyle="--", label="the range that was read",
        )  # fmt: skip
    _draw_place(axis, run["landmarks"], run["true"])
    summary = run[name]
    axis.set_title(
        f"{name}: mean {summary['distance_m']:.1f} m from the truth, "
        f"σ {summary['sigma_m']:.1f} m, ESS {summary['effective']:.0f} of {PARTICLES}",
        fontsize=11,
    )
    axis.set_xlim(15, 95)
    axis.set_ylim(15, 95)
    picture.legend(fontsize=9, loc="outside lower center", ncols=3, frameon=False)
    picture.savefig(path, dpi=110)


def _scatter(axis: "Axes", cloud: Figures, label: str | None) -> None:
    points, weights = np.array(cloud["points"]), np.array(cloud["weights"])
    order = np.argsort(weights)
    shades = np.column_stack(
        (np.zeros(len(weights)), np.full((len(weights), 1), 0.27), np.full((len(weights), 1), 0.7))
    )
    alpha = 0.12 + 0.88 * weights[order] if np.ptp(weights) > 0 else np.full(len(weights), 0.35)
    xs, ys = points[order].T
    axis.scatter(
        xs, ys, s=7, color=np.column_stack((shades, alpha)), linewidths=0, label=label,
        zorder=3,
    )  # fmt: skip


def _draw_place(axis: "Axes", landmarks: list[list[float]], true: list[float]) -> None:
    axis.plot(*np.array(landmarks).T, linestyle="", marker="x", color=RED, label="known landmarks")
    axis.plot(
        true[0], true[1], marker="o", markersize=10, markerfacecolor="none",
        markeredgecolor=BLACK, linestyle="", label="true position", zorder=6,
    )  # fmt: skip
    as_map(axis)


def _draw_anywhere(run: Figures, path: Path) -> None:
    picture = figure(16.0, 5.8)
    row = picture.subplots(1, len(ANYWHERE_STEPS), sharey=True)
    for letter, axis, step, cloud, pose in zip(
        "abc", row, ANYWHERE_STEPS, run["clouds"], run["poses"], strict=True
    ):
        _scatter(axis, cloud, "particles")
        _draw_place(axis, run["landmarks"], pose)
        axis.set_title(f"({letter}) step {step}: σ {run[str(step)]['sigma_m']:.1f} m", fontsize=11)
        axis.set_xlim(-5, 105)
        axis.set_ylim(-5, 105)
    handles = row[0].get_legend_handles_labels()
    picture.legend(*handles, fontsize=9, loc="outside lower center", ncols=3, frameon=False)
    picture.savefig(path, dpi=100)
