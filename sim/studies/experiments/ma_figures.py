"""Figures of Ma & Ma's report: errors over 1400 frames (4, 6), paths and maps (3, 5)."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from teamslam.central.desk.drawing import RED, SKY, TRUTH_COLOUR, colour_of
from teamslam.sim.studies.experiments.drawing import Curves, as_map, draw_map, figure
from teamslam.sim.studies.experiments.experiment import (
    Dataset,
    Options,
    Outcome,
    Picture,
    Results,
    Table,
    Task,
    without_datasets,
)
from teamslam.sim.studies.experiments.ma import (
    DEAD_RECKONING,
    FRAMES,
    MULTI_3,
    MULTI_5,
    OURS,
    SINGLE,
    ma_task,
)
from teamslam.sim.studies.experiments.team_runs import Figures
from teamslam.sim.studies.experiments.xu import Method, Panel, draw_curves, numbers, row
from teamslam.team.shapes import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class _ErrorFigure(NamedTuple):
    """Errors over frames. of: "path" of robot 1, or "map", its landmarks' mean distance.

    printed: mean error [m] by method.
    """

    title: str
    of: str
    methods: tuple[Method, ...]
    printed: Mapping[str, float]
    remarks: tuple[str, ...]

    def outcome(self, options: Options, results: Results) -> Outcome:
        """Medians and bands beside the printed figures."""
        if not options.datasets:
            return Outcome(self.title, {}, missing=(without_datasets(self.title),))
        figures, rows, pictures = {}, [], []
        for dataset in options.datasets:
            panel = Panel(dataset.name, self.methods, {})
            found = self._curves(dataset, options, results)
            rows += [
                self._row(panel, method, found[method.name])
                for method in self.methods
                if method.name in found
            ]
            figures[dataset.name] = {
                name: numbers(panel, name, curves) | {"mean_m": float(np.median(_mean(curves)))}
                for name, curves in found.items()
            }
            if found:
                caption = (
                    f"{self.title}: {dataset.name}. Above: medians over {options.seed_count} "
                    "with the 10 … 90 % band. Below: the run of seed "
                    f"{options.seeds[0]} within its own 3σ bound. Without landmarks "
                    "the filters publish no pose, and the curve is flat."
                )
                title = f"{self.title}: {dataset.name}"
                draw = partial(draw_curves, title, panel, found, "frame")
                pictures.append(Picture(dataset.name, caption, draw))
        columns = ("set, method", "printed mean [m]", "mean [m]", "run's max [m]", "max [m]",
                   "10 … 90 %", "RMS [m]", "end [m]", "NEES/dof")  # fmt: skip
        table = Table(
            f"{self.title}, {options.seed_count}",
            columns,
            tuple(rows),
            f"the run: seed {options.seeds[0]}; all else: median over the seeds, of hybrid + join "
            "that run alone; NEES: 1 is right",
        )
        return Outcome(self.title, figures, (table,), tuple(pictures), remarks=self.remarks)

    def _row(self, panel: Panel, method: Method, curves: Curves) -> tuple[str, ...]:
        printed = self.printed.get(method.name)
        return (
            f"{panel.name}, {method.name}",
            "–" if printed is None else f"{printed:g}",
            f"{np.median(_mean(curves)):.2f}",
            *row(panel, method, curves)[1:],
        )

    def _curves(self, dataset: Dataset, options: Options, results: Results) -> dict[str, Curves]:
        frames = np.arange(1.0, FRAMES + 1.0)
        found = {}
        for method in self.methods:
            runs = results.of_all(_runs(dataset, method, options))
            curves = [curve for run in runs if (curve := _curve(run, self.of)) is not None]
            if curves:
                found[method.name] = Curves.on(frames, curves, stepwise=True)
        return found


def _runs(dataset: Dataset, method: Method, options: Options) -> list[Task]:
    seeds = options.seeds[:1] if method == OURS else options.seeds
    return [ma_task(dataset, method, seed) for seed in seeds]


def _curve(run: Figures, of: str) -> Figures | None:
    part = run["map"] if of == "map" else next(iter(run["robots"].values()), None)
    curve: Figures | None = None if part is None else part["curve"]
    return curve


def _mean(curves: Curves) -> Float[np.ndarray, " S"]:
    means: Float[np.ndarray, " S"] = np.nanmean(curves.errors, axis=1)
    return means


_PROGRAM = (
    "The report names neither parameters nor the set. Its program does: the start is that of set "
    "2, every α is 0.1 at 0.02 s, σ are 0.13 m and 0.027 rad; the particles are its default, 100 "
    "(its last configuration has 1). Printed figures are means over the run, from the text."
)
_RAW = (
    "The odometry is as logged, as in the program. In these sets the base drives 5 % faster than "
    "logged and turns 6 % less, with a delay of a quarter of a second: persistent errors, which "
    "the α of independent errors cannot represent. Our profile models them, so our errors are "
    "smaller for that reason, too, not by fusion alone."
)
_POSES = (
    "As in the report several robots are better than one (measured on set 2). One filter over the "
    "poses of all robots with so few particles degenerates, however: each resampling discards "
    "paths of all robots, and the reported σ is far too small (NEES)."
)
FIGURE_4A = _ErrorFigure(
    "Ma & Ma, figure 4(a): path, dead reckoning against single FastSLAM",
    "path",
    (DEAD_RECKONING, SINGLE),
    {SINGLE.name: 0.6},
    (_PROGRAM, _RAW),
)
FIGURE_4B = _ErrorFigure(
    "Ma & Ma, figure 4(b): path of single FastSLAM",
    "path",
    (SINGLE,),
    {SINGLE.name: 0.6},
    (_PROGRAM, _RAW),
)
FIGURE_4C = _ErrorFigure(
    "Ma & Ma, figure 4(c): landmarks of single FastSLAM",
    "map",
    (SINGLE,),
    {SINGLE.name: 0.6},
    (
        _PROGRAM,
        "The report sees this error converge. Ours steps up where landmarks come in that are first "
        "seen from a pose that has drifted; after that it hardly moves, since all particles share "
        "their early path.",
        _RAW,
    ),
)
_TEAMS = (SINGLE, MULTI_3, MULTI_5, OURS)
FIGURE_6A = _ErrorFigure(
    "Ma & Ma, figure 6(a): path of robot 1, single against multi",
    "path",
    _TEAMS,
    {SINGLE.name: 0.6, MULTI_3.name: 0.42},
    (_PROGRAM, _RAW, _POSES),
)
FIGURE_6B = _ErrorFigure(
    "Ma & Ma, figure 6(b): landmarks, single against multi",
    "map",
    _TEAMS,
    {SINGLE.name: 0.7, MULTI_3.name: 0.5},
    (_PROGRAM, "Printed: the error that the curve converges to.", _RAW, _POSES),
)


CLOUD_COLOUR = SKY


class _PathFigure(NamedTuple):
    title: str
    methods: tuple[Method, ...]
    remark: str

    def outcome(self, options: Options, results: Results) -> Outcome:
        """A picture per set, and mean errors."""
        if not options.datasets:
            return Outcome(self.title, {}, missing=(without_datasets(self.title),))
        figures, rows, pictures = {}, [], []
        for dataset in options.datasets:
            runs = self._runs(dataset, options, results)
            means = {method.name: _mean_errors(run) for method, run in runs}
            figures[dataset.name] = means
            rows += [
                (f"{dataset.name}, {name}, {robot}", f"{error:.2f}")
                for name, of_robots in means.items()
                for robot, error in of_robots.items()
            ]
            if runs:
                caption = (
                    f"{self.title}: {dataset.name}, seed {options.seeds[0]}. Grey: true paths; "
                    "crosses: true landmarks; ellipses: 95 % of the covariances; light blue: "
                    "particles at eight times."
                )
                draw = partial(_draw_runs, f"{self.title}: {dataset.name}", runs)
                pictures.append(Picture(dataset.name, caption, draw))
        table = Table(
            f"{self.title}: mean distance of the path [m]", ("robot", "mean [m]"), tuple(rows)
        )
        return Outcome(
            self.title, {"mean_m": figures}, (table,), tuple(pictures), remarks=(self.remark,)
        )

    def _runs(
        self, dataset: Dataset, options: Options, results: Results
    ) -> list[tuple[Method, Figures]]:
        found = [
            (method, results.of(ma_task(dataset, method, options.seeds[0])))
            for method in self.methods
        ]
        return [(method, run) for method, run in found if run is not None]


def _mean_errors(run: Figures) -> dict[str, float]:
    return {
        name: float(np.mean(robot["curve"]["error_m"]))
        for name, robot in run["robots"].items()
        if robot["curve"] is not None
    }


def _draw_runs(title: str, runs: list[tuple[Method, Figures]], path: Path) -> None:
    picture = figure(6.5 * len(runs), 7.2)
    row = picture.subplots(1, len(runs), squeeze=False)[0]
    for axis, (method, run) in zip(row, runs, strict=True):
        _draw_paths(axis, run)
        axis.set_title(method.name, fontsize=11)
    picture.suptitle(title)
    picture.savefig(path, dpi=110)


def _draw_paths(axis: "Axes", run: Figures) -> None:
    for i, (name, robot) in enumerate(run["robots"].items()):
        colour = colour_of(i)
        axis.plot(*np.array(robot["truth"]).reshape(-1, 2).T, color=TRUTH_COLOUR, linewidth=0.9)
        axis.plot(
            *np.array(robot["line"]).reshape(-1, 2).T, color=colour, linewidth=1.2,
            label=f"{name}, online",
        )  # fmt: skip
        if robot["end_block"] is not None and run["map"] is None:
            draw_map(axis, robot["line"][-1:], [robot["end_block"]], colour)
    for cloud in run["clouds"]:
        axis.plot(*np.array(cloud).T, linestyle="", marker=".", markersize=3, color=CLOUD_COLOUR,
                  zorder=4)  # fmt: skip
    axis.plot(
        *np.array(run["truth"]).T, linestyle="", marker="x", color=RED, label="true landmarks"
    )
    if run["map"] is not None:
        draw_map(axis, run["map"]["means"], run["map"]["blocks"])
    as_map(axis, adjustable="datalim")
    axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False)


FIGURE_3 = _PathFigure(
    "Ma & Ma, figure 3",
    (DEAD_RECKONING, SINGLE),
    "The report prints the paths without figures. Its dead reckoning is the particle filter "
    "without measurements; ours is the Gaussian of the same motion, so (a) has an ellipse at the "
    "end and (b) the cloud. The odometry is as logged; with the calibrated models of the scenario "
    "`utias` dead reckoning drifts less.",
)
FIGURE_5 = _PathFigure(
    "Ma & Ma, figure 5",
    (MULTI_3, MULTI_5),
    "The report shows three robots and names a video of five. The poses are the centre's, at "
    "measurements of landmarks; its particles are not sent, so the picture has none.",
)
