from pathlib import Path

import pytest

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments.downs import TABLE_5_1
from teamslam.sim.studies.experiments.downs_joined import spherical_task
from teamslam.sim.studies.experiments.experiment import Dataset, Options, Results, runs_of
from tests.scenarios import with_world

SET_1 = Dataset("MRCLAM_Dataset1", Path("MRCLAM_Dataset1.zip"), "0" * 64)


def test_submaps_of_a_step_make_a_map_with_the_identity_and_a_better_one_with_covariances():
    scenario = with_options(load("downs-100"), robots=2)
    result = spherical_task(with_world(scenario, steps=60)).run()
    assert set(result["robots"]) == {"r1", "r2"}
    for robot in result["robots"].values():
        assert robot["submaps"] == pytest.approx(60, abs=2)
        assert 0 < robot["rmse"] < 2.0
        assert robot["rmse_aligned"] < 0.5
        assert 0 < robot["position_rmse"] < 2.0
        assert robot["landmarks"] > 10
    assert result["with_covariances"]["rmse"] < 0.5 * result["team"]["rmse"]


def test_the_map_of_the_first_set_is_drawn_beside_the_errors(tmp_path):
    options = Options((1,), datasets=(SET_1,))
    sample = {
        "robot": "r1",
        "means": [[1.0, 2.0], [-1.0, 0.5]],
        "blocks": [[[0.01, 0.0], [0.0, 0.02]]] * 2,
        "landmarks": [[1.1, 2.0], [-1.0, 0.4]],
        "online": [[0.0, 0.0], [0.5, 0.1]],
        "truth": [[0.0, 0.0], [0.5, 0.0]],
    }
    robots = {f"r{k}": {"rmse": 0.1 * k, "rmse_aligned": 0.02 * k} for k in range(1, 6)}
    results = {t.name: {"robots": robots, "sample": sample} for t in runs_of(TABLE_5_1, options)}
    outcome = TABLE_5_1.outcome(options, Results(results))
    assert [picture.name for picture in outcome.pictures] == ["errors", "sample-real"]
    for picture in outcome.pictures:
        picture.draw(tmp_path / "picture.png")
        assert (tmp_path / "picture.png").stat().st_size > 10_000
