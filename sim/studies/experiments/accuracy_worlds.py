"""Simulated worlds under every estimator and rule, with the batch MAP."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments.experiment import (
    Goal,
    Options,
    Outcome,
    Results,
    Table,
    Task,
    seed_count,
)
from teamslam.sim.studies.experiments.team_runs import (
    OURS,
    Figures,
    Shown,
    over_seeds,
    pair_name,
    table_of,
    team_task,
)
from teamslam.team.pairs import PAIRS


class World(NamedTuple):
    """Scenario, maximum seeds, and goals of the default pair.

    rules: every valid pair runs. batch: with the batch MAP.
    """

    scenario: str
    most_seeds: int
    goals: Mapping[str, tuple[float, float]]
    rules: bool = False
    batch: bool = True


OTHERS_SEEDS = 10  # most seeds of pairs for comparison
_THESIS = {
    "nees": (0.93, 1.07),
    "in_band": (0.90, 1.0),
    "final_pose_nees": (0.85, 1.15),
    "online_pose_nees": (0.85, 1.15),
    "bytes_per_step": (0.0, 64.0),
    "each_once": (1.0, 1.0),
}
_RANDOM = {"ratio": (0.0, 1.15), "nees": (0.8, 1.2)}
WORLDS = (
    World("thesis", 100_000, {"ratio": (0.0, 1.08)} | _THESIS, rules=True),
    World("thesis-b", 100_000, {"ratio": (0.0, 1.10)} | _THESIS, rules=True),
    World("random-3", 20, _RANDOM),
    World("random-5", 20, _RANDOM),
    World("random-10", 10, _RANDOM),
    World("large", 1, {}, batch=False),
)
SHOWN: Shown = (
    ("rmse", "RMSE [m]", "{:.3f}"),
    ("ratio", "÷ batch", "{:.2f}"),
    ("rmse_aligned", "aligned [m]", "{:.3f}"),
    ("nees", "NEES/dof", "{:.3g}"),
    ("nees_median", "median", "{:.3g}"),
    ("in_band", "in band", "{:.0%}"),
    ("covariance_scale", "scale", "{:.2f}"),
    ("final_pose_nees", "final pose", "{:.3g}"),
    ("online_pose_nees", "online pose", "{:.3g}"),
    ("bytes_per_step", "B/step", "{:.0f}"),
)


def outcome(options: Options, results: Results) -> Outcome:
    """Figures of all worlds and rules."""
    worlds: dict[str, dict[str, Figures]] = {}
    goals: list[Goal] = []
    tables: list[Table] = []
    cells = _cells(options)
    for world in _worlds(options):
        runs = {rule: results.of_all(cell) for rule, cell in cells[world.scenario].items()}
        figures = world_figures(runs)
        worlds[world.scenario] = figures
        goals += _goals(world, figures.get(pair_name(*OURS), {}))
        seeds = seed_count(figures.get(pair_name(*OURS), {}).get("seeds", 0))
        tables.append(table_of(f"{world.scenario}, {seeds}", "rule", figures, SHOWN))
    return Outcome("simulated worlds", {"worlds": worlds}, tuple(tables), goals=tuple(goals))


def world_figures(runs: Mapping[str, Sequence[Figures]]) -> dict[str, Figures]:
    """Figures of each rule, and of the batch. ratio: RMS landmark error over the batch's."""
    figures = {rule: over_seeds(of_rule) for rule, of_rule in runs.items() if of_rule}
    batches = {
        run["seed"]: run["batch"] for run in runs.get(pair_name(*OURS), []) if "batch" in run
    }
    if batches:
        figures["batch"] = over_seeds(list(batches.values())) | {"ratio": 1.0}
    for rule, of_rule in runs.items():
        both = [run for run in of_rule if run["seed"] in batches]
        if both:
            same = over_seeds([batches[run["seed"]] for run in both])
            figures[rule]["ratio"] = _ratio(over_seeds(both)["rmse"], same["rmse"])
    return figures


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference


def _worlds(options: Options) -> list[World]:
    return [world for world in WORLDS if not (options.quick and world.scenario == "large")]


def _cells(options: Options) -> dict[str, dict[str, list[Task]]]:
    return {
        world.scenario: {
            pair_name(*pair): [
                _task(world, pair, seed)
                for seed in options.seeds[: world.most_seeds if pair == OURS else OTHERS_SEEDS]
            ]
            for pair in (PAIRS if world.rules else [OURS])
        }
        for world in _worlds(options)
    }


def _task(world: World, pair: tuple[str, str], seed: int) -> Task:
    estimator, fusion = pair
    scenario = with_options(load(world.scenario), seed=seed, estimator=estimator, fusion=fusion)
    return team_task(scenario, batch=world.batch and pair == OURS)


def _goals(world: World, figures: Figures) -> list[Goal]:
    return [
        Goal(f"{world.scenario}: {name}", figures.get(name), least, most)
        for name, (least, most) in world.goals.items()
    ]
