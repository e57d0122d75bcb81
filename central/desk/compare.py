"""Compare runs: one row per figure, one cell per run, and pictures."""

from collections.abc import Callable, Mapping, Sequence
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from teamslam.central.desk.drawing import (
    BLUE,
    GREY,
    TRUTH_COLOUR,
    VERMILION,
    draw_ellipses,
    landmark_blocks,
    robot_colours,
)
from teamslam.central.desk.evaluation.evaluation import Evaluation, MapResult, RobotResult
from teamslam.central.desk.names import OUTSIDE, in_order
from teamslam.central.desk.pictures.run import new_figure
from teamslam.central.desk.pictures.style import save
from teamslam.central.desk.report.tables import format_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = tuple[str, tuple[str, ...]]
MAP_STYLES = ((BLUE, "."), (VERMILION, "+"))


def compare_rows(runs: Mapping[str, Evaluation]) -> list[Row]:
    """Rows (figure, one cell per run), "–" for a missing figure.

    A run in an arbitrary frame has aligned errors only.
    """
    every = list(runs.values())
    rows = [(name, tuple(of(run) for run in every)) for name, of in _TEAM]
    matched = tuple(run.matched_by for run in every)
    rows += [("landmark errors by", matched)] if any(matched) else []
    for robot in in_order({name for run in every for name in run.states}):
        states = [run.states.get(robot) for run in every]
        cells = tuple("–" if of is None else of.state for of in states)
        rows.append((f"{robot}: in the final map", cells))
    for robot in in_order({name for run in every for name in run.robots}):
        results = [(run, run.robots.get(robot)) for run in every]
        rows += [
            (f"{robot}: {name}", tuple("–" if r is None else of(run, r) for run, r in results))
            for name, of in _ROBOT
        ]
    return rows


def compare_figures(runs: Mapping[str, Evaluation]) -> dict[str, Any]:
    """Figures of `compare_rows` by run and name, for JSON."""
    rows = compare_rows(runs)
    return {name: {row[0]: row[1][k] for row in rows} for k, name in enumerate(runs)}


def compare_picture(runs: Mapping[str, Evaluation], path: Path) -> bool:
    """Draw map error, map NEES and path errors of every run; False if none has truth."""
    errors = [None if run.map is None else run.map.errors for run in runs.values()]
    paths = [_aligned_m(each) for run in runs.values() for each in run.robots.values()]
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
        paths = [_aligned_m(run.robots.get(robot)) for run in runs.values()]
        axes[2].plot(at, paths, "o-", color=colour, linewidth=0.7, label=robot)
    axes[2].set_title("path RMSE, aligned [m]", fontsize=10)
    axes[2].legend(frameon=False, fontsize=8)
    for axis in axes:
        axis.set_xticks(list(at), names, rotation=20, ha="right", fontsize=8)
        axis.grid(axis="y", color="#eeeeee", linewidth=0.6)
        axis.set_axisbelow(True)
    save(figure, path)
    return True


def _aligned_m(robot: RobotResult | None) -> float:
    value = None if robot is None else robot.aligned_rmse_m
    return float("nan") if value is None else value


def same_final_map(recorded: Evaluation, changed: Evaluation) -> bool:
    """Whether both runs ended with byte-identical maps."""
    a, b = recorded.map, changed.map
    return a is not None and b is not None and a.payload_sha256 == b.payload_sha256


def largest_move_m(recorded: Evaluation, changed: Evaluation) -> float | None:
    """Largest distance between a landmark's two positions; None without a common landmark."""
    if recorded.map is None or changed.map is None:
        return None
    _, a, b = np.intersect1d(recorded.map.ids, changed.map.ids, return_indices=True)
    moves = recorded.map.means[a] - changed.map.means[b]
    return float(np.hypot(*moves.T).max()) if len(moves) else None


