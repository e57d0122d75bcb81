import numpy as np
import pytest

from teamslam.sim.datasets.utias import write_utias
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments import ma, ma_figures
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


def test_without_a_set_the_figures_say_where_to_get_one():
    for experiment in (ma_figures.FIGURE_6A, ma_figures.FIGURE_5):
        assert "MRCLAM" in experiment.outcome(Options((1,)), Results({})).missing[0]
