"""Run a team in memory and compare it with truth and batch optimum."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from statistics import fmean, median
from typing import Any

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import Evaluation, RobotResult
from teamslam.central.node import CentralNode, node_class
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.recorded.chains import BatchReferenceError
from teamslam.sim.scenarios.scenario import Scenario, loads, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.batch_reference.reference import BatchReference, NoiseKind, batch_map
from teamslam.sim.studies.experiments.experiment import Dataset, Table, Task
from teamslam.sim.studies.experiments.true_minimum import true_minimum
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import Estimator, Exchange, FusionRule, RobotConfig
from teamslam.team.robot.node import RobotNode, robot_node
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample

Figures = dict[str, Any]
Shown = Sequence[tuple[str, str, str]]
"""Columns of a table: the figure's name, the heading, the format."""
OURS: tuple[Estimator, FusionRule] = ("hybrid", "join")
_HYBRID_STEP_S, _STEP_S = 2e-3, 5e-4  # estimated time [s] of a robot's step
_STEPS_TO_A_WAY_POINT = 22
_DOUBLING_LANDMARKS = 100  # number of landmarks that doubles the time of a step
_UTIAS_S, _UTIAS_BATCH_S = 40.0, 160.0


def team_task(
    scenario: Scenario,
    *,
    batch: bool = False,
    minimum: bool = False,
    dataset: Dataset | None = None,
    note: str = "",
    noise: NoiseKind = "white",
) -> Task:
    """Make the task of a team's run.

    batch: with the batch MAP of this noise. minimum: with `true_minimum`.
    """
    pair = pair_name(scenario.estimator, scenario.fusion)
    place = scenario.name if dataset is None else dataset.name
    place += f", {note}" if note else ""
    return scenario_task(
        "team_runs:team_run",
        scenario,
        f"{place}, {len(scenario.robots)} robots, {pair}, seed {scenario.seed}",
        expected_s(scenario, batch=batch, minimum=minimum),
        dataset,
        batch=batch,
        noise=noise,
        **({"minimum": True} if minimum else {}),
    )


def expected_s(scenario: Scenario, *, batch: bool = False, minimum: bool = False) -> float:
    """Estimated CPU time [s] of a run."""
    world = scenario.world
    if not isinstance(world, SimulatedWorld):
        return _UTIAS_S + batch * _UTIAS_BATCH_S
    steps = world.steps
    if world.way_point_count:
        steps = min(steps, _STEPS_TO_A_WAY_POINT * world.way_point_count)
    a_step = _HYBRID_STEP_S if scenario.estimator == "hybrid" else _STEP_S
    landmarks = world.landmark_count or len(world.landmarks)
    a_step *= (1.0 + landmarks / _DOUBLING_LANDMARKS) * (1.0 + batch) * (1.0 + minimum)
    return a_step * steps * len(scenario.robots)


def scenario_task(
    work: str,
    scenario: Scenario,
    label: str,
    cost: float,
    dataset: Dataset | None = None,
    **parameters: Any,
) -> Task:
    """Make the task of a scenario, on a data set if given."""
    return Task(
        f"teamslam.sim.studies.experiments.{work}",
        {"scenario": msgspec.to_builtins(scenario)}
        | parameters
        | ({} if dataset is None else {"sha256": dataset.sha256}),
        label,
        cost,
        {} if dataset is None else {"path": str(dataset.path)},
    )


def with_world(scenario: Scenario, **changes: Any) -> Scenario:
    """Change values of the scenario's world."""
    world = msgspec.structs.replace(scenario.world, **changes)
    return msgspec.structs.replace(scenario, world=world)


def with_robots(scenario: Scenario, part: str, **changes: Any) -> Scenario:
    """Change a part of every robot's configuration."""
    replace = msgspec.structs.replace
    robots = (
        replace(robot, **{part: replace(getattr(robot, part), **changes)})
        for robot in scenario.robots
    )
    return replace(scenario, robots=tuple(robots))


def pair_name(estimator: str, fusion: str) -> str:
    """Name of a pair in tables."""
    return f"{estimator} + {fusion}"


