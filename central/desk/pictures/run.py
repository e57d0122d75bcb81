"""Draw the map, the robots' errors with their bounds, and the consistency over team time."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from teamslam.central.desk.drawing import (
    GREEN,
    MAP_COLOUR,
    ORANGE,
    RED,
    TRUE_LANDMARK_COLOUR,
    TRUTH_COLOUR,
    VERMILION,
    curve_through,
    draw_ellipses,
    ellipses,
    robot_colours,
    robot_labels,
)
from teamslam.central.desk.evaluation.errors import Path, transform_points
from teamslam.central.desk.evaluation.history import History
from teamslam.central.desk.evaluation.results import Evaluation, MapResult, RobotResult
from teamslam.central.desk.paths import SmoothedPath
from teamslam.central.desk.pictures.style import save
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.consistency import chi2_interval
from teamslam.team.estimation.dense import diagonal_blocks
from teamslam.team.estimation.se2 import inverse
from teamslam.team.shapes import Bool, Float, Int64

# Matplotlib takes half a second to import.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DRAWN_ROBOTS, DRAWN_POINTS, DRAWN_ERRORS, DRAWN_BARS, LABELLED_LANDMARKS = 12, 4000, 1200, 60, 60
"""Most rows of the error picture, points of a line, of a panel of errors, error bars, labels."""
CHANGE_MARKS = {
    "moved": (ORANGE, "o", 140.0, "-"),
    "gone": (VERMILION, "o", 110.0, "--"),
    "new": (GREEN, "s", 110.0, "-"),
}
"""Colour, marker, its size [pt²] and line of landmarks that differ from the saved maps."""
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)
SAME_M = 1e-9  # distance of equal points [m]
LEAST_SHARE = 0.01  # least share of the map's extent of a drawn ellipse's median semi-axis


def map_picture(
    evaluation: Evaluation, path: FilePath, paths: Mapping[str, SmoothedPath] = MappingProxyType({})
) -> bool:
    """Draw landmarks with 95 % ellipses, truth and paths; False if there is nothing to draw.

    paths: smoothed at keyframe rate; otherwise lines join submap ends.
    """
    if evaluation.map is None and not evaluation.robots:
        return False
    evaluation = in_the_maps_frame(evaluation)
    figure, axes = new_figure(9.0, 9.0, 1, 1)
    axis = axes[0][0]
    colours, labels = robot_colours(evaluation.robots), robot_labels(evaluation.robots)
    smoothed = {
        name for name, each in evaluation.robots.items() if len(each.smoothed_path.stamps_ns)
    }
    for i, (name, robot) in enumerate(evaluation.robots.items()):
        _draw_paths(
            axis, name, robot, colours[name], label=labels[name], first=i == 0,
            dense=paths.get(name), apart=bool(smoothed) and name not in smoothed,
        )  # fmt: skip
    _draw_landmarks(axis, evaluation)
    set_up_map(axis)
    axis.set_title("\n".join(_title(evaluation)), fontsize=12)
    if smoothed:
        axis.plot([], [], color=TRUTH_COLOUR, marker="o", linestyle="", label="ends of submaps")
    axis.plot([], [], color=TRUTH_COLOUR, marker="s", markersize=9, linestyle="", label="starts")
    _add_legend(figure, axis, min(4, -(-len(axis.get_legend_handles_labels()[0]) // 2)))
    save(figure, path)
    return True


def _add_legend(figure: "Figure", axis: "Axes", columns: int) -> None:
    figure.legend(
        *axis.get_legend_handles_labels(), loc="outside lower center", ncols=columns, frameon=False,
        fontsize=10,
    )  # fmt: skip


def in_the_maps_frame(evaluation: Evaluation) -> Evaluation:
    """Move the truth into an arbitrary map frame."""
    fused, motion = evaluation.map, evaluation.truth_from_map
    if not evaluation.arbitrary_frame or fused is None or motion is None:
        return evaluation
    back = inverse(motion)

    def moved_path(path: Path) -> Path:
        turned = path.poses[:, 2:] + back[2]
        return Path(path.stamps_ns, np.hstack((transform_points(back, path.poses[:, :2]), turned)))

    truth = transform_points(back, fused.truth)
    return replace(
        evaluation,
        map=replace(fused, truth=truth),
        true_landmarks=transform_points(back, evaluation.true_landmarks),
        robots={n: replace(r, truth=moved_path(r.truth)) for n, r in evaluation.robots.items()},
    )


def error_picture(evaluation: Evaluation, path: FilePath) -> bool:
    """Draw errors over team time with ±3σ; False without truth."""
    if evaluation.arbitrary_frame:
        return False
    shown = {n: r for n, r in evaluation.robots.items() if r.online or r.smoothed}
    outside = [name for name, robot in evaluation.robots.items() if robot.outside]
    names = list(shown)[:DRAWN_ROBOTS]
    if not names:
        return False
    start_ns = min(_first_ns(shown[name]) for name in names)
    figure, axes = new_figure(13.0, 1.0 + 2.3 * len(names), len(names), 3)
    colours = robot_colours(evaluation.robots)
    for row, name in enumerate(names):
        _draw_errors(axes[row], shown[name], colours[name], start_ns)
        axes[row][0].set_ylabel(f"{name}\nerror [m]")
        axes[row][2].set_ylabel("error [°]")
    for axis, title in zip(axes[0], ("x", "y", "heading"), strict=True):
        axis.set_title(title, fontsize=11)
    for axis in axes[-1]:
        axis.set_xlabel("team time [s]")
    left_out = len(shown) - len(names)
    more = f" · {left_out} more robots are not drawn" if left_out else ""
    more += f" · not in the team's frame: {', '.join(outside)}" if outside else ""
    figure.suptitle(f"{evaluation.title}: pose errors and their 3σ bounds{more}")
    _add_legend(figure, axes[0][0], 4)
    save(figure, path)
    return True


def new_figure(
    width: float, height: float, rows: int, columns: int
) -> "tuple[Figure, list[list[Axes]]]":
    """Create an Agg figure without pyplot, and its axes by row and column."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=columns > 1)
    return figure, [list(row) for row in grid]


