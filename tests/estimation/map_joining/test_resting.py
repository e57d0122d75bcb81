from dataclasses import replace

import numpy as np
import pytest

from teamslam.team.estimation.map_joining import landmark_view, marginals
from teamslam.team.estimation.map_joining.condensing import Limits, condense_submaps
from teamslam.team.estimation.map_joining.gauss_newton import degrees_of_freedom, final_cost
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    JoinSettings,
    add_start,
    fold_submaps,
)
from tests.estimation.submap_world import team

ROBUST = JoinSettings()
NEVER = 1_000_000


def world(seed, submaps=24):
    return team(seed, submaps=submaps, landmarks=40, size=40.0, reach=10.0)


def ticks_of(found):
    ends = sorted({each.end_ns for each in found.submaps})
    return [[each for each in found.submaps if each.end_ns == end] for end in ends]


def folds(found, settings, first, starts=None):
    fold = EMPTY_FOLD
    for start in found.starts if starts is None else starts:
        fold = add_start(fold, start)
    for tick in ticks_of(found):
        fold = fold_submaps(condense_submaps(fold, Limits(0, lag=2, first=first)), tick, settings)
        yield fold


def at_rest(fold):
    return set(landmark_view.resting(fold.main))


@pytest.mark.parametrize(
    "settings", [JoinSettings(robust=False), ROBUST], ids=["squares", "robust"]
)
def test_a_fold_whose_landmarks_rest_and_wake_is_the_fold_in_which_none_rests(settings):
    resting, woke = set(), 0
    for one, other in zip(
        folds(world(4), settings, NEVER), folds(world(4), settings, 1), strict=True
    ):
        assert not at_rest(one)
        woke += len(resting - at_rest(other))
        resting = at_rest(other)
        assert not resting & other.main.graph.landmarks.keys()
        a, b = marginals.landmark_map(one), marginals.landmark_map(other)
        assert a.ids.tolist() == b.ids.tolist()
        assert np.allclose(a.means, b.means, atol=1e-5)
        assert np.allclose(a.covariance, b.covariance, rtol=1e-5, atol=1e-8)
        assert degrees_of_freedom(one.main) == degrees_of_freedom(other.main)
        assert final_cost(other.main) == pytest.approx(final_cost(one.main), rel=1e-6)
        mine, theirs = marginals.joint_cost(one), marginals.joint_cost(other)
        assert theirs.dof == pytest.approx(mine.dof, rel=1e-6)
        assert marginals.confirmed(one, 2) == marginals.confirmed(other, 2)
    assert len(resting) > 10
    assert woke > 5


def test_a_landmark_that_another_island_has_does_not_rest_and_ties_it():
    found = world(4)
    late = [
        replace(each, robot="s0", end_ns=each.end_ns + 1)
        for each in found.submaps
        if each.robot == "r1"
    ]
    found.submaps = sorted(
        [each for each in found.submaps if each.robot == "r0"] + late, key=lambda each: each.key
    )
    starts = [each for each in found.starts if each.robot == "r0"]
    for one, other in zip(
        folds(found, JoinSettings(), NEVER, starts),
        folds(found, JoinSettings(), 1, starts),
        strict=True,
    ):
        apart = [each for key, each in other.islands.items() if key != other.main_key]
        for island in apart:
            assert not at_rest(other) & island.graph.landmarks.keys()
        assert one.home == other.home
        a, b = marginals.landmark_map(one), marginals.landmark_map(other)
        assert np.allclose(a.means, b.means, atol=1e-4)
    assert other.joined
    assert at_rest(other)
