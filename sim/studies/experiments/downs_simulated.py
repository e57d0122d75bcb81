"""Tables 5.1 … 5.5 of J. Downs' thesis on his simulator: 10 and 100 landmarks, one run a seed.

He ran it thirty times for each (section 4.2) and prints no figure. Methods and t-tests are those of
the tables. It has one robot; for table 5.5, two robots start at its centre together.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import ttest_rel

from teamslam.central.desk.drawing import BLACK, BLUE, GREEN, ORANGE, RED, TRUTH_COLOUR, VERMILION
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.studies.experiments.downs_joined import (
    final_maps_only,
    spherical_task,
    whole_run_task,
)
from teamslam.sim.studies.experiments.drawing import as_map, draw_map, figure, ruled, spread
from teamslam.sim.studies.experiments.experiment import Options, Outcome, Picture, Results, Table
from teamslam.sim.studies.experiments.task import Task
from teamslam.sim.studies.experiments.team_runs import Figures, table_of, team_task, with_world

WORLDS = ("downs-10", "downs-100")
TEAM = 2
QUICK_STEPS = 300
STARTED, ALIGNED = "rmse", "rmse_aligned"
"""Errors of a raw map, and after the rigid motion that fits it to the truth."""


class Simulated(NamedTuple):
    """A method on the simulator: its name, run, robots and colour.

    robot: figures of robot 1; else of `part`, or of the run.
    """

    name: str
    task: Callable[[Scenario], Task]
    robots: int
    colour: str
    robot: bool = False
    part: str | None = None

    def of(self, run: Figures, name: str) -> float | None:
        """One figure of a run."""
        place: Mapping[str, float | None] = run
        if self.robot:
            place = run["robots"]["r1"]
        elif self.part is not None:
            place = run[self.part]
        return place.get(name)


def _ekf(scenario: Scenario) -> Task:
    return whole_run_task(with_options(scenario, estimator="ekf-slam", fusion="alone"))


def _ours(scenario: Scenario) -> Task:
    return team_task(final_maps_only(scenario))


EKF = Simulated("EKF", _ekf, 1, VERMILION, robot=True)
HIS_JOINED = Simulated("joined, his protocol", spherical_task, TEAM, ORANGE, robot=True)
OUR_JOINED = Simulated("joined, ours", _ours, 1, BLUE)
HIS_TEAM = Simulated("team, his protocol", spherical_task, TEAM, GREEN, part="team")
OUR_TEAM = Simulated("team, ours", _ours, TEAM, BLACK)


class SimulatedTable(NamedTuple):
    """The simulator's part of a table. figures: names and headings.

    compared: pairs of methods for the t-test. sample: draw a map of the first method, as in figure
    5.1.
    """

    methods: tuple[Simulated, ...]
    figures: tuple[tuple[str, str], ...]
    compared: tuple[tuple[Simulated, Simulated], ...] = ()
    sample: bool = False

    def tasks(self, options: Options) -> list[Task]:
        """Every world, method and seed, and runs for the t-tests."""
        found = [
            _task(world, method, options, seed)
            for world in WORLDS
            for method in self._needed()
            for seed in options.seeds
        ]
        return list({task.name: task for task in found}.values())

    def outcome(self, title: str, options: Options, results: Results) -> Outcome:
        """Errors over the seeds, t-tests, and every run as a dot."""
        errors = self._errors(options, results)
        if not errors:
            return Outcome(title, {})
        table = Table(
            f"{title}: his simulator, {options.seed_count} [m]",
            ("landmarks, method", "runs", "median", "10 … 90 %", "mean", "sd", "the run"),
            tuple((name, *_cells(values)) for name, values in errors.items()),
            f"nothing is printed of it; the run: seed {options.seeds[0]}",
        )
        tests = self._tests(options, results)
        tables = [table]
        if tests:
            title_of_tests = "paired t-test of the simulator's maps as they lie"
            tables.append(t_test_table(title_of_tests, "before → after", tests))
        picture = Picture(
            "simulator",
            f"{title}: runs on his simulator, one dot a seed on a logarithmic scale; bar: the "
            f"median; ringed: the run of seed {options.seeds[0]}.",
            partial(self._draw, title, errors),
        )
        figures: Figures = {
            "simulator": {name: _numbers(values) for name, values in errors.items()},
            "simulator_t_tests": tests,
        }
        pictures = [picture]
        for world in WORLDS if self.sample else ():
            run = results.of(_task(world, self.methods[0], options, options.seeds[0]))
            if run is not None:
                name = f"{world.partition('-')[2]} landmarks, seed {options.seeds[0]}"
                pictures.append(sample_picture(f"sample-{world}", name, run["sample"]))
        return Outcome(title, figures, tuple(tables), tuple(pictures))

    def _needed(self) -> list[Simulated]:
        compared = [method for pair in self.compared for method in pair]
        return list(dict.fromkeys([*self.methods, *compared]))

    def _errors(self, options: Options, results: Results) -> dict[str, list[float]]:
        found = {}
        for world in WORLDS:
            count = world.partition("-")[2]
            for method in self.methods:
                for name, suffix in self.figures:
                    values = list(_values_by_seed(world, method, name, options, results).values())
                    if values:
                        found[f"{count}, {method.name}{suffix}"] = values
        return found

    def _tests(self, options: Options, results: Results) -> dict[str, Figures]:
        found = {}
        for world in WORLDS:
            for pair in self.compared:
                before, after = (_values_by_seed(world, m, STARTED, options, results) for m in pair)
                both = [(before[seed], after[seed]) for seed in before if seed in after]
                if both:
                    name = f"{world.partition('-')[2]}, {pair[0].name} → {pair[1].name}"
                    found[name] = paired_test(both)
        return found

    def _draw(self, title: str, errors: Mapping[str, Sequence[float]], path: Path) -> None:
        colours = {method.name: method.colour for method in self.methods}
        picture = figure(9.0, 1.4 + 0.5 * len(errors))
        axis = picture.add_subplot()
        for row, (name, values) in enumerate(errors.items()):
            colour = next(c for method, c in colours.items() if f", {method}" in name)
            heights = row + 0.25 * np.linspace(-1.0, 1.0, len(values))
            axis.plot(values, heights, linestyle="", marker=".", color=colour)
            axis.plot(values[0], heights[0], linestyle="", marker="o", markersize=10,
                      markerfacecolor="none", color=colour)  # fmt: skip
            axis.plot([np.median(values)] * 2, [row - 0.35, row + 0.35], color=colour)
        axis.set_yticks(range(len(errors)), list(errors), fontsize=9)
        axis.invert_yaxis()
        axis.set_xscale("log")
        axis.set_xlabel("RMSE [m]")
        axis.set_title(f"{title}\nhis simulator", fontsize=11)
        ruled(axis)
        picture.savefig(path, dpi=120)


def sample_picture(name: str, title: str, sample: Figures) -> Picture:
    """A map of the EKF, as his figure 5.1."""
    return Picture(
        name,
        f"As figure 5.1, a map of the EKF: {title}, {sample['robot']}. Ellipses: 95 % of "
        "the map's covariances; crosses are the true landmarks, grey the true path.",
        partial(_draw_sample, title, sample),
    )


def _draw_sample(title: str, sample: Figures, path: Path) -> None:
    picture = figure(7.5, 7.5)
    axis = picture.add_subplot()
    for key, colour, label in (
        ("truth", TRUTH_COLOUR, "true path"),
        ("online", EKF.colour, f"{sample['robot']}, online"),
    ):
        axis.plot(*np.array(sample[key]).reshape(-1, 2).T, color=colour, linewidth=1.0, label=label)
    axis.plot(
        *np.array(sample["landmarks"]).reshape(-1, 2).T, linestyle="", marker="x",
        color=RED, label="true landmarks",
    )  # fmt: skip
    draw_map(axis, sample["means"], sample["blocks"], label="map, 95 %")
    as_map(axis, adjustable="datalim")
    axis.set_title(f"EKF: {title}", fontsize=11)
    picture.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    picture.savefig(path, dpi=110)


def _task(world: str, method: Simulated, options: Options, seed: int) -> Task:
    scenario = with_options(load(world), robots=method.robots, seed=seed)
    return method.task(with_world(scenario, steps=QUICK_STEPS) if options.quick else scenario)


def _values_by_seed(
    world: str, method: Simulated, name: str, options: Options, results: Results
) -> dict[int, float]:
    found = {}
    for seed in options.seeds:
        run = results.of(_task(world, method, options, seed))
        value = None if run is None else method.of(run, name)
        if value is not None:
            found[seed] = value
    return found


def paired_test(pairs: Sequence[tuple[float, float]]) -> Figures:
    """Paired two-sided t-test of figures before and after; p None below two pairs."""
    both = np.array(pairs).reshape(-1, 2)
    return {
        "pairs": len(both),
        "mean_before_m": float(both[:, 0].mean()) if len(both) else None,
        "mean_after_m": float(both[:, 1].mean()) if len(both) else None,
        "p": float(ttest_rel(both[:, 0], both[:, 1]).pvalue) if len(both) > 1 else None,
    }


def t_test_table(title: str, first: str, tests: Mapping[str, Figures], note: str = "") -> Table:
    """Table of paired t-tests by name; first: heading of the names."""
    shown = (
        ("pairs", "pairs", "{}"),
        ("mean_before_m", "mean before [m]", "{:.3g}"),
        ("mean_after_m", "mean after [m]", "{:.3g}"),
        ("p", "p", "{:.3g}"),
    )
    return table_of(title, first, tests, shown, note)


def _cells(values: Sequence[float]) -> list[str]:
    found = _numbers(values)
    sd = "–" if found["sd"] is None else f"{found['sd']:.3g}"
    return [
        str(len(values)), f"{found['median']:.3g}", f"{found['p10']:.3g} … {found['p90']:.3g}",
        f"{found['mean']:.3g}", sd, f"{values[0]:.3g}",
    ]  # fmt: skip


def _numbers(values: Sequence[float]) -> Figures:
    return spread(np.array(values)) | {
        "mean": float(np.mean(values)),
        "sd": float(np.std(values, ddof=1)) if len(values) > 1 else None,
        "runs": list(values),
    }


_MAPS = ((STARTED, ""), (ALIGNED, ", aligned"))
_PATHS = (("position_rmse", ""),)
SIMULATED_5_1 = SimulatedTable((EKF,), _MAPS, sample=True)
SIMULATED_5_2 = SimulatedTable((EKF,), _PATHS)
SIMULATED_5_3 = SimulatedTable(
    (EKF, HIS_JOINED, OUR_JOINED), _MAPS, ((EKF, HIS_JOINED), (EKF, OUR_JOINED))
)
SIMULATED_5_4 = SimulatedTable((HIS_JOINED, OUR_JOINED), _PATHS)
SIMULATED_5_5 = SimulatedTable(
    (HIS_JOINED, OUR_JOINED, HIS_TEAM, OUR_TEAM),
    _MAPS,
    ((HIS_JOINED, HIS_TEAM), (OUR_JOINED, OUR_TEAM)),
)
