"""Several runs side by side: a column for each, a row for each figure, and one picture."""

from collections.abc import Callable, Mapping, Sequence
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from central.desk.drawing import GREY, robot_colours
from central.desk.evaluation.evaluation import Evaluation, RobotResult
from central.desk.names import in_order
from central.desk.pictures.run import new_figure
from central.desk.pictures.style import save
from central.desk.report.tables import shown

Row = tuple[str, tuple[str, ...]]


def compare_rows(runs: Mapping[str, Evaluation]) -> list[Row]:
    """(figure, one cell per run); "–" where a run has none."""
    every = list(runs.values())
    rows = [(name, tuple(of(run) for run in every)) for name, of in _TEAM]
    matched = tuple(run.matched_by for run in every)
    rows += [("landmark errors by", matched)] if any(matched) else []
    for robot in in_order({name for run in every for name in run.robots}):
        results = [run.robots.get(robot) for run in every]
        rows += [
            (f"{robot}: {name}", tuple("–" if r is None else of(r) for r in results))
            for name, of in _ROBOT
        ]
    return rows


def compare_figures(runs: Mapping[str, Evaluation]) -> dict[str, Any]:
    """By run and figure, as `compare_rows` has them, for machines."""
    rows = compare_rows(runs)
    return {name: {row[0]: row[1][k] for row in rows} for k, name in enumerate(runs)}


def compare_picture(runs: Mapping[str, Evaluation], path: Path) -> bool:
    """Map error, map NEES and path errors of every run; False where none has truth.

    A run without true landmarks has its paths' errors only.
    """
    errors = [None if run.map is None else run.map.errors for run in runs.values()]
    paths = [_aligned(each) for run in runs.values() for each in run.robots.values()]
    if not any(errors) and np.isnan(paths).all():
        return False
    figure, (axes,) = new_figure(max(9.0, 2.5 + 1.2 * len(runs)), 4.2, 1, 3)
    names = list(runs)
    at = range(len(names))
    axes[0].bar(at, [(e and e.aligned_rmse_m) or 0.0 for e in errors], color=GREY)
    axes[0].set_title("landmark RMSE, aligned [m]", fontsize=10)
    axes[1].plot(at, [e.nees_per_dof if e else np.nan for e in errors], "o", color=GREY)
    for k, error in enumerate(errors):
        if error is not None:
            axes[1].plot([k, k], error.band, color=GREY, linewidth=6.0, alpha=0.25)
    axes[1].axhline(1.0, color=GREY, linewidth=0.7)
    axes[1].set_title("map NEES per dof, 95 % band", fontsize=10)
    colours = robot_colours({name for run in runs.values() for name in run.robots})
    for robot, colour in colours.items():
        paths = [_aligned(run.robots.get(robot)) for run in runs.values()]
        axes[2].plot(at, paths, "o-", color=colour, linewidth=0.7, label=robot)
    axes[2].set_title("path RMSE, aligned [m]", fontsize=10)
    axes[2].legend(frameon=False, fontsize=8)
    for axis in axes:
        axis.set_xticks(list(at), names, rotation=20, ha="right", fontsize=8)
        axis.grid(axis="y", color="#eeeeee", linewidth=0.6)
        axis.set_axisbelow(True)
    save(figure, path)
    return True


def _aligned(robot: RobotResult | None) -> float:
    value = None if robot is None else robot.aligned_rmse_m
    return float("nan") if value is None else value


def _errors(run: Evaluation, name: str, form: str) -> str:
    """A figure of the map's errors; of a map in an arbitrary frame only the aligned ones."""
    errors = None if run.map is None else run.map.errors
    if errors is None or (run.arbitrary_frame and name != "aligned_rmse_m"):
        return "–"
    return shown(getattr(errors, name), form, "")


def _smoothed(robot: RobotResult, name: str) -> float | None:
    return None if robot.smoothed is None else float(getattr(robot.smoothed, name))


def _settings(run: Evaluation) -> str:
    return "–" if run.scenario is None else run.title


def _method(run: Evaluation) -> str:
    scenario = run.scenario
    return "–" if scenario is None else f"{scenario.estimator} + {scenario.fusion}"


_TEAM: Sequence[tuple[str, Callable[[Evaluation], str]]] = (
    ("scenario", _settings),
    ("method", _method),
    ("landmarks", lambda r: "–" if r.map is None else str(len(r.map.ids))),
    ("landmark RMSE [m]", lambda r: _errors(r, "rmse_m", ".4f")),
    ("after rigid alignment [m]", lambda r: _errors(r, "aligned_rmse_m", ".4f")),
    ("map NEES per dof", lambda r: _errors(r, "nees_per_dof", ".4g")),
    (
        "joint cost per dof",
        lambda r: shown(None if r.map is None else r.map.cost_per_dof, ".4g", ""),
    ),
    (
        "covariance scale",
        lambda r: shown(None if r.map is None else r.map.covariance_scale, ".2f", ""),
    ),
    ("final map, its bytes", lambda r: "–" if r.map is None else r.map.payload_sha256[:16]),
)
_ROBOT: Sequence[tuple[str, Callable[[RobotResult], str]]] = (
    ("path RMSE, aligned [m]", lambda r: shown(r.aligned_rmse_m, ".4f", "")),
    (
        "heading RMSE [°]",
        lambda r: shown(
            None if r.smoothed is None else degrees(r.smoothed.heading_rmse_rad), ".3f", ""
        ),
    ),
    ("pose NEES per dof", lambda r: shown(_smoothed(r, "nees_per_dof"), ".3g", "")),
    ("online RMSE, aligned [m]", lambda r: shown(r.online_aligned_rmse_m, ".4f", "")),
    ("uplink [B/step]", lambda r: shown(r.uplink_bytes_per_step, ".1f", "")),
)
