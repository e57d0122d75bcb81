"""Draw a run over team time: consistency, traffic, latency, events."""

from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int64

from central.desk.drawing import (
    BLUE,
    GREEN,
    GREY,
    MAP_COLOUR,
    ORANGE,
    PURPLE,
    RED,
    ROBOT_COLOURS,
    VERMILION,
    colour_of,
    robot_colours,
    robot_labels,
)
from central.desk.evaluation.evaluation import Evaluation
from central.desk.evaluation.history import History, Traffic
from central.desk.names import in_order
from central.desk.pictures.run import new_figure, thinning
from central.desk.pictures.style import save
from team.estimation.consistency import chi2_interval
from team.wire import channels as ch
from team.wire.channels import channel_of

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

BINS = 40
RATE_POINTS, RATE_WINDOWS = 200, 10.0
"""Points of a rate line, and run length in windows."""
BAND = 0.95
BAND_COLOUR = "#d9ead3"
WARN, FAIL = 1.1, 1.3
"""Levels of the centre's consistency monitor."""
LOGARITHMIC_FROM = 12.0
"""NEES from which the axis is logarithmic."""
SHOWN_KEYS = 8
_OTHERS = ("central", "recorder", "world")
"""Nodes other than robots, below these in the timeline."""
EVENT_STYLES = {
    "joined": ("o", GREEN), "lost": ("X", RED), "restarted": ("^", ORANGE), "left": ("<", GREY),
    "map": ("D", BLUE), "closure": ("d", BLUE), "undone": ("d", RED), "withdrawn": ("P", PURPLE),
    "refused": ("*", RED),
    "warning": ("v", VERMILION), "done": ("s", GREY),
}  # fmt: skip


def binned(
    history: History, stamps_ns: Int64[np.ndarray, " n"], *values: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " b"], list[Float[np.ndarray, " b"]]]:
    """Sum each value over the BINS intervals of the run; empty intervals are omitted.

    Returns interval middles [s] and sums; values outside the run count at its ends.
    """
    where = _bins(history, stamps_ns)
    filled = np.bincount(where, minlength=BINS) > 0
    sums = [np.bincount(where, weights=v, minlength=BINS)[filled] for v in values]
    return _middles(history)[filled], sums


def _edges(history: History) -> Float[np.ndarray, " e"]:
    return np.linspace(0.0, max((history.end_ns - history.start_ns) * 1e-9, 1e-9), BINS + 1)


def _middles(history: History) -> Float[np.ndarray, " b"]:
    edges = _edges(history)
    middles: Float[np.ndarray, " b"] = 0.5 * (edges[1:] + edges[:-1])
    return middles