def team_run(
    scenario: Mapping[str, Any],
    batch: bool,
    noise: NoiseKind = "white",
    minimum: bool = False,
    sha256: str = "",
    path: str | None = None,
) -> Figures:
    """Figures of one run, as in `team_task`."""
    resolved = with_options(loads(msgspec.json.encode(scenario).decode()), dataset=path)
    run = TimedRun()
    # Provisional maps and priors are the bulk of a large team's log and not used here.
    bulk = {ch.FUSED_MAP.key(), *(ch.PRIOR.key(robot.id) for robot in resolved.robots)}
    samples = [sample for sample in run.samples(resolved) if sample.key not in bulk]
    evaluation = evaluate(samples)
    figures: Figures = {"seed": resolved.seed} | team_figures(evaluation) | run.figures()
    if minimum:
        found = true_minimum(samples, evaluation)
        if found is not None:
            verdicts = {"wrong": found.wrong, "excluded": found.excluded}
            figures["minimum"] = found._asdict() | verdicts
    if batch:
        try:
            figures["batch"] = _reference_figures(batch_map(samples, noise))
        except BatchReferenceError as error:
            figures["batch_error"] = str(error)
    return figures


class TimedRun:
    """Team in memory, and CPU time [s] of robots and centre."""

    def __init__(self) -> None:
        self._robots = _Watch()
        self._centre = _Watch()
        self._steps = 0
        self._fusions = 0

    def samples(self, scenario: Scenario, streams: WorldStreams | None = None) -> Iterator[Sample]:
        """Run the team; yield the samples of its log."""
        measurements = streams_of(scenario) if streams is None else streams
        odometry = {ch.ODOMETRY.key(robot.id) for robot in scenario.robots}
        for sample in run_team(scenario, measurements, *self._nodes(scenario.central)):
            self._steps += sample.key in odometry
            self._fusions += sample.key == ch.FUSED_MAP.key()
            yield sample

    def figures(self) -> Figures:
        """Times in total, per interval and per fused map."""
        return {
            "robot_seconds": self._robots.seconds,
            "centre_seconds": self._centre.seconds,
            "seconds_per_step": self._robots.seconds / self._steps if self._steps else None,
            "seconds_per_fusion": self._centre.seconds / self._fusions if self._fusions else None,
        }

    def _nodes(
        self, config: CentralConfig
    ) -> tuple[Callable[[RobotConfig, Exchange], RobotNode], type[CentralNode]]:
        robots, centre = self._robots, self._centre

        def timed_robot(config: RobotConfig, exchange: Exchange) -> RobotNode:
            node = robot_node(config, exchange)
            handle = node.handle

            def timed(message: m.Message) -> list[Outgoing]:
                with robots:
                    return handle(message)

            node.handle = timed  # type: ignore[method-assign]
            return node

        class TimedCentre(node_class(config)):  # type: ignore[misc]
            def handle(self, message: m.Message) -> list[Outgoing]:
                with centre:
                    out: list[Outgoing] = super().handle(message)
                    return out

        return timed_robot, TimedCentre


class _Watch:
    """CPU time [s] that this process spends inside."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> None:
        self.seconds -= time.process_time()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.process_time()


def team_figures(evaluation: Evaluation) -> Figures:
    """Figures averaged over the robots; without a fused map of the robots' own."""
    robots = list(evaluation.robots.values())
    fused = evaluation.map
    own = [robot.own_map for robot in robots if robot.own_map is not None]
    maps = own if fused is None or fused.errors is None else [fused.errors]
    shapes = [errors.shape for errors in maps if errors.shape is not None]
    steps = sum(r.consumption.steps for r in robots)
    sent = sum(r.uplink_bytes or 0 for r in robots)
    return {
        "rmse": rms(errors.rmse_m for errors in maps),
        "rmse_aligned": rms(errors.aligned_rmse_m for errors in maps),
        "nees": mean(errors.nees_per_dof for errors in maps),
        "in_band": mean(float(errors.in_band) for errors in maps),
        "landmarks": mean(float(errors.count) for errors in maps),
        "coverage_raw": mean(errors.coverage for errors in maps),
        "shape_nees": mean(shape.nees_per_landmark for shape in shapes),
        "coverage": mean(shape.coverage for shape in shapes),
        "cost_per_dof": None if evaluation.map is None else evaluation.map.cost_per_dof,
        "covariance_scale": None if fused is None else fused.covariance_scale,
        "position_rmse": rms(r.smoothed.position_rmse_m for r in robots if r.smoothed),
        "position_rmse_aligned": rms(r.aligned_rmse_m for r in robots),
        "final_pose_nees": mean(r.final_pose_nees_per_dof for r in robots),
        "online_position_rmse": rms(r.online.position_rmse_m for r in robots if r.online),
        "online_position_rmse_aligned": rms(r.online_aligned_rmse_m for r in robots),
        "online_pose_nees": mean(r.online.nees_per_dof for r in robots if r.online),
        "bytes_per_step": sent / steps if steps else None,
        "each_once": all(
            r.consumption.each_once and r.consumption.consumed == r.consumption.published
            for r in robots
        ),
        "final_map_sha256": None if evaluation.map is None else evaluation.map.payload_sha256,
        "not_joined": [] if fused is None else [r for r in fused.reasons if "not joined" in r],
        "withdrawn": [
            name for name, robot in evaluation.states.items() if robot.state == "withdrawn"
        ],
        "reasons": [] if fused is None else list(fused.reasons),
        "robots": {name: _robot_figures(robot) for name, robot in evaluation.robots.items()},
    }


