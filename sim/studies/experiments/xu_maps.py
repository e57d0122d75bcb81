"""Figures 4.1 to 4.3 and 5.1 of W. Xu's thesis: maps of one run."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from teamslam.central.desk.drawing import RED, TRUTH_COLOUR, colour_of
from teamslam.sim.studies.experiments.drawing import as_map, draw_map, figure, sample_curve, spread
from teamslam.sim.studies.experiments.experiment import (
    Options,
    Outcome,
    Picture,
    Results,
    Table,
    Task,
    combine_outcomes,
)
from teamslam.sim.studies.experiments.team_runs import Figures
from teamslam.sim.studies.experiments.xu import (
    EKF,
    ERRORS_4_5,
    FASTSLAM,
    HYBRID,
    HYBRID_CODED,
    MULTI_CODED,
    MULTI_HYBRID,
    OUR_TEAM,
    OURS,
    STEP_S,
    ErrorFigure,
    Method,
    Panel,
    Reading,
    task as curves_of,
)

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.axes import Axes


STEPS = 500


class _MapFigure(NamedTuple):
    """Maps at some steps of one run, and the error over seeds.

    shown: methods with their reading.
    """

    title: str
    shown: tuple[tuple[Method, Reading], ...]
    steps: tuple[int, ...]
    remarks: tuple[str, ...]

    def outcome(self, options: Options, results: Results) -> Outcome:
        """A picture and a row per method."""
        rows, pictures, figures = [], [], {}
        for method, reading in self.shown:
            run = results.of(_run(method, reading, options.seeds[0], self.steps))
            runs = results.of_all([_run(method, reading, seed) for seed in options.seeds])
            if run is None:
                continue
            label = _name_of(method, reading)
            pictures += self._pictures(label, run, options.seeds[0])
            curves = [each["map"] for each in runs if each["map"]["time_s"]]
            times = STEP_S * np.array(self.steps, dtype=np.float64)
            errors = np.array(
                [sample_curve(times, each, "error_m", stepwise=True) for each in curves]
            )
            errors = errors.reshape(-1, len(times))
            figures[label] = {
                str(shot["step"]): {"run_m": shot["rmse_m"]}
                | (spread(errors[:, k]) if _known(errors[:, k : k + 1]) else {})
                for k, shot in enumerate(run["shots"])
            }
            rows.append((label, *(_cell(each) for each in figures[label].values())))
        table = Table(
            f"{self.title}: landmark RMSE [m], {options.seed_count}",
            ("method", *(f"step {step}" for step in self.steps)),
            tuple(rows),
            f"the drawn run, seed {options.seeds[0]}; in brackets median (10 … 90 %) of the seeds",
        )
        return Outcome(
            self.title, {"rmse_m": figures}, (table,), tuple(pictures), remarks=self.remarks
        )

    def _pictures(self, label: str, run: Figures, seed: int) -> list[Picture]:
        name = label.replace(" ", "-").replace(",", "").lower()
        pictures = []
        for k, shot in enumerate(run["shots"]):
            letter = chr(ord("a") + k) if len(self.steps) > 1 else ""
            title = f"{self.title}{f' ({letter})' if letter else ''}: {label}"
            caption = (
                f"{title}, seed {seed}, step {shot['step']}. Ellipses: 95 % of the map's "
                "covariances; crosses are the true landmarks, grey the true paths."
            )
            file = f"{name}-{letter}-step-{shot['step']}" if letter else name
            drawing = partial(_draw_shot, title, shot, run["landmarks"])
            pictures.append(Picture(file, caption, drawing))
        return pictures


def _run(method: Method, reading: Reading, seed: int, shots: tuple[int, ...] = ()) -> Task:
    return curves_of(Panel(_READ[reading], (method,), {}, reading=reading), method, seed, shots)


def _name_of(method: Method, reading: Reading) -> str:
    return method.name if "," in method.name else f"{method.name}, {_READ[reading]}"


def _known(errors: np.ndarray) -> bool:
    return bool(errors.size) and not bool(np.isnan(errors).any())


def _cell(of_step: Figures) -> str:
    run = "–" if of_step["run_m"] is None else f"{of_step['run_m']:.2f}"
    if "median" not in of_step:
        return run
    return f"{run} ({of_step['median']:.2f}; {of_step['p10']:.2f} … {of_step['p90']:.2f})"


def _draw_shot(title: str, shot: Figures, landmarks: Sequence[Any], path: Path) -> None:
    picture = figure(6.5, 6.8)
    axis = picture.subplots()
    _draw(axis, shot, np.array(landmarks))
    error = "" if shot["rmse_m"] is None else f", landmark RMSE {shot['rmse_m']:.2f} m"
    axis.set_title(f"step {shot['step']}{error}", fontsize=10)
    handles = axis.get_legend_handles_labels()
    picture.legend(*handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    picture.suptitle(title)
    picture.savefig(path, dpi=110)


def _draw(axis: "Axes", shot: Figures, landmarks: np.ndarray) -> None:
    axis.plot(*landmarks.T, linestyle="", marker="x", color=RED, label="true landmarks")
    draw_map(axis, shot["means"], shot["blocks"], label="map, 95 %")
    _draw_paths(axis, shot)


def _draw_paths(axis: "Axes", shot: Figures) -> None:
    for i, (name, lines) in enumerate(shot["paths"].items()):
        colour = colour_of(i)
        for kind, each, width in (("truth", TRUTH_COLOUR, 0.8), ("online", colour, 1.4)):
            points = np.array(lines[kind]).reshape(-1, 2)
            label = f"{name}, online" if kind == "online" else "true path" if not i else None
            axis.plot(points[:, 0], points[:, 1], color=each, linewidth=width, label=label)
    axis.set_xlim(-10, 110)
    axis.set_ylim(-10, 110)
    as_map(axis)


class _PathFigure(NamedTuple):
    errors: ErrorFigure

    def outcome(self, options: Options, results: Results) -> Outcome:
        """A picture per panel, then the errors."""
        pictures = []
        for panel in self.errors.panels:
            runs = [
                (method, results.of(curves_of(panel, method, options.seeds[0], (STEPS,))))
                for method in panel.methods
            ]
            drawn = [(method.name, run["shots"][0]) for method, run in runs if run is not None]
            if drawn:
                name = f"paths-{panel.name.partition(',')[0].replace(' ', '-')}"
                caption = (
                    f"As figure 4.5, paths: {panel.name}, seed {options.seeds[0]}; grey: the truth."
                )
                pictures.append(
                    Picture(name, caption, partial(_draw_side_by_side, panel.name, drawn))
                )
        errors = self.errors.outcome(options, results)
        return combine_outcomes(
            errors.title, (Outcome(errors.title, {}, pictures=tuple(pictures)), errors)
        )


def _draw_side_by_side(title: str, drawn: Sequence[tuple[str, Figures]], path: Path) -> None:
    picture = figure(5.2 * len(drawn), 5.8)
    row = picture.subplots(1, len(drawn), squeeze=False)[0]
    for axis, (name, shot) in zip(row, drawn, strict=True):
        _draw_paths(axis, shot)
        axis.set_title(name, fontsize=11)
    handles = row[0].get_legend_handles_labels()
    picture.legend(*handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    picture.suptitle(f"Thesis, figure 4.5: {title}")
    picture.savefig(path, dpi=110)


_READ: Mapping[Reading, str] = {
    "stated": "as stated", "exact": "true controls", "coded": "as coded",
}  # fmt: skip
_PRINTED = (
    "The thesis prints the maps without figures. They are those of its program, with exact "
    "controls and a tiny spread of the particles (xu-4.4); as stated, with the noise of section "
    "4.4.2 in the odometry, the same filters end far from the truth."
)
_ROBOT_1 = (
    "In the text of figures 4.1 and 4.2 the robot starts at the lower left, (10, 40); that is "
    "robot 2's start in the appendix. Here, as in figure 4.3 and in the appendix, robot 1 starts "
    "at the right, (80, 40)."
)
FIGURE_4_1 = _MapFigure(
    "Thesis, figure 4.1",
    ((EKF, "stated"), (EKF, "coded"), (OURS, "stated")),
    (STEPS,),
    (_PRINTED, _ROBOT_1),
)
FIGURE_4_2 = _MapFigure(
    "Thesis, figure 4.2",
    ((FASTSLAM, "stated"), (FASTSLAM, "coded"), (OURS, "stated")),
    (STEPS,),
    (_PRINTED, _ROBOT_1),
)
FIGURE_4_3 = _MapFigure(
    "Thesis, figure 4.3",
    ((HYBRID, "stated"), (HYBRID_CODED, "coded"), (OURS, "stated")),
    (STEPS,),
    (_PRINTED,),
)
FIGURE_5_1 = _MapFigure(
    "Thesis, figure 5.1",
    ((MULTI_HYBRID, "stated"), (MULTI_CODED, "coded"), (OUR_TEAM, "stated")),
    (20, 100, 200, STEPS),
    (
        _PRINTED,
        "As written, the ellipses shrink to nothing far from the true landmarks: each exchange "
        "counts every measurement again.",
    ),
)
FIGURE_4_5 = _PathFigure(ERRORS_4_5)