def draw_maps(runs: Mapping[str, Evaluation], path: Path) -> bool:
    """Draw two final maps with 95 % ellipses over the truth; False if there is no map."""
    if all(run.map is None for run in runs.values()):
        return False
    figure, ((axis,),) = new_figure(9.0, 9.0, 1, 1)
    truth = next(iter(runs.values())).true_landmarks
    if len(truth):
        axis.plot(*truth.T, "x", color=TRUTH_COLOUR, markersize=8, label="true landmarks")
    for (name, run), (colour, marker) in zip(runs.items(), MAP_STYLES, strict=True):
        if run.map is not None:
            _draw_map(axis, run.map, colour, name, marker)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    axis.grid(color="#e4e4e4", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.set_title("Final maps with 95 % ellipses", fontsize=12)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=3, frameon=False)
    save(figure, path)
    return True


def _draw_map(axis: "Axes", fused: MapResult, colour: str, label: str, marker: str) -> None:
    axis.plot(
        *fused.means.T, marker, color=colour, markersize=8, markerfacecolor="none", label=label
    )
    draw_ellipses(axis, fused.means, landmark_blocks(fused.covariance), colour)


def _of_map(name: str, form: str) -> Callable[[Evaluation], str]:
    return lambda run: format_figure(None if run.map is None else getattr(run.map, name), form, "")


def _of_map_errors(name: str, form: str) -> Callable[[Evaluation], str]:
    def cell(run: Evaluation) -> str:
        errors = None if run.map is None else run.map.errors
        if errors is None or (run.arbitrary_frame and name != "aligned_rmse_m"):
            return "–"
        return format_figure(getattr(errors, name), form, "")

    return cell


def _of_path(
    kind: str, name: str, form: str, convert: Callable[[float], float] = float
) -> Callable[[Evaluation, RobotResult], str]:
    def cell(run: Evaluation, robot: RobotResult) -> str:
        if kind == "online" and robot.outside:
            return OUTSIDE
        errors = None if run.arbitrary_frame else getattr(robot, kind)
        return format_figure(None if errors is None else convert(getattr(errors, name)), form, "")

    return cell


def _maps_broadcast(run: Evaluation) -> str:
    traffic = run.channels.get("central/map")
    return str(0 if traffic is None else traffic.messages)


_TEAM: Sequence[tuple[str, Callable[[Evaluation], str]]] = (
    ("scenario", lambda run: "–" if run.scenario is None else run.title),
    (
        "method",
        lambda run: (
            "–" if run.scenario is None else f"{run.scenario.estimator} + {run.scenario.fusion}"
        ),
    ),
    ("landmarks", lambda run: "–" if run.map is None else str(len(run.map.ids))),
    ("landmark RMSE [m]", _of_map_errors("rmse_m", ".4f")),
    ("… after rigid alignment [m]", _of_map_errors("aligned_rmse_m", ".4f")),
    ("map NEES per dof", _of_map_errors("nees_per_dof", ".4g")),
    ("joint cost per dof", _of_map("cost_per_dof", ".4g")),
    ("covariance scale", _of_map("covariance_scale", ".2f")),
    ("maps broadcast", _maps_broadcast),
    ("rule of the final map", lambda run: "–" if run.map is None else run.map.rule),
    ("final map, its bytes", lambda run: "–" if run.map is None else run.map.payload_sha256[:16]),
)
_ROBOT: Sequence[tuple[str, Callable[[Evaluation, RobotResult], str]]] = (
    ("online position RMSE [m]", _of_path("online", "position_rmse_m", ".4f")),
    ("… aligned [m]", lambda _, robot: format_figure(robot.online_aligned_rmse_m, ".4f", "")),
    ("smoothed position RMSE [m]", _of_path("smoothed", "position_rmse_m", ".4f")),
    ("… aligned, smoothed [m]", lambda _, robot: format_figure(robot.aligned_rmse_m, ".4f", "")),
    ("heading RMSE, smoothed [°]", _of_path("smoothed", "heading_rmse_rad", ".3f", degrees)),
    ("pose NEES per dof", _of_path("smoothed", "nees_per_dof", ".3g")),
    ("uplink [bytes/step]", lambda _, robot: format_figure(robot.uplink_bytes_per_step, ".1f", "")),
)
