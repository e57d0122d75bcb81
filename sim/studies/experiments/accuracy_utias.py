"""Real data: every given UTIAS set, one fixed profile.

`shape`: the error after alignment; its NEES per landmark is 2 for a correct covariance.
"""

from collections.abc import Mapping

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.studies.experiments.accuracy_starts import unknown_starts
from teamslam.sim.studies.experiments.experiment import (
    Dataset,
    Goal,
    Options,
    Outcome,
    Results,
    Task,
    without_datasets,
)
from teamslam.sim.studies.experiments.team_runs import Figures, Shown, table_of, team_task

NORMAL_SCALE = (0.8, 1.25)
"""Bounds of the monitor's covariance scale without truth, in units of `normal_scale`."""
MOST_ALIGNED_M = {"1": 0.027, "2": 0.022, "6": 0.024}
"""Largest aligned error [m] by the data set's number."""
MOST_RAW_TRAJECTORY_M = {"1": 0.035, "2": 0.070, "6": 0.116}
SHOWN: Shown = (
    ("aligned", "aligned [m]", "{:.4f}"),
    ("raw", "raw [m]", "{:.4f}"),
    ("nees", "NEES/dof", "{:.3g}"),
    ("shape_nees", "shape", "{:.3g}"),
    ("coverage", "covered", "{:.0%}"),
    ("covariance_scale", "scale", "{:.2f}"),
    ("trajectory_raw", "path [m]", "{:.3f}"),
    ("trajectory_aligned", "aligned [m]", "{:.3f}"),
    ("online_position_rmse", "online [m]", "{:.3f}"),
    ("online_pose_nees", "NEES/dof", "{:.3g}"),
    ("bytes_per_step", "B/step", "{:.1f}"),
)
ROBOT: Shown = (
    ("position_rmse", "path raw [m]", "{:.3f}"),
    ("position_rmse_aligned", "aligned [m]", "{:.3f}"),
    ("pose_nees", "NEES/dof", "{:.3g}"),
    ("online_position_rmse", "online [m]", "{:.3f}"),
    ("online_pose_nees", "NEES/dof", "{:.3g}"),
)


def outcome(options: Options, results: Results) -> Outcome:
    """Figures of sets and robots."""
    if not options.datasets:
        return Outcome(
            "real data", {"utias": {}}, missing=(without_datasets("figures on real data"),)
        )
    figures, unknown = (
        {
            dataset.name: _set_figures(run)
            for dataset in options.datasets
            if (run := results.of(task_on(dataset))) is not None
        }
        for task_on in (team_on, _unknown_task)
    )
    batches = {f"{name}, batch": s["batch"] for name, s in figures.items() if "batch" in s}
    rows = figures | batches | {f"{name}, one start known": s for name, s in unknown.items()}
    robots = {
        f"{name}, {robot}": of_robot
        for name, of_set in figures.items()
        for robot, of_robot in of_set["robots"].items()
    }
    goals = [goal for dataset in options.datasets for goal in _goals(dataset, figures)]
    goals += [
        Goal(f"{name}, one start known: aligned [m]", of_set["aligned"], 0.0, 1.1 * known)
        for name, of_set in unknown.items()
        if (known := figures.get(name, {}).get("aligned")) is not None
    ]
    return Outcome(
        "real data",
        {"utias": figures, "utias_unknown_starts": unknown},
        (
            table_of(
                "UTIAS, five robots, one profile",
                "set",
                rows,
                SHOWN,
                "landmarks aligned and raw, their NEES as they lie, and per landmark of the shape "
                "(2 is right); the monitor's covariance scale, 1 is right; paths raw and aligned; "
                "online poses",
            ),
            table_of("each robot", "robot", robots, ROBOT),
        ),
        goals=tuple(goals),
    )


def _set_figures(run: Figures) -> Figures:
    renamed = {
        "aligned": "rmse_aligned",
        "raw": "rmse",
        "trajectory_raw": "position_rmse",
        "trajectory_aligned": "position_rmse_aligned",
    }
    figures = {new: run.get(old) for new, old in renamed.items()} | {
        name: value for name, value in run.items() if name not in renamed.values()
    }
    if "batch" in run:
        figures["batch"] = _set_figures(run["batch"])
    return figures


def team_on(dataset: Dataset) -> Task:
    """The team on a set, with the batch."""
    return team_task(load("utias"), dataset=dataset, batch=True, noise="profile")


def _unknown_task(dataset: Dataset) -> Task:
    return team_task(unknown_starts(load("utias")), dataset=dataset, note="unknown starts")


def _goals(dataset: Dataset, figures: Mapping[str, Figures]) -> list[Goal]:
    name, of_set = dataset.name, figures.get(dataset.name, {})
    number = "".join(each for each in name if each.isdigit())
    goals = [
        Goal(f"{name}: shape_nees", of_set.get("shape_nees"), 1.0, 3.5),
        Goal(f"{name}: coverage", of_set.get("coverage"), 0.8, 1.0),
        Goal(f"{name}: covariance_scale", of_set.get("covariance_scale"), *NORMAL_SCALE),
    ]
    for figure, most in (("aligned", MOST_ALIGNED_M), ("trajectory_raw", MOST_RAW_TRAJECTORY_M)):
        if number in most:
            goals.append(Goal(f"{name}: {figure} [m]", of_set.get(figure), 0.0, most[number]))
    return goals
