"""Compare runs: tables and pictures."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from teamslam.central.desk.drawing import (
    BLUE,
    GREY,
    TRUTH_COLOUR,
    VERMILION,
    draw_ellipses,
    robot_colours,
)
from teamslam.central.desk.evaluation.results import Evaluation, RobotResult, figure
from teamslam.central.desk.names import OUTSIDE, in_order
from teamslam.central.desk.pictures.run import in_the_maps_frame, new_figure, set_up_map
from teamslam.central.desk.pictures.style import save
from teamslam.central.desk.report.tables import DEGREES, NO_FIGURE, Column, cells, comparable
from teamslam.team.estimation.dense import diagonal_blocks

Row = tuple[str, tuple[str, ...]]
MAP_STYLES = ((BLUE, "."), (VERMILION, "+"))


def _in_the_frame(path: str) -> Callable[[Evaluation], Any]:
    return lambda run: None if run.arbitrary_frame else figure(run, path)


_TEAM = (
    Column("scenario", lambda run: run.scenario and run.title),
    Column(
        "method", lambda run: run.scenario and f"{run.scenario.estimator} + {run.scenario.fusion}"
    ),
    Column("landmarks", lambda run: run.map and len(run.map.ids)),
    Column("landmark RMSE [m]", _in_the_frame("map.errors.rmse_m"), ".4f"),
    Column("… after rigid alignment [m]", "map.errors.aligned_rmse_m", ".4f"),
    Column("map NEES per dof", _in_the_frame("map.errors.nees_per_dof"), ".4g"),
    Column("joint cost per dof", "map.cost_per_dof", ".4g"),
    Column("covariance scale", "map.covariance_scale", ".2f"),
    Column("maps broadcast", lambda run: figure(run.channels.get("central/map"), "messages") or 0),
    Column("rule of the final map", "map.rule"),
    Column("final map, its bytes", lambda run: run.map and run.map.payload_sha256[:16]),
)
_ROBOT = (
    Column(
        "online position RMSE [m]",
        lambda robot: (
            OUTSIDE if figure(robot, "outside") else figure(robot, "online.position_rmse_m")
        ),
        ".4f",
    ),
    Column("… aligned [m]", "online_aligned_rmse_m", ".4f"),
    Column("smoothed position RMSE [m]", "smoothed.position_rmse_m", ".4f"),
    Column("… aligned, smoothed [m]", "aligned_rmse_m", ".4f"),
    Column("heading RMSE, smoothed [°]", "smoothed.heading_rmse_rad", ".3f", DEGREES),
    Column("pose NEES per dof", "smoothed.nees_per_dof", ".3g"),
    Column("uplink [bytes/step]", "uplink_bytes_per_step", ".1f"),
)


def compare_rows(runs: Mapping[str, Evaluation]) -> list[Row]:
    """Rows (figure, one cell per run)."""
    every = list(runs.values())
    rows = _rows("", _TEAM, every)
    matched = tuple(run.matched_by for run in every)
    rows += [("landmark errors by", matched)] if any(matched) else []
    for robot in in_order({name for run in every for name in run.states}):
        states = tuple(figure(run.states.get(robot), "state") or "–" for run in every)
        rows.append((f"{robot}: in the final map", states))
    for name in in_order({name for run in every for name in run.robots}):
        robots = ((run, run.robots.get(name)) for run in every)
        rows += _rows(f"{name}: ", _ROBOT, [of and comparable(run, of) for run, of in robots])
    return rows


def filled_rows(runs: Mapping[str, Evaluation]) -> list[Row]:
    """Rows of `compare_rows` that have a figure of at least one run."""
    return [row for row in compare_rows(runs) if any(cell != NO_FIGURE for cell in row[1])]


def _rows(before: str, columns: Sequence[Column], of: Sequence[object]) -> list[Row]:
    by_column = zip(*(cells(each, columns) for each in of), strict=True)
    names = (f"{before}{column.heading}" for column in columns)
    return list(zip(names, by_column, strict=True)) if of else []


def compare_figures(runs: Mapping[str, Evaluation]) -> dict[str, Any]:
    """Cells of `compare_rows` by run and name."""
    rows = compare_rows(runs)
    return {name: {row[0]: row[1][k] for row in rows} for k, name in enumerate(runs)}


def compare_picture(runs: Mapping[str, Evaluation], path: Path) -> bool:
    """Draw the errors of runs; False without truth."""
    errors = [None if run.map is None else run.map.errors for run in runs.values()]
    paths = [_aligned_m(each) for run in runs.values() for each in run.robots.values()]
    if not any(errors) and np.isnan(paths).all():
        return False
    figure, (axes,) = new_figure(max(9.0, 2.5 + 1.2 * len(runs)), 4.2, 1, 3)
    names = list(runs)
    at = range(len(names))
    axes[0].bar(at, [(e and e.aligned_rmse_m) or 0.0 for e in errors], color=GREY)
    axes[0].set_title("landmark RMSE, aligned [m]", fontsize=10)
    placed = [
        None if run.arbitrary_frame else error
        for run, error in zip(runs.values(), errors, strict=True)
    ]
    axes[1].plot(at, [e.nees_per_dof if e else np.nan for e in placed], "o", color=GREY)
    for k, error in enumerate(placed):
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
    """Largest distance [m] between a common landmark's two positions."""
    if recorded.map is None or changed.map is None:
        return None
    _, a, b = np.intersect1d(recorded.map.ids, changed.map.ids, return_indices=True)
    moves = recorded.map.means[a] - changed.map.means[b]
    return float(np.hypot(*moves.T).max()) if len(moves) else None


def draw_maps(runs: Mapping[str, Evaluation], path: Path) -> bool:
    """Draw two final maps with 95 % ellipses; False without a map.

    In an arbitrary frame the truth is aligned with the first map.
    """
    if all(run.map is None for run in runs.values()):
        return False
    figure, ((axis,),) = new_figure(9.0, 9.0, 1, 1)
    first = next(run for run in runs.values() if run.map is not None)
    truth = in_the_maps_frame(first).true_landmarks
    if len(truth):
        axis.plot(*truth.T, "x", color=TRUTH_COLOUR, markersize=8, label="true landmarks")
    for (name, run), (colour, marker) in zip(runs.items(), MAP_STYLES, strict=True):
        if (fused := run.map) is not None:
            x, y = fused.means.T
            axis.plot(x, y, marker, color=colour, markersize=8, markerfacecolor="none", label=name)
            draw_ellipses(axis, fused.means, diagonal_blocks(fused.covariance), colour)
    set_up_map(axis)
    axis.set_title("Final maps with 95 % ellipses", fontsize=12)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=3, frameon=False)
    save(figure, path)
    return True
