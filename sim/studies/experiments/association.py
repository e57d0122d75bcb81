"""Data association over landmark spacing, clutter and missed detections."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.figures import to_json
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments.drawing import add_grid, figure
from teamslam.sim.studies.experiments.experiment import Options, Outcome, Picture, Results, Task
from teamslam.sim.studies.experiments.team_runs import (
    Figures,
    mean,
    table_of,
    with_robots,
    with_world,
)
from teamslam.team.config import Estimator, FusionRule

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.figure import Figure

SIZE_M, LANDMARKS, VIEW_M, STEPS = 60.0, 40, 12.0, 150
SPACING_M = 0.5 * SIZE_M / LANDMARKS**0.5  # mean distance of a landmark from its nearest neighbour
RATIOS = (4.0, 6.0, 10.0, 20.0, 40.0)
CLUTTER = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
MISSED = (0.0, 0.1, 0.2, 0.3, 0.5)
RATIO, FEW = 20.0, 2


class _System(NamedTuple):
    name: str
    estimator: Estimator
    fusion: FusionRule
    named: bool = False


OURS = _System("ours", "hybrid", "join")
NAMED = _System("with names", "hybrid", "join", named=True)
SYSTEMS = (
    OURS,
    NAMED,
    _System("EKF, nearest neighbour", "ekf-slam", "alone"),
    _System("FastSLAM, likelihood", "fastslam1", "alone"),
)
AXES: dict[str, tuple[float, ...]] = {
    "spacing / noise": RATIOS,
    "clutter": CLUTTER,
    "missed": MISSED,
}
FIGURES = (
    ("f1", "F1", "{:.3f}"),
    ("wrong_percent", "wrong %", "{:.2f}"),
    ("duplicates", "duplicates", "{:.1f}"),
    ("merges_wrong", "wrong merges", "{:.2f}"),
    ("rmse", "RMSE [m]", "{:.3f}"),
    ("ratio", "RMSE ÷ with names", "{:.2f}"),
    ("nees", "shape NEES / 2", "{:.2f}"),
    ("gospa", "GOSPA [m]", "{:.2f}"),
)


def _values(axis: str, options: Options) -> Sequence[float]:
    values = AXES[axis]
    return values[:: max(len(values) // FEW, 1)] if options.quick else values


def _tasks(axis: str, value: float, system: _System, options: Options) -> list[Task]:
    ratio = value if axis == "spacing / noise" else RATIO
    clutter = value if axis == "clutter" else 0.0
    missed = value if axis == "missed" else 0.0
    return [
        Task(
            "teamslam.sim.studies.experiments.association:association_run",
            {
                "estimator": system.estimator,
                "fusion": system.fusion,
                "named": system.named,
                "ratio": ratio,
                "clutter": 0.0 if system.named else clutter,
                "missed": missed,
                "seed": seed,
            },
            f"{system.name}, {axis} {value:g}, seed {seed}",
            4.0,
        )
        for seed in options.seeds
    ]


def association_run(
    estimator: str,
    fusion: str,
    named: bool,
    ratio: float,
    clutter: float,
    missed: float,
    seed: int,
) -> dict[str, Any]:
    """Figures of one run; baselines have one robot."""
    alone = fusion == "alone"
    scenario = load("waypoints")
    error_m = SPACING_M / ratio
    sensor = {"range_sigma": 0.6 * error_m, "bearing_sigma": 0.8 * error_m / VIEW_M}
    scenario = with_world(
        msgspec.structs.replace(scenario, robots=scenario.robots[:1]),
        size_m=SIZE_M,
        landmark_count=LANDMARKS,
        visible_to_m=VIEW_M,
        steps=STEPS,
        clutter=clutter,
        missed=missed,
    )
    scenario = with_options(
        with_robots(scenario, "sensor", **sensor),
        seed=seed,
        robots=1 if alone else 2,
        estimator=estimator,
        fusion=fusion,
        identities=None if named else "hidden",
    )
    found = to_json(evaluate(run_team(scenario, streams_of(scenario))))
    scores = found["association"] or {}
    shape = found["shape_nees_per_landmark"]
    return {
        "seed": seed,
        "rmse": found["landmark_rmse_aligned_m"],
        "nees": None if shape is None else 0.5 * shape,
        "gospa": None if found["gospa"] is None else found["gospa"]["distance_m"],
        "merges_wrong": None if alone else scores.get("merges_wrong"),
    } | {name: scores.get(name) for name in ("f1", "wrong_percent", "duplicates")}


def outcome(options: Options, results: Results) -> Outcome:
    """A table and a picture for each axis."""
    figures: dict[str, dict[str, dict[str, dict[str, float | None]]]] = {}
    tables = []
    for axis in AXES:
        of_axis = figures.setdefault(axis, {})
        rows: dict[str, Figures] = {}
        for value in _values(axis, options):
            named = _means(results.of_all(_tasks(axis, value, NAMED, options)))
            for system in SYSTEMS:
                means = _means(results.of_all(_tasks(axis, value, system, options)))
                rmse, beside = means.get("rmse"), named.get("rmse")
                means["ratio"] = rmse / beside if rmse and beside and system == OURS else None
                of_axis.setdefault(system.name, {})[f"{value:g}"] = means
                rows[f"{value:g}: {system.name}"] = means
        tables.append(
            table_of(
                f"over {axis}, {options.seed_count}",
                axis,
                rows,
                FIGURES,
                "ours and with names: two robots, one map; the others one robot. Wrong: detections "
                "in a landmark of another label; duplicates: landmarks beyond the first of a "
                "label. Of shape NEES / 2 1 is right",
            )
        )
    return Outcome(
        "landmarks without names",
        {"association": figures},
        tuple(tables),
        tuple(_picture(axis, figures[axis]) for axis in AXES),
        remarks=(
            f"{LANDMARKS} landmarks uniform in {SIZE_M:g} m × {SIZE_M:g} m, nearest neighbours "
            f"{SPACING_M:.1f} m apart in the mean; noise is the error at {VIEW_M:g} m, the end of "
            f"the view. Clutter and missed detections at spacing / noise {RATIO:g}.",
        ),
    )


def _means(runs: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    return {name: mean(run.get(name) for run in runs) for name, _, _ in FIGURES}


def _picture(axis: str, of_axis: dict[str, dict[str, dict[str, float | None]]]) -> Picture:
    def draw(path: Path) -> None:
        _draw_curves(axis, of_axis).savefig(path, dpi=120)

    return Picture(axis.replace(" / ", "-"), f"Association over {axis}.", draw)


def _draw_curves(axis: str, of_axis: dict[str, dict[str, dict[str, float | None]]]) -> "Figure":
    shown = [each for each in FIGURES if each[0] not in ("wrong_percent", "gospa")]
    made = figure(12.0, 6.0)
    colours = {system.name: f"C{k}" for k, system in enumerate(SYSTEMS)}
    curves = {}
    for axes, (name, heading, _) in zip(made.subplots(2, 3).flat, shown, strict=True):
        for system, points in of_axis.items():
            at = [(float(x), means[name]) for x, means in points.items()]
            known = [(x, y) for x, y in at if y is not None]
            if known:
                curves[system], *_ = axes.plot(
                    *zip(*known, strict=True), marker="o", markersize=3, color=colours[system]
                )
        axes.set_xlabel(axis)
        axes.set_title(heading, fontsize=10)
        if axis == "spacing / noise":
            axes.set_xscale("log", base=2)
            axes.set_xticks(AXES[axis])
            axes.xaxis.set_major_formatter("{x:g}")
        if name in ("rmse", "nees"):
            axes.set_yscale("log", subs=(2, 5))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:g}")
        if name in ("duplicates", "merges_wrong"):
            axes.set_ylim(0.0, max(1.0, axes.get_ylim()[1]))
        add_grid(axes)
    order = [system.name for system in SYSTEMS if system.name in curves]
    made.legend(
        [curves[name] for name in order],
        order,
        fontsize=8,
        ncols=len(order),
        loc="outside lower center",
    )
    return made
