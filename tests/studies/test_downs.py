"""The experiments after Downs' thesis: his protocol on his simulator, his tables and tests."""

import msgspec
import numpy as np
import pytest

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments import downs_minima
from teamslam.sim.studies.experiments.downs_joined import spherical_task
from teamslam.sim.studies.experiments.team_runs import Figures
from teamslam.team.estimation.map_joining.alignment import procrustes


def test_submaps_of_a_step_make_a_map_with_the_identity_and_a_better_one_with_covariances():
    scenario = with_options(load("downs-100"), robots=2)
    world = msgspec.structs.replace(scenario.world, steps=60)
    result = spherical_task(msgspec.structs.replace(scenario, world=world)).run()
    assert set(result["robots"]) == {"r1", "r2"}
    for robot in result["robots"].values():
        assert robot["submaps"] == pytest.approx(60, abs=2)
        assert 0 < robot["rmse"] < 2.0
        assert robot["rmse_aligned"] < 0.5
        assert 0 < robot["position_rmse"] < 2.0
        assert len(robot["map"]["ids"]) == robot["landmarks"]
    assert result["with_covariances"]["rmse"] < 0.5 * result["team"]["rmse"]


def _map(points: np.ndarray, sigma: float) -> Figures:
    return {
        "ids": list(range(len(points))),
        "means": points.tolist(),
        "covariance": (sigma**2 * np.eye(2 * len(points))).tolist(),
    }


def test_the_shared_map_has_one_minimum_and_evolution_finds_that_of_the_closed_form():
    points = np.array([[0.0, 0.0], [5.0, 1.0], [2.0, 7.0], [-4.0, 3.0]])
    turned = points @ np.array([[0.0, -1.0], [1.0, 0.0]]) + [3.0, -2.0]
    turned[2] += 0.3
    pair = downs_minima.common(_map(points, 0.1), _map(turned, 0.2))
    turns = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    assert downs_minima.minima(downs_minima.profile(pair, turns)) == 1
    assert downs_minima.minima(np.cos(2.0 * turns)) == 2
    closed = procrustes(points, turned, np.ones(4))
    np.testing.assert_allclose(downs_minima.evolved(pair, 1), closed, atol=1e-4)
    alike, weighted = (
        kind(pair, turns) for kind in (downs_minima.profile, downs_minima.profile_with_covariances)
    )
    np.testing.assert_allclose(weighted, 2.0 * alike / (0.1**2 + 0.2**2), rtol=1e-9)