def set_up_map(axis: "Axes") -> None:
    """Set equal scales, labels in metres and a faint grid."""
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    set_grid(axis, "#e4e4e4")


def set_grid(axis: "Axes", colour: str = "#eeeeee") -> None:
    """Draw a faint grid below everything else."""
    axis.grid(color=colour, linewidth=0.6)
    axis.set_axisbelow(True)


def _draw_paths(
    axis: "Axes",
    name: str,
    robot: RobotResult,
    colour: str,
    *,
    label: str,
    first: bool,
    dense: SmoothedPath | None,
    apart: bool,
) -> None:
    truth, smoothed = _thinned(robot.truth), robot.smoothed_path
    line = smoothed if dense is None else _thinned(Path(dense.stamps_ns, dense.poses))
    known = truth if len(truth.stamps_ns) else line
    if len(truth.stamps_ns):
        x, y, _ = truth.poses.T
        truths = "true paths" if first else None
        axis.plot(x, y, color=TRUTH_COLOUR, linewidth=0.7, label=truths, zorder=1)
    if len(known.stamps_ns):
        x, y = float(known.poses[0, 0]), float(known.poses[0, 1])
        axis.plot(x, y, color=colour, linestyle="", marker="s", markersize=10, alpha=0.8, zorder=4)
    if len(smoothed.stamps_ns):
        ends = np.array([end for _, end in robot.left_out], np.int64)
        for part in np.split(line.poses, np.searchsorted(line.stamps_ns, ends)):
            drawn = part[:, :2] if dense is None else curve_through(part)
            axis.plot(*drawn.T, color=colour, linewidth=1.1, alpha=0.8, zorder=2)
        axis.plot(
            *smoothed.poses.T[:2], color=colour, linestyle="", marker="o", markersize=3.5, zorder=3
        )
        axis.plot([], [], color=colour, marker="o", label=label)
    elif apart or robot.outside:
        start = "s" if len(known.stamps_ns) else ""
        axis.plot(
            [], [], color=colour, linestyle="", marker=start, label=f"{name}: not in this map"
        )
    else:
        x, y, _ = _thinned(robot.online_path).poses.T
        axis.plot(x, y, color=colour, linewidth=1.0, zorder=3, label=f"{label}, online")


