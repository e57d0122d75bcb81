"""Figures 3 and 5 of Ma & Ma's report: paths and maps on a UTIAS set."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from teamslam.central.desk.drawing import RED, SKY, TRUTH_COLOUR, colour_of
from teamslam.sim.studies.experiments.drawing import as_map, draw_map, figure
from teamslam.sim.studies.experiments.experiment import (
    Dataset,
    Options,
    Outcome,
    Picture,
    Results,
    Table,
    without_datasets,
)
from teamslam.sim.studies.experiments.ma import DEAD_RECKONING, MULTI_3, MULTI_5, SINGLE, ma_task
from teamslam.sim.studies.experiments.task import Task
from teamslam.sim.studies.experiments.team_runs import Figures
from teamslam.sim.studies.experiments.xu import Method

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.axes import Axes

CLOUD_COLOUR = SKY


class PathFigure(NamedTuple):
    """Paths of some methods side by side, of the first seed."""

    title: str
    methods: tuple[Method, ...]
    remark: str

    def tasks(self, options: Options) -> list[Task]:
        """One run per method and set."""
        return [
            ma_task(dataset, method, options.seeds[0])
            for dataset in options.datasets
            for method in self.methods
        ]

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
                draw = _Drawing(f"{self.title}: {dataset.name}", tuple(runs))
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


@dataclass(frozen=True)
class _Drawing:
    title: str
    runs: tuple[tuple[Method, Figures], ...]

    def __call__(self, path: Path) -> None:
        picture = figure(6.5 * len(self.runs), 7.2)
        row = picture.subplots(1, len(self.runs), squeeze=False)[0]
        for axis, (method, run) in zip(row, self.runs, strict=True):
            _draw(axis, run)
            axis.set_title(method.name, fontsize=11)
        picture.suptitle(self.title)
        picture.savefig(path, dpi=110)


def _draw(axis: "Axes", run: Figures) -> None:
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


FIGURE_3 = PathFigure(
    "Ma & Ma, figure 3",
    (DEAD_RECKONING, SINGLE),
    "The report prints the paths without figures. Its dead reckoning is the particle filter "
    "without measurements; ours is the Gaussian of the same motion, so (a) has an ellipse at the "
    "end and (b) the cloud. The odometry is as logged; with the calibrated models of the scenario "
    "`utias` dead reckoning drifts less.",
)
FIGURE_5 = PathFigure(
    "Ma & Ma, figure 5",
    (MULTI_3, MULTI_5),
    "The report shows three robots and names a video of five. The poses are the centre's, at "
    "measurements of landmarks; its particles are not sent, so the picture has none.",
)
