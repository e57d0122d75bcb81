"""Accuracy over seeds: the team's map against the truth, and against the batch MAP of the same log.

    python benchmarks/accuracy.py --seeds 30 --scenarios thesis thesis-b -o accuracy.json

Runs each seed (in one process on the bus in memory, or with --processes as `teamslam launch`), the
batch MAP over the raw readings of its log, and holds the figures against the goals; exit status 1
if one is missed. Under a rule without trajectories the batch starts from what `join` makes of the
same readings. Without GTSAM it is left out.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import msgspec
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from sim.evaluation import Evaluation, evaluate
from sim.in_memory import run_team
from sim.limit import Limit, LimitError, batch_map
from sim.scenario import Scenario, load, with_options
from sim.source import streams_of
from team.estimation.consistency import chi2_interval
from team.recording.reader import open_log
from team.wire.bus import Sample

LAUNCH_TIMEOUT_S = 600


class Goal(NamedTuple):
    """What a figure over all seeds must be."""

    figure: str
    least: float
    most: float


GOALS = (
    Goal("ratio", 0.0, 1.15),
    Goal("map_nees_per_dof_mean", 0.85, 1.15),
    Goal("in_band", 0.90, 1.0),
    Goal("uplink_bytes_per_step", 0.0, 64.0),
    Goal("each_once", 1.0, 1.0),
)
"""The ratio is of landmark RMSE to that of the batch MAP."""


@dataclass(frozen=True)
class Run:
    """The figures of one seed; None: not computed."""

    scenario: str
    seed: int
    landmark_rmse_m: float
    landmark_rmse_aligned_m: float | None
    map_nees_per_dof: float
    in_band: bool
    joint_cost_per_dof: float | None
    position_rmse_m: float | None
    final_pose_nees_per_dof: float | None
    online_pose_nees_per_dof: float | None
    uplink_bytes_per_step: float
    each_once: bool
    final_map_sha256: str
    batch_rmse_m: float | None = None
    batch_nees_per_dof: float | None = None
    batch_in_band: bool | None = None
    batch_position_rmse_m: float | None = None
    batch_final_pose_nees_per_dof: float | None = None


def run_of(name: str, seed: int, samples: Sequence[Sample], joined: Sequence[Sample]) -> Run:
    """The figures of one log, with the batch over the same readings where that can be had.

    joined: a log of the same readings under the rule `join`.
    """
    evaluation = evaluate(samples)
    if evaluation.map is None or evaluation.map.errors is None:
        raise RuntimeError(f"{name}, seed {seed}: the run left no map that could be judged")
    try:
        limit: Limit | None = batch_map(joined)
    except LimitError as error:
        print(f"{name}, seed {seed}: no batch: {error}", file=sys.stderr)
        limit = None
    return Run(
        name, seed, **_team_figures(evaluation), **({} if limit is None else _limit_figures(limit))
    )


def _team_figures(evaluation: Evaluation) -> dict[str, Any]:
    robots = list(evaluation.robots.values())
    fused = evaluation.map
    assert fused is not None
    assert fused.errors is not None
    steps = sum(r.consumption.steps for r in robots)
    return {
        "landmark_rmse_m": fused.errors.rmse_m,
        "landmark_rmse_aligned_m": fused.errors.aligned_rmse_m,
        "map_nees_per_dof": fused.errors.nees_per_dof,
        "in_band": fused.errors.in_band,
        "joint_cost_per_dof": fused.cost_per_dof,
        "position_rmse_m": mean(r.smoothed.position_rmse_m for r in robots if r.smoothed),
        "final_pose_nees_per_dof": mean(r.final_pose_nees_per_dof for r in robots),
        "online_pose_nees_per_dof": mean(r.online.nees_per_dof for r in robots if r.online),
        "uplink_bytes_per_step": sum(r.uplink_bytes or 0 for r in robots) / steps,
        "each_once": all(
            r.consumption.each_once and r.consumption.consumed == r.consumption.published
            for r in robots
        ),
        "final_map_sha256": fused.payload_sha256,
    }


def _limit_figures(limit: Limit) -> dict[str, Any]:
    errors = limit.errors
    return {
        "batch_rmse_m": None if errors is None else errors.rmse_m,
        "batch_nees_per_dof": None if errors is None else errors.nees_per_dof,
        "batch_in_band": None if errors is None else errors.in_band,
        "batch_position_rmse_m": mean(limit.position_rmse_m.values()),
        "batch_final_pose_nees_per_dof": mean(limit.final_pose_nees_per_dof.values()),
    }


def mean(values: Iterable[float | None]) -> float | None:
    """The mean of the values that there are."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def rms(values: Iterable[float | None]) -> float | None:
    """The root of the mean square of the values that there are."""
    square = mean(None if value is None else value * value for value in values)
    return None if square is None else square**0.5


def summary(runs: Sequence[Run]) -> dict[str, float | None]:
    """The figures over all seeds of one scenario."""
    ours, batch = rms(r.landmark_rmse_m for r in runs), rms(r.batch_rmse_m for r in runs)
    return {
        "seeds": len(runs),
        "landmark_rmse_m": ours,
        "batch_rmse_m": batch,
        "ratio": None if ours is None or batch is None else ours / batch,
        "landmark_rmse_aligned_m": rms(r.landmark_rmse_aligned_m for r in runs),
        "map_nees_per_dof_mean": mean(r.map_nees_per_dof for r in runs),
        "map_nees_per_dof_median": median(r.map_nees_per_dof for r in runs),
        "in_band": fmean(r.in_band for r in runs),
        "batch_nees_per_dof_mean": mean(r.batch_nees_per_dof for r in runs),
        "batch_in_band": mean(r.batch_in_band for r in runs),
        "joint_cost_per_dof": mean(r.joint_cost_per_dof for r in runs),
        "position_rmse_m": rms(r.position_rmse_m for r in runs),
        "batch_position_rmse_m": rms(r.batch_position_rmse_m for r in runs),
        "final_pose_nees_per_dof": mean(r.final_pose_nees_per_dof for r in runs),
        "batch_final_pose_nees_per_dof": mean(r.batch_final_pose_nees_per_dof for r in runs),
        "online_pose_nees_per_dof": mean(r.online_pose_nees_per_dof for r in runs),
        "uplink_bytes_per_step": mean(r.uplink_bytes_per_step for r in runs),
        "each_once": fmean(r.each_once for r in runs),
    }