def _draw_landmarks(axis: "Axes", evaluation: Evaluation) -> None:
    """Draw ellipses and true landmarks, both magnified about the estimates if they are small.

    A magnified ellipse contains its landmark's truth if and only if the true ellipse does.
    """
    truth, fused = evaluation.true_landmarks, evaluation.map
    has_map = fused is not None and len(fused.ids) > 0
    blocks = diagonal_blocks(fused.covariance) if fused is not None and has_map else None
    times = 1 if fused is None or blocks is None else magnification(evaluation, blocks)
    if len(truth):
        drawn = truth if fused is None or times == 1 else _magnified_truth(truth, fused, times)
        axis.plot(
            *drawn.T, linestyle="", marker="x", markersize=6, markeredgewidth=0.9,
            color=TRUE_LANDMARK_COLOUR, zorder=6,
            label="true landmarks" if times == 1 else f"true landmarks, errors × {times}",
        )  # fmt: skip
    if fused is None or blocks is None:
        return
    gone = [each.landmark for each in fused.changes if each.state == "gone"]
    there = ~np.isin(fused.ids, gone)
    label = "landmarks, 95 % ellipses" + (f" × {times}" if times > 1 else "")
    label += "\nwith the frame's own error" if evaluation.arbitrary_frame else ""
    axis.plot(
        *fused.means[there].T, linestyle="", marker=".", markersize=2, color=MAP_COLOUR, zorder=7,
        label=label,
    )  # fmt: skip
    draw_ellipses(
        axis, fused.means[there], times**2 * blocks[there], MAP_COLOUR, width=1.1, zorder=7
    )
    places = _draw_changes(axis, fused)
    named = fused.ids < UNNAMED  # numbers of unnamed landmarks have no meaning
    if 0 < np.count_nonzero(named) <= LABELLED_LANDMARKS:
        means = places[named]
        for landmark, at, offset in zip(
            fused.ids[named], means.tolist(), _label_offsets(means).tolist(), strict=True
        ):
            axis.annotate(
                str(landmark), at, xytext=offset, textcoords="offset points", ha="center",
                va="center", fontsize=9, color=MAP_COLOUR, zorder=8,
            )  # fmt: skip