def _robot_figures(robot: RobotResult) -> Figures:
    smoothed, online = robot.smoothed, robot.online
    return {
        "position_rmse": None if smoothed is None else smoothed.position_rmse_m,
        "position_rmse_aligned": robot.aligned_rmse_m,
        "pose_nees": None if smoothed is None else smoothed.nees_per_dof,
        "first_pose_chi2": None if smoothed is None else float(smoothed.motion_nees[0]),
        "online_position_rmse": None if online is None else online.position_rmse_m,
        "online_pose_nees": None if online is None else online.nees_per_dof,
    }


def _reference_figures(reference: BatchReference) -> Figures:
    errors = reference.errors
    shape = None if errors is None else errors.shape
    return {
        "rmse": None if errors is None else errors.rmse_m,
        "rmse_aligned": None if errors is None else errors.aligned_rmse_m,
        "nees": None if errors is None else errors.nees_per_dof,
        "in_band": None if errors is None else errors.in_band,
        "shape_nees": None if shape is None else shape.nees_per_landmark,
        "coverage": None if shape is None else shape.coverage,
        "position_rmse": rms(reference.position_rmse_m.values()),
        "final_pose_nees": mean(reference.final_pose_nees_per_dof.values()),
    }


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the known values."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def middle(values: Iterable[float | None]) -> float | None:
    """Median of the known values."""
    known = [value for value in values if value is not None]
    return median(known) if known else None


def rms(values: Iterable[float | None]) -> float | None:
    """Root mean square of the known values."""
    square = mean(None if value is None else value * value for value in values)
    return None if square is None else square**0.5


OVER_SEEDS = (
    "rmse", "rmse_aligned", "nees", "in_band", "shape_nees", "coverage", "coverage_raw",
    "cost_per_dof", "covariance_scale", "position_rmse", "position_rmse_aligned",
    "final_pose_nees", "online_position_rmse", "online_position_rmse_aligned", "online_pose_nees",
    "bytes_per_step", "each_once", "robot_seconds", "centre_seconds", "seconds_per_step",
    "seconds_per_fusion",
)  # fmt: skip


def over_seeds(runs: Sequence[Figures]) -> Figures:
    """Figures over several runs: errors as RMS, others as mean."""
    figures: Figures = {"seeds": len(runs)}
    for name in OVER_SEEDS:
        if any(name in run for run in runs):
            average = rms if "rmse" in name else mean
            figures[name] = average(run.get(name) for run in runs)
            if name == "nees":
                figures["nees_median"] = middle(run.get(name) for run in runs)
    return figures


def table_of(
    title: str, first: str, figures: Mapping[str, Figures], shown: Shown, note: str = ""
) -> Table:
    """Table with a row for each set of figures."""

    def cell(of_row: Figures, name: str, form: str) -> str:
        return "–" if of_row.get(name) is None else form.format(of_row[name])

    rows = tuple(
        (name, *(cell(of_row, figure, form) for figure, _, form in shown))
        for name, of_row in figures.items()
    )
    return Table(title, (first, *(heading for _, heading, _ in shown)), rows, note)
