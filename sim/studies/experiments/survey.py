"""All estimators and rules on the same measurements, with the thesis' tables 2.1 and 2.2.

The thesis describes advantages and disadvantages in words; these are measurements of the
implemented methods, on its world and on the one with an accurate sensor.
"""

from typing import NamedTuple

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments.experiment import Options, Outcome, Results, Table, seed_count
from teamslam.sim.studies.experiments.task import Task
from teamslam.sim.studies.experiments.team_runs import (
    OURS,
    Figures,
    Shown,
    cells_of,
    named,
    over_seeds,
    table_of,
    team_task,
)
from teamslam.sim.studies.experiments.xu import with_particles
from teamslam.team.config import Estimator, FusionRule
from teamslam.team.pairs import PAIRS

WORLDS = ("thesis", "thesis-b")
MOST_SEEDS = 12
"""Most seeds: the methods differ by factors."""
PARTICLES = (50, 200, 1000)
SHOWN: Shown = (
    ("rmse", "map [m]", "{:.3f}"),
    ("rmse_aligned", "aligned", "{:.3f}"),
    ("online_position_rmse", "pose [m]", "{:.2f}"),
    ("online_position_rmse_aligned", "aligned", "{:.2f}"),
    ("position_rmse", "smoothed", "{:.2f}"),
    ("position_rmse_aligned", "aligned", "{:.2f}"),
    ("nees", "NEES/dof", "{:.3g}"),
    ("in_band", "in band", "{:.0%}"),
    ("online_pose_nees", "pose NEES", "{:.3g}"),
    ("bytes_per_step", "B/step", "{:.0f}"),
    ("us_per_step", "µs/step", "{:.0f}"),
    ("ms_per_fusion", "ms/fusion", "{:.2f}"),
)


class SurveyedMethod(NamedTuple):
    """A method of tables 2.1 and 2.2, and the pair that implements it."""

    method: str
    uncertainty: str
    online: str
    pros: str
    cons: str
    pair: tuple[Estimator, FusionRule] | None


POSTERIOR, LIKELIEST = "posterior poses and map", "maximum likelihood map"
SURVEYED = (
    SurveyedMethod("Kalman filter / EKF", POSTERIOR, "yes", "handles uncertainty, converges",
         "computational complexity", ("ekf-slam", "alone")),
    SurveyedMethod("graph based", LIKELIEST, "no", "linear memory",
         "needs the whole path", None),
    SurveyedMethod("expectation maximisation", LIKELIEST, "no", "optimal map, data association",
         "needs the whole path", None),
    SurveyedMethod("sparse extended information filter", POSTERIOR, "yes", "fast for large maps",
         "data association", None),
    SurveyedMethod("thin junction tree filter", POSTERIOR, "yes", "less computation",
         "size of the tree", None),
    SurveyedMethod("particle filter / FastSLAM", POSTERIOR, "yes", "low computational complexity",
         "over-confident, needs many particles", ("fastslam1", "alone")),
    SurveyedMethod("sub-maps", POSTERIOR, "yes", "less memory, large places",
         "many maps to merge", OURS),
    SurveyedMethod("hybrid, as in the thesis", POSTERIOR, "yes", "less memory",
         "data association", ("hybrid-thesis", "alone")),
)  # fmt: skip
BATCH = "graph based"
"""The batch MAP is this method's optimum."""


def tasks(options: Options) -> list[Task]:
    """Every pair and world; FastSLAM with few and many particles."""
    pairs = [task for world in WORLDS for pair in PAIRS for task in _runs(world, pair, options)]
    return pairs + [task for count in PARTICLES for task in _fastslam(count, options)]


