import pytest

from teamslam.sim.studies.experiments import accuracy_worlds
from teamslam.sim.studies.experiments.experiment import Goal, Options, Results, runs_of
from teamslam.sim.studies.experiments.team_runs import Figures, over_seeds
from tests import commands


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
    tasks = runs_of(accuracy_worlds, options)
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


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no-such"], "No such command"),
        (["accuracy", "--seeds", "0"], "--seeds"),
        (["accuracy", "--json", "nowhere/at/all.json"], "no such folder"),
    ],
)
def test_wrong_use_ends_with_2_and_says_what_is_wrong(arguments, said):
    refused = commands.output_of("experiment", *arguments, status=2)
    assert said in refused
