"""Draw the consistency of a run over team time."""

from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from teamslam.central.desk.drawing import MAP_COLOUR, ORANGE, RED, robot_colours, robot_labels
from teamslam.central.desk.evaluation.history import History
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.central.desk.pictures.run import new_figure
from teamslam.central.desk.pictures.style import save
from teamslam.team.estimation.consistency import chi2_interval
from teamslam.team.shapes import Bool, Float, Int64

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.axes import Axes

BINS = 40
BAND = 0.95
BAND_COLOUR = "#d9ead3"
WARN, FAIL = 1.1, 1.3
"""Levels of the centre's consistency monitor."""
LOGARITHMIC_FROM = 12.0
"""NEES from which the axis is logarithmic."""


def _sum_in_bins(
    history: History, stamps_ns: Int64[np.ndarray, " n"], *values: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " b"], list[Float[np.ndarray, " b"]]]:
    """Sum each value over the filled ones of BINS intervals; return their middles [s] and sums."""
    edges = np.linspace(0.0, max((history.end_ns - history.start_ns) * 1e-9, 1e-9), BINS + 1)
    at = np.searchsorted(edges, history.seconds(stamps_ns), "right")
    where = np.clip(at - 1, 0, BINS - 1)
    filled = np.bincount(where, minlength=BINS) > 0
    sums = [np.bincount(where, weights=v, minlength=BINS)[filled] for v in values]
    return (0.5 * (edges[1:] + edges[:-1]))[filled], sums


def consistency_picture(evaluation: Evaluation, history: History, path: FilePath) -> bool:
    """Draw NEES, NIS and joint cost per dof over team time; False if all are empty."""
    has_poses = any(r.online for r in evaluation.robots.values()) and not evaluation.arbitrary_frame
    has_nis = any(each.per_dof is not None for each in history.innovations.values())
    panels = [
        *[_draw_nees] * (has_poses or len(history.map_nees.values) > 0),
        *[_draw_nis] * has_nis,
        *[_draw_cost] * (len(history.map_cost.values) > 0),
    ]
    if not panels:
        return False
    figure, axes = new_figure(9.0, 0.6 + 2.9 * len(panels), len(panels), 1)
    for (axis,), draw in zip(axes, panels, strict=True):
        axis.sharex(axes[0][0])
        draw(axis, evaluation, history)
        axis.grid(color="#eeeeee", linewidth=0.6)
        axis.set_axisbelow(True)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    axes[-1][0].set_xlabel("team time [s]")
    save(figure, path)
    return True


def _draw_nees(axis: "Axes", evaluation: Evaluation, history: History) -> None:
    low, high = chi2_interval(3, BAND, 1)
    axis.axhspan(low, high, color=BAND_COLOUR, zorder=0, label="95 % of single poses")
    axis.axhline(1.0, color="#888888", linewidth=0.8)
    largest = 0.0
    colours, labels = robot_colours(evaluation.robots), robot_labels(evaluation.robots)
    for name, robot in evaluation.robots.items():
        if robot.online is None or evaluation.arbitrary_frame:
            continue
        nees, ones = robot.online.nees / 3.0, np.ones(len(robot.online.nees))
        centres, (sums, counts) = _sum_in_bins(history, robot.online.stamps_ns, nees, ones)
        axis.plot(centres, sums / counts, color=colours[name], linewidth=1.2, label=labels[name])
        largest = max(largest, float((sums / counts).max()))
    of_map = history.map_nees
    if len(of_map.values):
        seconds, label = history.seconds(of_map.stamps_ns), "map (blocks only,\nat the end joint)"
        axis.plot(seconds, of_map.values, color=MAP_COLOUR, linewidth=1.4, label=label)
        largest = max(largest, float(of_map.values.max()))
    _scale(axis, max(largest, high))
    axis.set_ylabel("NEES per dof")
    title = "NEES: squared errors in units of their covariance; 1 is consistent"
    axis.set_title(title, fontsize=10)


def _draw_nis(axis: "Axes", evaluation: Evaluation, history: History) -> None:
    largest, lows, highs = 0.0, [], []
    colours, labels = robot_colours(evaluation.robots), robot_labels(history.innovations)
    for name, of in history.innovations.items():
        each = of.squared, of.dof.astype(np.float64)
        centres, (squared, dof) = _sum_in_bins(history, of.stamps_ns, *each)
        measured: Bool[np.ndarray, " b"] = dof > 0
        if not measured.any():
            continue
        values = squared[measured] / dof[measured]
        colour = colours.get(name, MAP_COLOUR)
        axis.plot(centres[measured], values, color=colour, linewidth=1.2, label=labels[name])
        largest = max(largest, float(values.max()))
        low, high = chi2_interval(int(np.median(dof[measured])), BAND, 1)
        lows.append(low)
        highs.append(high)
    if lows:
        axis.axhspan(
            float(np.median(lows)), float(np.median(highs)), color=BAND_COLOUR, zorder=0,
            label="95 % of points",
        )  # fmt: skip
    axis.axhline(1.0, color="#888888", linewidth=0.8)
    _scale(axis, max(largest, *highs, 1.5))
    axis.set_ylabel("NIS per dof")
    axis.set_title("Measurements against the particles' predictions: needs no truth", fontsize=10)


def _draw_cost(axis: "Axes", evaluation: Evaluation, history: History) -> None:
    axis.axhline(1.0, color="#888888", linewidth=0.8)
    for level, colour, name in (
        (WARN, ORANGE, "covariances too small"),
        (FAIL, RED, "covariances not to be trusted"),
    ):
        label = f"above {level}: {name}"
        axis.axhline(level, color=colour, linewidth=0.9, linestyle="--", label=label)
    largest = FAIL
    colours, labels = robot_colours(evaluation.robots), robot_labels(history.robot_cost)
    for name, of in history.robot_cost.items():
        axis.plot(
            history.seconds(of.stamps_ns), of.values, color=colours.get(name, MAP_COLOUR),
            linewidth=1.0, marker=".", markersize=3, label=labels[name],
        )  # fmt: skip
        largest = max(largest, float(of.values.max(initial=0.0)))
    cost = history.map_cost
    seconds = history.seconds(cost.stamps_ns)
    axis.plot(seconds, cost.values, color=MAP_COLOUR, linewidth=1.4, label="team")
    _scale(axis, max(largest, float(cost.values.max())))
    axis.set_ylabel("joint cost per dof")
    axis.set_title("How well the submaps agree: the centre's monitor, needs no truth", fontsize=10)


def _scale(axis: "Axes", largest: float) -> None:
    if largest > LOGARITHMIC_FROM:
        axis.set_yscale("symlog", linthresh=2.0)
        axis.set_ylim(0.0, 1.5 * largest)
    else:
        axis.set_ylim(0.0, 1.25 * largest)