def _draw_changes(axis: "Axes", fused: MapResult) -> Float[np.ndarray, "L 2"]:
    """Mark changes since the saved maps; return each landmark's place.

    As on the live page: an arrow from a moved one's old place to a ring, a hollow dashed mark at
    that of one that is gone, a square around a new one.
    """
    places = fused.means.copy()
    found: dict[str, list[int]] = {state: [] for state in CHANGE_MARKS}
    changes = {each.landmark: each for each in fused.changes if each.state in found}
    for row, landmark in enumerate(fused.ids.tolist()):
        if (change := changes.get(landmark)) is None:
            continue
        found[change.state].append(row)
        before = fused.means[row] - (change.dx, change.dy)
        if change.state == "gone":
            places[row] = before
        elif change.state == "moved":
            axis.annotate(
                "", xy=fused.means[row].tolist(), xytext=before.tolist(), zorder=9,
                arrowprops={"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.6},
            )  # fmt: skip
    for state, (colour, marker, size, dashes) in CHANGE_MARKS.items():
        if found[state]:
            axis.scatter(
                places[found[state], 0], places[found[state], 1], s=size, marker=marker,
                facecolors="none", edgecolors=colour, linewidths=1.6, linestyle=dashes, zorder=9,
                label=f"{state} since the saved map",
            )  # fmt: skip
    return places


def magnification(evaluation: Evaluation, blocks: Float[np.ndarray, "L 2 2"]) -> int:
    """Factor at which the median ellipse is visible."""
    assert evaluation.map is not None
    paths = [each.smoothed_path.poses[:, :2] for each in evaluation.robots.values()]
    extent = float(np.ptp(np.vstack([evaluation.map.means, *paths]), axis=0).max())
    major, _, _ = ellipses(blocks[:, (0, 0, 1), (0, 1, 1)])
    least = LEAST_SHARE * extent / max(float(np.median(major)), 1e-12)
    return next((each for each in MAGNIFICATIONS if each >= least), MAGNIFICATIONS[-1])


def _magnified_truth(
    truth: Float[np.ndarray, "T 2"], fused: MapResult, times: int
) -> Float[np.ndarray, "T 2"]:
    means, matched = fused.means[fused.known], fused.truth[fused.known]
    kept = [p for p in truth if np.hypot(*(matched - p).T).min(initial=np.inf) > SAME_M]
    moved = means + times * (matched - means)
    return np.vstack([moved, *kept]) if kept else moved


def _label_offsets(points: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "L 2"]:
    """Offset of each label [pt], away from its neighbours."""
    reach = max(float(np.ptp(points, axis=0).max()) / 20.0, 1e-9)
    offsets = np.empty_like(points)
    for i, point in enumerate(points):
        near = np.hypot(*(points - point).T) <= reach
        away = point - points[near].mean(axis=0)
        length = float(np.hypot(*away))
        offsets[i] = 18.0 * away / length if length > 0.0 else (11.0, 9.0)
    return offsets


def _draw_errors(axes: "Sequence[Axes]", robot: RobotResult, colour: str, start_ns: int) -> None:
    scales = (1.0, 1.0, 180.0 / np.pi)
    for k, (axis, scale) in enumerate(zip(axes, scales, strict=True)):
        axis.axhline(0.0, color="#bbbbbb", linewidth=0.7)
        set_grid(axis)
        shown, largest = [np.empty(0)], 0.0
        if robot.online is not None:
            drawn = slice(None, None, max(1, len(robot.online.stamps_ns) // DRAWN_ERRORS))
            time_s = (robot.online.stamps_ns[drawn] - start_ns) * 1e-9
            bound = 3.0 * scale * robot.online.sigmas[drawn, k]
            error = scale * robot.online.errors[drawn, k]
            label = f"online ({robot.online_channel})"
            axis.fill_between(
                time_s, -bound, bound, color=colour, alpha=0.18, linewidth=0.0, label="±3σ online"
            )
            axis.plot(time_s, error, color=colour, linewidth=0.9, label=label)
            shown.append(scale * np.abs(robot.online.errors[:, k]))
            largest = float(np.quantile(bound, 0.98))
        if robot.smoothed is not None:
            every = slice(None, None, -(-len(robot.smoothed.stamps_ns) // DRAWN_BARS))
            time_s = (robot.smoothed.stamps_ns[every] - start_ns) * 1e-9
            error = scale * robot.smoothed.errors[every, k]
            sigma = scale * robot.smoothed.sigmas[every, k]
            axis.errorbar(
                time_s, error, 3.0 * sigma, color=MAP_COLOUR, linestyle="", marker=".",
                markersize=3, elinewidth=0.6, label="smoothed, ±3σ",
            )  # fmt: skip
            shown.append(scale * np.abs(robot.smoothed.errors[:, k]))
            largest = max(largest, float(np.quantile(3 * sigma, 0.98)))
        _fit(axis, np.concatenate(shown), largest)


def _fit(axis: "Axes", errors: Float[np.ndarray, " n"], bound: float) -> None:
    most = float(errors.max(initial=0.0))
    limit = 1.1 * max(bound, float(np.quantile(errors, 0.998)) if len(errors) else 0.0)
    if most <= 1.5 * limit:
        limit = max(limit, 1.1 * most)
    if limit <= 0.0:
        return
    axis.set_ylim(-limit, limit)
    beyond = int(np.count_nonzero(errors > limit))
    if beyond:
        text = f"{beyond} beyond, up to {most:.3g}"
        axis.text(0.99, 0.97, text, transform=axis.transAxes, ha="right", va="top", fontsize=8)


def _first_ns(robot: RobotResult) -> int:
    stamps = [e.stamps_ns[0] for e in (robot.online, robot.smoothed) if e is not None]
    return int(min(stamps + list(robot.truth.stamps_ns[:1])))


def _thinned(path: Path) -> Path:
    drawn = slice(None, None, max(1, len(path.stamps_ns) // DRAWN_POINTS))
    return Path(path.stamps_ns[drawn], path.poses[drawn])


def _title(evaluation: Evaluation) -> list[str]:
    fused = evaluation.map
    second = [evaluation.method] if evaluation.method else []
    if fused is None:
        second.append("no final map")
    elif fused.errors is not None:
        errors = fused.errors
        aligned = "" if errors.aligned_rmse_m is None else f"{errors.aligned_rmse_m:.3g} m"
        if evaluation.arbitrary_frame:
            second.append(f"landmark RMSE {aligned} aligned")
        else:
            text = f"landmark RMSE {errors.rmse_m:.3g} m" + (
                f" ({aligned} aligned)" * bool(aligned)
            )
            text += "" if fused.matching is None else f", {fused.matching.by}"
            second += [text, f"map NEES per dof {errors.nees_per_dof:.3g}"]
    return [evaluation.title, " · ".join(second)]


BINS = 40
BAND = 0.95
BAND_COLOUR = "#d9ead3"
WARN, FAIL = 1.1, 1.3  # levels of the centre's consistency monitor
LOGARITHMIC_FROM = 12.0  # NEES from which the axis is logarithmic


def _sum_in_bins(
    history: History, stamps_ns: Int64[np.ndarray, " n"], *values: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " b"], list[Float[np.ndarray, " b"]]]:
    """Middles [s] of the filled ones of BINS intervals, and sums in them."""
    edges = np.linspace(0.0, max((history.end_ns - history.start_ns) * 1e-9, 1e-9), BINS + 1)
    at = np.searchsorted(edges, history.seconds(stamps_ns), "right")
    where = np.clip(at - 1, 0, BINS - 1)
    filled = np.bincount(where, minlength=BINS) > 0
    sums = [np.bincount(where, weights=v, minlength=BINS)[filled] for v in values]
    return (0.5 * (edges[1:] + edges[:-1]))[filled], sums


def consistency_picture(evaluation: Evaluation, history: History, path: FilePath) -> bool:
    """Draw NEES, NIS and joint cost over team time; False if all are empty."""
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
        axis.axhline(1.0, color="#888888", linewidth=0.8)
        largest, label, title = draw(axis, evaluation, history)
        axis.set_ylabel(label)
        axis.set_title(title, fontsize=10)
        if largest > LOGARITHMIC_FROM:
            axis.set_yscale("symlog", linthresh=2.0)
        axis.set_ylim(0.0, (1.5 if largest > LOGARITHMIC_FROM else 1.25) * largest)
        set_grid(axis)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    axes[-1][0].set_xlabel("team time [s]")
    save(figure, path)
    return True


_Panel = tuple[float, str, str]  # largest drawn value, label of the axis, title


def _draw_nees(axis: "Axes", evaluation: Evaluation, history: History) -> _Panel:
    low, high = chi2_interval(3, BAND, 1)
    axis.axhspan(low, high, color=BAND_COLOUR, zorder=0, label="95 % of single poses")
    largest = high
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
    title = "NEES: squared errors in units of their covariance; 1 is consistent"
    return largest, "NEES per dof", title


def _draw_nis(axis: "Axes", evaluation: Evaluation, history: History) -> _Panel:
    largest, lows, highs = 1.5, [], []
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
    title = "Measurements against the particles' predictions: needs no truth"
    return max(largest, *highs), "NIS per dof", title


def _draw_cost(axis: "Axes", evaluation: Evaluation, history: History) -> _Panel:
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
    title = "How well the submaps agree: the centre's monitor, needs no truth"
    return max(largest, float(cost.values.max())), "joint cost per dof", title
