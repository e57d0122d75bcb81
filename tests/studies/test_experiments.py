"""Experiments: figures over seeds, goals, the page, the command line."""

import json

import pytest
from typer.testing import CliRunner

from teamslam.sim.cli.main import app
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments import accuracy_few, accuracy_worlds
from teamslam.sim.studies.experiments.catalogue import ENTRIES, Entry
from teamslam.sim.studies.experiments.curves import curves_task
from teamslam.sim.studies.experiments.experiment import (
    Goal,
    Options,
    Outcome,
    Picture,
    Results,
    Table,
)
from teamslam.sim.studies.experiments.output import to_json, write
from teamslam.sim.studies.experiments.parameters import kinds_of
from teamslam.sim.studies.experiments.runner import Concluded, planned
from teamslam.sim.studies.experiments.team_runs import Figures, over_seeds
from teamslam.sim.studies.experiments.xu import with_particles


def run(rmse: float, nees: float = 1.0, batch: float | None = 0.5, seed: int = 1) -> Figures:
    figures: Figures = {"rmse": rmse, "nees": nees, "in_band": 1.0, "bytes_per_step": 58.0}
    figures["seed"] = seed
    if batch is not None:
        figures["batch"] = {"rmse": batch, "nees": 1.0, "in_band": True}
    return figures


def test_errors_are_root_mean_squares_and_all_else_means():
    figures = over_seeds([run(3.0, 0.8), run(4.0, 1.6)])
    assert figures["seeds"] == 2
    assert figures["rmse"] == pytest.approx(12.5**0.5)
    assert figures["nees"] == pytest.approx(1.2)
    assert figures["in_band"] == 1.0


def test_the_ratio_is_of_the_rms_over_the_same_seeds_to_the_batch_of_the_default_pair():
    runs = {
        "hybrid + join": [run(0.6), run(0.8, batch=1.0, seed=2)],
        "hybrid + kalman": [run(2.0, 9.0, None)],
    }
    figures = accuracy_worlds.world_figures(runs)
    assert figures["hybrid + join"]["ratio"] == pytest.approx((0.5 / 0.625) ** 0.5)
    assert figures["hybrid + kalman"]["ratio"] == pytest.approx(4.0)
    assert figures["batch"]["ratio"] == 1.0


@pytest.mark.parametrize(
    ("value", "passed"),
    [(1.0, True), (1.2, False), (0.7, False), (float("nan"), False), (None, None)],
)
def test_a_goal_is_passed_within_its_bounds_only(value, passed):
    assert Goal("nees", value, 0.8, 1.15).passed == passed


def test_a_team_that_counts_measurements_twice_misses_the_goals():
    options = Options((1,), quick=True)
    tasks = accuracy_worlds.tasks(options)
    honest = Results({task.name: run(0.5) | _POSES for task in tasks})
    twice = Results({task.name: run(0.5, 2.0) | _POSES for task in tasks})
    reached = [goal.passed for goal in accuracy_worlds.outcome(options, honest).goals]
    assert reached
    assert False not in reached
    missed = [
        goal for goal in accuracy_worlds.outcome(options, twice).goals if goal.passed is False
    ]
    assert {goal.figure.rpartition(" ")[2] for goal in missed} == {"nees"}


_POSES = {"final_pose_nees": 1.0, "online_pose_nees": 1.0, "each_once": True}


def test_every_experiment_plans_runs_and_lives_without_any_result():
    for entry in ENTRIES:
        options = Options((1, 2), quick=True)
        plan = planned(entry, options)
        assert len({task.name for task in plan.tasks}) == len(plan.tasks)
        outcome = plan.experiment.outcome(options, Results({}))
        assert outcome.title
        assert all(goal.passed is None for goal in outcome.goals)


def concluded() -> Concluded:
    table = Table("errors", ("rule", "rmse [m]"), (("join", "<0.5>"),), "of the map")
    outcome = Outcome(
        "a title",
        {"rmse": float("nan"), "all": [1.0, float("inf")]},
        (table,),
        (Picture("curve", "a curve", lambda path: path.write_bytes(b"\x89PNG")),),
        (Goal("nees", 1.3, 0.8, 1.2),),
        ("a remark",),
        ("a data set",),
    )
    return Concluded(Entry("some", "", "Something."), Options((3, 4)), outcome, 2, {"run": "why"})


