"""Ma & Ma's figures on a small set in the UTIAS format, written from a simulated world."""

import numpy as np
import pytest

from teamslam.sim.datasets.utias_writer import write_utias
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments import ma, ma_errors, ma_maps
from teamslam.sim.studies.experiments.experiment import Options, Results
from teamslam.sim.studies.experiments.runner import dataset

FRAMES = 300


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    write_utias(streams_of(load("waypoints")), folder)
    return dataset(folder)


@pytest.fixture(scope="module")
def runs(small):
    methods = (ma.DEAD_RECKONING, ma.SINGLE, ma.MULTI_3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ma, "FRAMES", FRAMES)
        return {method.name: ma.ma_task(small, method, 1).run() for method in methods}


def test_fastslam_says_its_particles_and_dead_reckoning_has_none(runs):
    assert runs[ma.DEAD_RECKONING.name]["clouds"] == []
    assert runs[ma.DEAD_RECKONING.name]["map"] is None
    single = runs[ma.SINGLE.name]
    line = np.array(single["robots"]["r1"]["line"])
    clouds = [np.array(cloud) for cloud in single["clouds"]]
    assert len(clouds) == 8
    for cloud in clouds:
        distances = np.hypot(*(line - cloud.mean(axis=0)).T)
        assert distances.min() < 3.0 * np.hypot(*cloud.std(axis=0)) + 0.1
        assert np.hypot(*cloud.std(axis=0)) < 5.0


def test_errors_are_told_over_frames_from_the_first_pose_on(runs):
    for run in runs.values():
        for robot in run["robots"].values():
            frames = robot["curve"]["time_s"]
            assert 0.0 <= frames[0] < frames[-1] <= FRAMES
            assert frames == sorted(frames)
    assert list(runs[ma.MULTI_3.name]["robots"]) == ["r1", "r2", "r3"]


def test_the_last_error_of_the_map_is_the_mean_distance_of_its_landmarks(runs):
    for name in (ma.SINGLE.name, ma.MULTI_3.name):
        found = runs[name]["map"]
        truth = np.array(runs[name]["truth"])
        nearest = [np.hypot(*(truth - mean).T).min() for mean in np.array(found["means"])]
        assert found["curve"]["error_m"][-1] == pytest.approx(np.mean(nearest), rel=1e-3)


def test_the_figures_of_a_set_are_tables_and_pictures(small, runs, tmp_path):
    options = Options((1,), datasets=(small,))
    results = Results(
        {
            ma.ma_task(small, method, 1).name: runs[method.name]
            for method in (ma.DEAD_RECKONING, ma.SINGLE, ma.MULTI_3)
        }
    )
    for experiment in (ma_errors.FIGURE_4A, ma_errors.FIGURE_6B, ma_maps.FIGURE_3):
        assert len(experiment.tasks(options)) == len(experiment.methods)
        outcome = experiment.outcome(options, results)
        assert outcome.tables[0].rows
        assert not outcome.missing
        path = tmp_path / "picture.png"
        outcome.pictures[0].draw(path)
        assert path.stat().st_size > 10_000


def test_without_a_set_the_figures_say_where_to_get_one():
    for experiment in (ma_errors.FIGURE_6A, ma_maps.FIGURE_5):
        assert "MRCLAM" in experiment.outcome(Options((1,)), Results({})).missing[0]