def _bins(history: History, stamps_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Interval of each stamp; stamps outside the run count at its ends."""
    at: Int64[np.ndarray, " n"] = np.searchsorted(
        _edges(history), history.seconds(stamps_ns), "right"
    )
    clipped: Int64[np.ndarray, " n"] = np.clip(at - 1, 0, BINS - 1)
    return clipped


def consistency_picture(evaluation: Evaluation, history: History, path: FilePath) -> bool:
    """Draw NEES of poses and map, NIS and joint cost per degree of freedom over team time.

    Empty panels are omitted; False if all are empty.
    """
    panels = [
        draw
        for draw, is_there in (
            (_draw_nees, (any(r.online for r in evaluation.robots.values())
              and not evaluation.arbitrary_frame)
             or len(history.map_nees.values) > 0),
            (_draw_nis, any(i.per_dof is not None for i in history.innovations.values())),
            (_draw_cost, len(history.map_cost.values) > 0),
        )
        if is_there
    ]  # fmt: skip
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
        centres, (sums, counts) = binned(
            history,
            robot.online.stamps_ns,
            robot.online.nees / 3.0,
            np.ones(len(robot.online.nees)),
        )
        axis.plot(centres, sums / counts, color=colours[name], linewidth=1.2, label=labels[name])
        largest = max(largest, float((sums / counts).max()))
    nees = history.map_nees
    if len(nees.values):
        seconds = history.seconds(nees.stamps_ns)
        axis.plot(
            seconds, nees.values, color=MAP_COLOUR, linewidth=1.4, label="landmarks, each by itself"
        )
        largest = max(largest, float(nees.values.max()))
    _scale(axis, max(largest, high))
    axis.set_ylabel("NEES per dof")
    axis.set_title("Errors in units of the covariance that goes with them: 1 is right", fontsize=10)


def _draw_nis(axis: "Axes", evaluation: Evaluation, history: History) -> None:
    largest, lows, highs = 0.0, [], []
    colours, labels = robot_colours(evaluation.robots), robot_labels(history.innovations)
    for name, of in history.innovations.items():
        centres, (squared, dof) = binned(
            history, of.stamps_ns, of.squared, of.dof.astype(np.float64)
        )
        measured: Bool[np.ndarray, " b"] = dof > 0
        if not measured.any():
            continue
        values = squared[measured] / dof[measured]
        axis.plot(
            centres[measured],
            values,
            color=colours.get(name, MAP_COLOUR),
            linewidth=1.2,
            label=labels[name],
        )
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
        axis.axhline(
            level, color=colour, linewidth=0.9, linestyle="--", label=f"above {level}: {name}"
        )
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


def traffic_picture(history: History, path: FilePath) -> bool:
    """Draw payload bytes per second of team time, by channel and robot."""
    if not history.traffic:
        return False
    figure, axes = new_figure(9.0, 6.6, 2, 1)
    by_channel: dict[str, list[Traffic]] = {}
    by_robot: dict[str, list[Traffic]] = {}
    for key, traffic in history.traffic.items():
        by_channel.setdefault(channel_name(key), []).append(traffic)
        if (robot := publisher(key)) is not None:
            by_robot.setdefault(robot, []).append(traffic)
    largest = sorted(by_channel, key=lambda name: -_bytes(by_channel[name]))
    shown = {name: by_channel[name] for name in largest[:SHOWN_KEYS]}
    rest = [t for name in largest[SHOWN_KEYS:] for t in by_channel[name]]
    if rest:
        shown[f"{len(largest) - SHOWN_KEYS} more"] = rest
    for axis, groups, title in (
        (axes[0][0], shown, "by channel"),
        (
            axes[1][0],
            by_robot,
            "messages of each robot's node, without its sensors' measurements",
        ),
    ):
        _draw_rates(axis, history, groups)
        axis.set_title(title, fontsize=10)
        axis.set_ylabel("payload [B/s]")
    axes[-1][0].set_xlabel("team time [s]")
    save(figure, path)
    return True


def _rate(
    seconds: Float[np.ndarray, " n"],
    sizes: Float[np.ndarray, " n"],
    at_s: Float[np.ndarray, " k"],
    width_s: float,
) -> Float[np.ndarray, " k"]:
    """Bytes per second about each time, with a triangular window of half-width width_s.

    The window gives regular messages such as submaps a constant rate; bins would make it oscillate.
    """
    order = np.argsort(seconds, kind="stable")
    times, sums = seconds[order], np.concatenate(([0.0], np.cumsum(sizes[order])))
    weighted = np.concatenate(([0.0], np.cumsum(sizes[order] * times)))
    left, middle, right = (np.searchsorted(times, at_s + d) for d in (-width_s, 0.0, width_s))
    rising = weighted[middle] - weighted[left] - (at_s - width_s) * (sums[middle] - sums[left])
    falling = (at_s + width_s) * (sums[right] - sums[middle]) - (weighted[right] - weighted[middle])
    inside = np.minimum(at_s, width_s) + np.minimum(at_s[-1] - at_s, width_s)
    missing = (width_s - np.minimum(at_s, width_s)) ** 2
    missing += (width_s - np.minimum(at_s[-1] - at_s, width_s)) ** 2
    area = width_s * width_s - 0.5 * missing
    rate: Float[np.ndarray, " k"] = np.where(inside > 0.0, (rising + falling) / area, 0.0)
    return rate


def _draw_rates(axis: "Axes", history: History, groups: Mapping[str, Sequence[Traffic]]) -> None:
    span_s = max((history.end_ns - history.start_ns) * 1e-9, 1e-9)
    at_s = np.linspace(0.0, span_s, RATE_POINTS)
    labels = robot_labels(groups, 2 * len(ROBOT_COLOURS))
    for k, (name, parts) in enumerate(groups.items()):
        stamps = np.concatenate([part.stamps_ns for part in parts])
        sizes = np.concatenate([part.sizes for part in parts]).astype(np.float64)
        rate = _rate(history.seconds(stamps), sizes, at_s, span_s / RATE_WINDOWS)
        style = "-" if k < len(ROBOT_COLOURS) else "--"
        axis.plot(
            at_s[rate > 0.0], rate[rate > 0.0], color=colour_of(k), linestyle=style, linewidth=1.2,
            label=labels[name],
        )  # fmt: skip
    _log_scale(axis, axis.yaxis)
    axis.grid(color="#eeeeee", linewidth=0.6)
    axis.set_axisbelow(True)
    if groups:
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


def _log_scale(axes: "Axes", axis: "Axis") -> None:
    """Set a logarithmic scale with plain tick numbers, denser over a short range."""
    from matplotlib.ticker import LogLocator, NullFormatter

    upright = axis is axes.yaxis
    (axes.set_yscale if upright else axes.set_xscale)("log")
    low, high = axes.get_ylim() if upright else axes.get_xlim()
    few = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high < 8.0 * low else (1.0, 2.0, 5.0)
    axis.set_major_locator(LogLocator(subs=few if high < 200.0 * low else (1.0,)))
    axis.set_major_formatter("{x:,g}")
    axis.set_minor_formatter(NullFormatter())


def latency_picture(history: History, path: FilePath) -> bool:
    """Draw wall time from a submap's first and last measurement to its first map.

    Above, every submap over team time with the median of all robots; below, each robot's median and
    95 % range.
    """
    if not history.latencies:
        return False
    names = in_order(history.latencies)
    low_height = 0.5 + 0.26 * len(names)
    figure, axes = new_figure(9.0, 4.2 + low_height, 2, 1, (3.2, low_height))
    over, rows = axes[0][0], axes[1][0]
    colours = robot_colours({*history.innovations, *history.latencies})
    for name in names:
        of = history.latencies[name]
        drawn = thinning(len(of.stamps_ns))
        over.plot(
            history.seconds(of.stamps_ns[drawn]), of.last_s[drawn], color=colours[name],
            marker="o", markersize=2.5, linestyle="", alpha=0.5,
        )  # fmt: skip
    every = list(history.latencies.values())
    stamps = np.concatenate([of.stamps_ns for of in every])
    for words, style, values in (
        ("from its last measurement", "-", np.concatenate([of.last_s for of in every])),
        ("from its first measurement", ":", np.concatenate([of.first_s for of in every])),
    ):
        over.plot(
            *_medians(history, stamps, values), color=MAP_COLOUR, linestyle=style, linewidth=1.2,
            label=f"{words}, median of all",
        )  # fmt: skip
    for row, name in enumerate(names):
        of = history.latencies[name]
        for values, marker, face, at in (
            (of.last_s, "o", colours[name], row - 0.17),
            (of.first_s, "s", "white", row + 0.17),
        ):
            low, middle, high = np.quantile(values, (0.025, 0.5, 0.975)).tolist()
            rows.plot([low, high], [at, at], color=colours[name], linewidth=1.2)
            rows.plot(
                [middle], [at], color=colours[name], marker=marker, markersize=5,
                markerfacecolor=face,
            )  # fmt: skip
    for marker, face, words in (("o", "#555555", "last"), ("s", "white", "first")):
        rows.plot(
            [], [], color="#555555", marker=marker, markersize=5, markerfacecolor=face,
            label=f"from its {words} measurement: median, range of 95 %",
        )  # fmt: skip
    rows.set_yticks(range(len(names)), names)
    rows.set_ylim(len(names) - 0.5, -0.5)
    if all((of.last_s > 0.0).all() for of in every):  # clocks of two machines may disagree
        _log_scale(over, over.yaxis)
        _log_scale(rows, rows.xaxis)
    over.set_xlabel("end of the submap, team time [s]")
    over.set_ylabel("wall time to the map [s]")
    rows.set_xlabel("wall time from a measurement to the map [s]")
    for axis in (over, rows):
        axis.grid(color="#eeeeee", linewidth=0.6)
        axis.set_axisbelow(True)
        axis.legend(
            loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=8, frameon=False
        )
    save(figure, path)
    return True


def _medians(
    history: History, stamps_ns: Int64[np.ndarray, " n"], values: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    where = _bins(history, stamps_ns)
    filled = np.unique(where)
    middles = np.array([np.median(values[where == each]) for each in filled])
    return _middles(history)[filled], middles


def timeline_picture(history: History, path: FilePath) -> bool:
    """Draw one row per node, one mark per event."""
    nodes = list(dict.fromkeys(event.of for event in history.events))
    if not nodes:
        return False
    nodes = [n for n in in_order(nodes) if n not in _OTHERS] + [n for n in _OTHERS if n in nodes]
    figure, axes = new_figure(9.0, 1.3 + 0.34 * len(nodes), 1, 1)
    axis = axes[0][0]
    for row in range(len(nodes)):
        axis.axhline(row, color="#e0e0e0", linewidth=1.0, zorder=0)
    for kind, (marker, colour) in EVENT_STYLES.items():
        events = [event for event in history.events if event.kind == kind]
        if events:
            stamps = np.array([event.stamp_ns for event in events], np.int64)
            rows = [nodes.index(event.of) for event in events]
            axis.plot(
                history.seconds(stamps), rows, linestyle="", marker=marker, color=colour,
                markersize=7, alpha=0.85, label=kind,
            )  # fmt: skip
    axis.set_yticks(range(len(nodes)), nodes)
    axis.set_ylim(len(nodes) - 0.5, -0.5)
    axis.set_xlabel("team time [s]")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    save(figure, path)
    return True


def channel_name(key: str) -> str:
    """Channel name of a key; a viewer's keys have one name."""
    found = channel_of(key)
    if found is not None:
        return found[0].name
    return "view" if key.startswith("view/") else "other"


def publisher(key: str) -> str | None:
    """Robot whose node publishes on this key; None for others, including its sensors."""
    found = channel_of(key)
    if found is None or found[0] in ch.SENSORS:
        return None
    channel, name = found
    if channel.template.startswith("robot/{robot}/"):
        return name
    kind, _, robot = name.partition("/")
    return robot if kind == "robot" else None


def _bytes(parts: Sequence[Traffic]) -> int:
    return sum(int(part.sizes.sum()) for part in parts)