def test_the_json_has_the_figures_the_goals_and_what_is_missing_and_no_nan(tmp_path):
    content = to_json(concluded(), {"version.numpy": "2"})
    assert content["rmse"] is None
    assert content["all"] == [1.0, None]
    assert content["goals"][0]["passed"] is False
    assert content["missing"] == ["a data set"]
    assert content["failed"] == {"run": "why"}
    assert content["seeds"] == [3, 4]
    json.dumps(content, allow_nan=False)


def test_the_page_stands_alone_and_escapes_what_it_shows(tmp_path):
    page = write([concluded()], tmp_path, "index", {"version.numpy": "2"}).read_text()
    assert "&lt;0.5&gt;" in page
    assert "data:image/png;base64," in page
    assert 'name="viewport"' in page
    for said in ("a title", "a remark", "a data set", "MISSED", "version.numpy", "a curve"):
        assert said in page
    assert "http" not in page
    assert (tmp_path / "some-curve.png").read_bytes() == b"\x89PNG"
    assert json.loads((tmp_path / "some.json").read_text())["experiment"] == "some"


def test_the_parameters_of_a_run_are_said_where_they_differ_from_its_scenario():
    scenario = with_particles(with_options(load("thesis"), seed=7, robots=1), 50)
    tasks = [curves_task(with_options(scenario, seed=seed), label="t") for seed in (1, 2)]
    ((label, count, said),) = kinds_of(tasks)
    assert (label, count) == ("t, hybrid + join", 2)
    assert "world: thesis, robots.front_end.particles = 50, central.particles = 50" in said
    ((_, _, said),) = kinds_of([curves_task(load("thesis"))])
    assert said.endswith("thesis, as it is")


def test_help_lists_every_experiment():
    shown = CliRunner().invoke(app, ["experiment", "--help"], terminal_width=100)
    assert shown.exit_code == 0
    for entry in ENTRIES:
        assert f" {entry.name} " in shown.output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no-such"], "No such command"),
        (["accuracy", "--seeds", "0"], "--seeds"),
        (["accuracy", "--json", "nowhere/at/all.json"], "no such folder"),
    ],
)
def test_wrong_use_ends_with_2_and_says_what_is_wrong(arguments, said):
    refused = CliRunner().invoke(app, ["experiment", *arguments])
    assert refused.exit_code == 2
    assert said in refused.output


def few_run(
    first_chi2: float | None, shape_nees: float, said: list[str], wrong: bool = False
) -> Figures:
    robots = {"r1": {"first_pose_chi2": 1.0}, "r2": {"first_pose_chi2": first_chi2}}
    figures: Figures = {"rmse_aligned": 0.5, "shape_nees": shape_nees, "landmarks": 4.0}
    figures["minimum"] = {"wrong": wrong, "excluded": False}
    return figures | {"robots": robots, "not_joined": [], "reasons": said}


SURVEYED = ["another map fits about as well"]


@pytest.mark.parametrize(
    ("run", "wrong", "silent", "beyond", "untold", "alarms"),
    [
        (few_run(2.0, 2.0, []), 0, 0, 0, 0, 0),
        (few_run(2.0, 2.0, SURVEYED), 0, 0, 0, 0, 1),
        (few_run(2.0, 2.0, ["r2 (incarnation 1) is placed weakly: …"]), 0, 0, 0, 0, 0),
        (few_run(20.0, 2.0, []), 0, 0, 1, 1, 0),
        (few_run(2.0, 12.0, []), 0, 0, 1, 1, 0),
        (few_run(20.0, 2.0, SURVEYED), 0, 0, 1, 0, 0),
        (few_run(None, 2.0, []), 0, 0, 0, 0, 0),
        (few_run(2.0, 2.0, [], wrong=True), 1, 1, 0, 0, 0),
        (few_run(2.0, 2.0, SURVEYED, wrong=True), 1, 0, 0, 0, 0),
    ],
)
def test_a_wrong_map_of_few_landmarks_is_counted_and_silent_if_nothing_is_said(
    run, wrong, silent, beyond, untold, alarms
):
    figures = accuracy_few.few_figures([run])
    names = ("wrong", "silent", "beyond", "beyond_silent", "alarms")
    assert tuple(figures[name] for name in names) == (wrong, silent, beyond, untold, alarms)
