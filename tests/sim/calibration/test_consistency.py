from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.tick_fold import join_settings
from teamslam.sim.calibration.consistency import (
    central_figures,
    covariance_factor,
    disagreements,
    landmark_sigma,
)
from teamslam.sim.calibration.figures import Figure
from teamslam.sim.scenarios.scenario import load
from teamslam.team.estimation.map_joining.joining import Fold, JoinSettings, solve_fold
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import team

SIGMAS = (0.05, 0.01, 0.1)


@cache
def folds_of(seeds, claimed=1.0):
    folds: list[Fold] = []
    for seed in seeds:
        world = team(seed, robots=4, submaps=8, landmarks=8, reach=30.0, sigmas=SIGMAS)
        submaps = [told(each, claimed) for each in world.submaps]
        fold = joined_with(submaps, world.starts, (), JoinSettings(), len(submaps))
        folds.append(solve_fold(fold, JoinSettings()))
    return folds


def told(contribution, claimed):
    local = replace(contribution.local, covariance=claimed * contribution.local.covariance)
    return replace(contribution, local=local)


def test_robots_whose_covariances_are_right_disagree_as_much_as_they_say():
    settings = join_settings(CentralConfig())
    found = np.array(
        [each for fold in folds_of(range(30)) for each in disagreements(fold, settings)]
    )
    assert len(found) == 120
    assert (found[:, 1] == 13).all()
    # The four of a team share submaps in the others' maps, so their D is not independent.
    assert found[:, 0].sum() / found[:, 1].sum() == pytest.approx(1.0, abs=0.15)


def test_the_factor_makes_up_for_covariances_that_are_too_small():
    factor = covariance_factor(folds_of(range(12), 0.4), CentralConfig())
    assert factor.value == pytest.approx(2.5, rel=0.2)
    assert 0.0 < factor.sigma < 0.4


def test_figures_of_the_team_are_named_as_the_centres_fields():
    stray = Figure("bias_sigma.range_scale", 0.01, 0.001, "")
    found = central_figures(folds_of(range(12), 0.4), load("thesis"), [stray], lambda _: None)
    assert [each.name for each in found] == [stray.name, "covariance_factor", "normal_scale"]
    assert found[-1].value == pytest.approx(1.0, abs=0.3)


def test_how_far_all_robots_see_landmarks_from_their_survey_is_learnt_by_the_truth():
    folds, config = folds_of(range(30))[:12], CentralConfig()
    rng = np.random.default_rng(5)
    exact = [
        dict(enumerate(team(seed, robots=4, submaps=8, landmarks=8).landmarks))
        for seed in range(12)
    ]
    surveyed = [
        {id_: place + rng.normal(0.0, 0.08, 2) for id_, place in each.items()} for each in exact
    ]
    none = landmark_sigma(list(zip(folds, exact, strict=True)), config)
    found = landmark_sigma(list(zip(folds, surveyed, strict=True)), config)
    assert none.value < 0.02
    assert found.value == pytest.approx(0.08, abs=3.0 * found.sigma)
    assert found.sigma < 0.015


def test_where_the_covariances_are_wider_than_the_errors_landmarks_have_no_sigma():
    folds = folds_of(range(5), 4.0)[:4]
    true = [
        dict(enumerate(team(seed, robots=4, submaps=8, landmarks=8).landmarks)) for seed in range(4)
    ]
    found = landmark_sigma(list(zip(folds, true, strict=True)), CentralConfig())
    assert found.value == 0.0
