"""Compares a recorded run with one of the same measurements under other conditions: figures, and
one picture.
"""

from collections.abc import Callable
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from central.desk.drawing import (
    BLUE,
    TRUTH_COLOUR,
    VERMILION,
    draw_ellipses,
    landmark_blocks,
)
from central.desk.evaluation.evaluation import Evaluation, MapResult, RobotResult
from central.desk.names import OUTSIDE, in_order
from central.desk.pictures.style import save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RECORDED_COLOUR, CHANGED_COLOUR = BLUE, VERMILION
Row = tuple[str, str, str]


def comparison_rows(recorded: Evaluation, changed: Evaluation) -> list[Row]:
    """(figure, recorded, recomputed), "–" where there is none."""
    of_the_team: tuple[tuple[str, Callable[[Evaluation], str]], ...] = (
        ("rule", lambda e: "–" if e.map is None else e.map.rule),
        ("landmarks in the final map", lambda e: "–" if e.map is None else f"{len(e.map.ids)}"),
        ("landmark RMSE [m]", lambda e: _of_errors(e, "rmse_m", ".4f")),
        ("… after rigid alignment [m]", lambda e: _of_errors(e, "aligned_rmse_m", ".4f")),
        ("map NEES per dof", lambda e: _of_errors(e, "nees_per_dof", ".4g")),
        (
            "joint cost per dof",
            lambda e: _shown(None if e.map is None else e.map.cost_per_dof, ".4g"),
        ),
        ("maps broadcast", lambda e: str(_messages(e, "central/map"))),
        ("final map, its bytes", lambda e: "–" if e.map is None else e.map.payload_sha256[:16]),
    )
    rows = [(name, of(recorded), of(changed)) for name, of in of_the_team]
    matched = recorded.matched_by, changed.matched_by
    rows += [("landmark errors by", *matched)] if any(matched) else []
    for name in in_order(recorded.states.keys() | changed.states.keys()):
        states = (run.states.get(name) for run in (recorded, changed))
        a_state, b_state = ("–" if of is None else of.state for of in states)
        rows.append((f"{name}: in the final map", a_state, b_state))
    for name in in_order(recorded.robots.keys() | changed.robots.keys()):
        a, b = (
            None if run.arbitrary_frame else run.robots.get(name) for run in (recorded, changed)
        )
        rows.append((f"{name}: online position RMSE [m]", _online(a), _online(b)))
        rows.append((f"{name}: smoothed position RMSE [m]", _smoothed(a), _smoothed(b)))
        rows.append((f"{name}: heading RMSE, smoothed [°]", _heading(a), _heading(b)))
        first, second = (_uplink(run.robots.get(name)) for run in (recorded, changed))
        rows.append((f"{name}: uplink [bytes/step]", first, second))
    return rows


def same_final_map(recorded: Evaluation, changed: Evaluation) -> bool:
    """Whether both ended with a map, and with the same bytes."""
    a, b = recorded.map, changed.map
    return a is not None and b is not None and a.payload_sha256 == b.payload_sha256


def largest_move_m(recorded: Evaluation, changed: Evaluation) -> float | None:
    """The largest distance between a landmark's two positions; None without a common landmark."""
    if recorded.map is None or changed.map is None:
        return None
    _, a, b = np.intersect1d(recorded.map.ids, changed.map.ids, return_indices=True)
    moves = recorded.map.means[a] - changed.map.means[b]
    return float(np.hypot(*moves.T).max()) if len(moves) else None


def comparison_picture(recorded: Evaluation, changed: Evaluation, path: Path) -> bool:
    """Both final maps with 95 % ellipses over the truth; False where there is neither."""
    if recorded.map is None and changed.map is None:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    truth = recorded.true_landmarks
    if len(truth):
        axis.plot(*truth.T, "x", color=TRUTH_COLOUR, markersize=8, label="true landmarks")
    if recorded.map is not None:
        _draw(axis, recorded.map, RECORDED_COLOUR, "recorded", ".")
    if changed.map is not None:
        _draw(axis, changed.map, CHANGED_COLOUR, "recomputed", "+")
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    axis.grid(color="#e4e4e4", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.set_title("Final maps with 95 % ellipses", fontsize=12)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=3, frameon=False)
    save(figure, path)
    return True


def _draw(axis: "Axes", fused: MapResult, colour: str, label: str, marker: str) -> None:
    axis.plot(
        *fused.means.T, marker, color=colour, markersize=8, markerfacecolor="none", label=label
    )
    draw_ellipses(axis, fused.means, landmark_blocks(fused.covariance), colour)


def _of_errors(run: Evaluation, name: str, form: str) -> str:
    """A figure of the map's errors; of a map in an arbitrary frame only the aligned ones."""
    errors = None if run.map is None else run.map.errors
    if run.arbitrary_frame and name != "aligned_rmse_m":
        errors = None
    return _shown(None if errors is None else getattr(errors, name), form)


def _messages(evaluation: Evaluation, key: str) -> int:
    traffic = evaluation.channels.get(key)
    return 0 if traffic is None else traffic.messages


def _online(robot: RobotResult | None) -> str:
    if robot is not None and robot.outside:
        return OUTSIDE
    errors = None if robot is None else robot.online
    return _shown(None if errors is None else errors.position_rmse_m, ".4f")


def _smoothed(robot: RobotResult | None) -> str:
    errors = None if robot is None else robot.smoothed
    return _shown(None if errors is None else errors.position_rmse_m, ".4f")


def _heading(robot: RobotResult | None) -> str:
    errors = None if robot is None else robot.smoothed
    return _shown(None if errors is None else degrees(errors.heading_rmse_rad), ".3f")


def _uplink(robot: RobotResult | None) -> str:
    return _shown(None if robot is None else robot.uplink_bytes_per_step, ".1f")


def _shown(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)