def missed(figures: dict[str, float | None]) -> list[str]:
    """The goals that are not reached, in words; a figure that is not there misses no goal."""
    return [
        f"{goal.figure} is {value:.3f}, not in [{goal.least:g}, {goal.most:g}]"
        for goal in GOALS
        if (value := figures[goal.figure]) is not None and not goal.least <= value <= goal.most
    ]


def in_memory(scenario: Scenario) -> list[Sample]:
    """One run on the bus in memory."""
    return list(run_team(scenario, streams_of(scenario)))


def joining(scenario: Scenario) -> Scenario:
    """The same world, robots and seed under the default estimator and rule."""
    return with_options(scenario, estimator="hybrid", fusion="join")


def launched(name: str, scenario: Scenario) -> list[Sample]:
    """One run as real processes; its log."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        command = [
            str(Path(sys.executable).with_name("teamslam")), "launch", name,
            "--seed", str(scenario.seed), "--speed", "max", "--record", str(log),
            "--json", str(Path(folder) / "run.json"),
            "--fusion", scenario.fusion, "--estimator", scenario.estimator,
        ]  # fmt: skip
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=LAUNCH_TIMEOUT_S, check=False
        )
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: status {done.returncode}\n{done.stderr}")
        return list(open_log(log).samples())


def tuned(scenario: Scenario, window_s: float | None, particles: int | None) -> Scenario:
    """The scenario with another window or number of particles for every robot."""
    changes = {"window_s": window_s, "particles": particles}
    changes = {key: value for key, value in changes.items() if value is not None}
    robots = tuple(
        msgspec.structs.replace(r, front_end=msgspec.structs.replace(r.front_end, **changes))
        for r in scenario.robots
    )
    return msgspec.structs.replace(scenario, robots=robots)


def table(figures: dict[str, dict[str, float | None]], seeds: int) -> Table:
    """The figures of all scenarios, a column each, with the goals."""
    low, high = chi2_interval(36, 0.95, seeds)
    shown = Table(
        title=f"{seeds} seeds",
        caption=f"95 % band of the mean NEES, {seeds} maps of 18 landmarks: {low:.3f} … {high:.3f}",
    )
    shown.add_column("figure")
    for name in figures:
        shown.add_column(name, justify="right")
    shown.add_column("goal")
    goals = {goal.figure: f"{goal.least:g} … {goal.most:g}" for goal in GOALS}
    for figure in next(iter(figures.values())):
        values = [scenario[figure] for scenario in figures.values()]
        cells = ["–" if value is None else f"{value:.4g}" for value in values]
        shown.add_row(figure, *cells, goals.get(figure, ""))
    return shown


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=30, help="seeds first … first + N − 1")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--scenarios", nargs="+", default=["thesis", "thesis-b"])
    parser.add_argument("--estimator", default=None)
    parser.add_argument("--fusion", default=None)
    parser.add_argument("--window-s", type=float, default=None, help="in memory only")
    parser.add_argument("--particles", type=int, default=None, help="in memory only")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--processes", action="store_true", help="as `teamslam launch`")
    how.add_argument("--in-memory", action="store_true", help="in one process (the default)")
    parser.add_argument("-o", "--output", type=Path, default=None, help="write the figures as JSON")
    chosen = parser.parse_args()
    if chosen.processes and (chosen.window_s is not None or chosen.particles is not None):
        parser.error("--window-s and --particles can not be handed to `teamslam launch`")
    return chosen


def main() -> int:
    options = arguments()
    runs: dict[str, list[Run]] = {}
    for name in options.scenarios:
        runs[name] = []
        for seed in range(options.first, options.first + options.seeds):
            scenario = with_options(
                load(name), seed=seed, estimator=options.estimator, fusion=options.fusion
            )
            scenario = tuned(scenario, options.window_s, options.particles)
            samples = launched(name, scenario) if options.processes else in_memory(scenario)
            joined = samples if scenario.fusion == "join" else in_memory(joining(scenario))
            run = run_of(name, seed, samples, joined)
            runs[name].append(run)
            batch = "–" if run.batch_rmse_m is None else f"{run.batch_rmse_m:.3f}"
            print(
                f"{name} seed {seed}: {run.landmark_rmse_m:.3f} m (batch {batch} m), "
                f"NEES/dof {run.map_nees_per_dof:.3f}",
                file=sys.stderr,
            )
    figures = {name: summary(of_one) for name, of_one in runs.items()}
    Console(width=100).print(table(figures, options.seeds))
    misses = [f"{name}: {miss}" for name in figures for miss in missed(figures[name])]
    for miss in misses:
        print(f"missed: {miss}")
    if options.output is not None:
        content = {
            "figures": figures,
            "missed": misses,
            "runs": {name: [asdict(run) for run in of_one] for name, of_one in runs.items()},
        }
        options.output.write_text(json.dumps(content, indent=1) + "\n")
    return 1 if misses else 0


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
