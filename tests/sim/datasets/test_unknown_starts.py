from pathlib import Path

import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments.accuracy_starts import is_wrong, unknown_starts
from teamslam.sim.studies.experiments.team_runs import Figures, team_figures
from tests.scenarios import with_robots, with_world

SET_6 = Path(__file__).parents[4] / "shared" / "utias" / "MRCLAM_Dataset6.zip"


def slice_of_set_6() -> Scenario:
    scenario = with_options(load("utias"), dataset=SET_6)
    return with_robots(with_world(scenario, duration_s=100.0), pose_s=60.0)


def figures(scenario: Scenario) -> Figures:
    return team_figures(evaluate(run_team(scenario, streams_of(scenario))))


@pytest.mark.skipif(not SET_6.exists(), reason="the data set is not here: it is not shipped")
def test_one_declared_start_gives_the_map_that_five_give_and_joins_nobody_wrongly():
    declared = figures(slice_of_set_6())
    found = figures(unknown_starts(slice_of_set_6()))
    assert found["not_joined"] == []
    assert not any(is_wrong(each["first_pose_chi2"]) for each in found["robots"].values())
    assert found["landmarks"] == declared["landmarks"]
    assert found["rmse_aligned"] == pytest.approx(declared["rmse_aligned"], rel=0.1)
