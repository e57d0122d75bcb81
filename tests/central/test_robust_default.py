from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import MapErrors, map_errors
from teamslam.central.desk.evaluation.evaluation import Evaluation, evaluate
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.source import streams_of
from tests.scenarios import final_only, scenario_in
from tests.trials.stress_world import CarriedOff, MovedLandmark, StressWorld, write

WORLD = StressWorld(seed=3, landmarks=20, half_m=14.0, seconds=150.0)
FAULTS = {
    "20 % outliers": replace(WORLD, outlier_share=0.2),
    "moved by 2 m": replace(WORLD, moved=(MovedLandmark(7, (1.4, 1.4), 75.0),)),
    "one identity of two": replace(WORLD, same_id=((7, 9),)),
    "carried off": replace(WORLD, carried_off=(CarriedOff("r2", 8.0, 2.0, 75.0),)),
}
WRONG = (7, 9)
"""Landmarks that are left out of the comparison: only the rest of the map must be right."""


def final(world: StressWorld, folder: Path) -> Evaluation:
    scenario = final_only(scenario_in(write(world, folder)))
    return evaluate(list(run_team(scenario, streams_of(scenario))))


def errors_of_rest(result: Evaluation) -> MapErrors:
    found = result.map
    assert found is not None
    kept = np.flatnonzero(found.known & ~np.isin(found.ids, WRONG))
    rows = np.column_stack([2 * kept, 2 * kept + 1]).ravel()
    return map_errors(found.means[kept], found.covariance[np.ix_(rows, rows)], found.truth[kept])


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return errors_of_rest(final(WORLD, tmp_path_factory.mktemp("clean")))


@pytest.mark.parametrize("fault", FAULTS)
def test_the_rest_of_the_map_is_right(fault, clean, tmp_path):
    found = final(FAULTS[fault], tmp_path)
    of_rest = errors_of_rest(found)
    assert of_rest.count >= clean.count - 1
    assert of_rest.nees_per_dof < 2.2
    assert of_rest.aligned_rmse_m is not None
    assert clean.aligned_rmse_m is not None
    assert of_rest.aligned_rmse_m < 2.0 * clean.aligned_rmse_m
    assert not [robot for robot, of in found.states.items() if of.state == "withdrawn"]