def outcome(options: Options, results: Results) -> Outcome:
    """One table a world, and the thesis' two with numbers."""
    figures = {world: _world(world, options, results) for world in WORLDS}
    seeds = seed_count(len(options.seeds[:MOST_SEEDS]))
    tables = [
        table_of(
            f"{world}, two robots, {seeds}",
            "estimator + rule",
            of_world,
            SHOWN,
            "without a fused map the robots' own; pose: online; bytes: from a robot to the centre; "
            "times: of a processor",
        )
        for world, of_world in figures.items()
    ]
    particles = {
        str(count): _convert_times(over_seeds(results.of_all(_fastslam(count, options))))
        for count in PARTICLES
    }
    tables += [_table_2_1(figures["thesis"]), _table_2_2(figures["thesis"], particles)]
    absent = ", ".join(s.method for s in SURVEYED if s.pair is None and s.method != BATCH)
    return Outcome(
        "all estimators and rules on the same measurements",
        {"survey": figures, "fastslam_particles": particles},
        tuple(tables),
        remarks=(
            f"Not implemented, so without numbers: {absent}.",
            "Associations are known here, as in the thesis' own experiments: the statements of "
            "tables 2.1 and 2.2 on data association are not measured.",
        ),
    )


def _world(world: str, options: Options, results: Results) -> dict[str, Figures]:
    figures = {}
    for pair in PAIRS:
        runs = results.of_all(_runs(world, pair, options))
        if runs:
            figures[named(*pair)] = _convert_times(over_seeds(runs))
        batches = [run["batch"] for run in runs if "batch" in run]
        if batches:
            figures["batch"] = over_seeds(batches)
    return figures


def _convert_times(figures: Figures) -> Figures:
    step, fusion = figures.get("seconds_per_step"), figures.get("seconds_per_fusion")
    return figures | {
        "us_per_step": None if step is None else 1e6 * step,
        "ms_per_fusion": None if fusion is None else 1e3 * fusion,
    }


def _runs(world: str, pair: tuple[Estimator, FusionRule], options: Options) -> list[Task]:
    return [
        team_task(
            with_options(load(world), seed=seed, estimator=pair[0], fusion=pair[1]),
            batch=pair == OURS,
        )
        for seed in options.seeds[:MOST_SEEDS]
    ]


def _fastslam(particles: int, options: Options) -> list[Task]:
    return [
        team_task(
            with_particles(
                with_options(load("thesis"), seed=seed, estimator="fastslam1", fusion="alone"),
                particles,
            ),
            note=f"{particles} particles",
        )
        for seed in options.seeds[:MOST_SEEDS]
    ]


def _table_2_1(figures: dict[str, Figures]) -> Table:
    rows = []
    for surveyed in SURVEYED:
        found = _figures_of(surveyed, figures)
        measured = cells_of(
            found,
            (("nees", "", "{:.3g}"), ("online_pose_nees", "", "{:.3g}"),
             ("us_per_step", "", "{:.0f}")),
        )  # fmt: skip
        rows.append((surveyed.method, surveyed.uncertainty, surveyed.online, *measured))
    return Table(
        "table 2.1 of the thesis, with what was measured on `thesis`",
        ("method", "uncertainty", "online", "map NEES/dof", "pose NEES/dof", "µs/step"),
        tuple(rows),
        "NEES: 1 where the stated uncertainty is right; graph based: the batch MAP",
    )


def _table_2_2(figures: dict[str, Figures], particles: dict[str, Figures]) -> Table:
    columns: Shown = (
        ("rmse", "map [m]", "{:.2f}"),
        ("nees", "NEES/dof", "{:.3g}"),
        ("us_per_step", "µs/step", "{:.0f}"),
        ("bytes_per_step", "B/step", "{:.0f}"),
    )
    rows = [
        (
            surveyed.method,
            surveyed.pros,
            surveyed.cons,
            *cells_of(_figures_of(surveyed, figures), columns),
        )
        for surveyed in SURVEYED
    ]
    rows += [
        (f"… with {count} particles", "", "", *cells_of(found, columns))
        for count, found in particles.items()
    ]
    return Table(
        "table 2.2 of the thesis, with what was measured on `thesis`",
        ("method", "pros", "cons", *(heading for _, heading, _ in columns)),
        tuple(rows),
    )


def _figures_of(surveyed: SurveyedMethod, figures: dict[str, Figures]) -> Figures:
    if surveyed.method == BATCH:
        return figures.get("batch", {})
    return {} if surveyed.pair is None else figures.get(named(*surveyed.pair), {})
