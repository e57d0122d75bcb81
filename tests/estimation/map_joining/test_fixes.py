"""Fixes place an island by a bounded number of them, and all of them are factors from then on."""

import numpy as np
import pytest

from teamslam.team.config import GNSS
from teamslam.team.estimation.contribution import STATION, Contribution, InitialPoseFactor
from teamslam.team.estimation.inter_robot import STATION_POSE, InterRobotFactor, from_station
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    add_start,
    fold_submaps,
    solve_fold,
)
from teamslam.team.estimation.map_joining.merging import MOST_FIXES, sound_ties, ties
from teamslam.team.estimation.map_joining.submap_graph import observer_of
from teamslam.team.estimation.se2 import transformed
from teamslam.team.estimation.submap import LocalMap

PLACE = np.array([40.0, -7.0, 2.0])
NO_IDS = np.empty(0, np.uint32)


def placed_by_fixes(count, jumping=()):
    """The station, a robot's submap with `count` pose nodes along an arc, and a fix at each."""
    rng = np.random.default_rng(count)
    turn = np.linspace(0.0, 2.0, count + 1)[1:]
    nodes = np.column_stack([30.0 * np.sin(turn), 30.0 * (1.0 - np.cos(turn)), turn])
    mean = np.concatenate([nodes[-1:], nodes]).ravel()
    local = LocalMap(NO_IDS, mean, 1e-4 * np.eye(len(mean)), np.arange(1, count + 1))
    station = LocalMap(NO_IDS, np.zeros(3), 1e-6 * np.eye(3))
    fixes = []
    for k, node in enumerate(nodes):
        at = (
            transformed(PLACE, node[:2]) + rng.normal(0.0, 0.3, 2) + (20.0 if k in jumping else 0.0)
        )
        measured = from_station(at, 0.09 * np.eye(2))
        fixes.append(InterRobotFactor("r1", 0, 0, k + 1, GNSS, *measured, np.zeros(2)))
    fold = add_start(EMPTY_FOLD, InitialPoseFactor(*STATION, STATION_POSE))
    fold = fold_submaps(fold, [Contribution(*STATION, 0, 0, station)], JoinSettings())
    return fold_submaps(fold, [Contribution("r1", 0, 0, 1000, local)], JoinSettings(), fixes), fixes


@pytest.mark.parametrize("count", [10, 3 * MOST_FIXES + 7])
def test_an_island_is_placed_by_few_fixes_and_has_all_of_them_at_once(count):
    jumping = range(3, count, 9)
    fold, fixes = placed_by_fixes(count, jumping)
    assert list(fold.islands) == [fold.main_key]
    assert fold.waiting == ()
    assert len(fold.main.graph.sightings) == len(fixes)
    solved = solve_fold(fold, JoinSettings()).main
    node = solved.graph.streams["r1", 0][0]
    at = solved.state[solved.graph.offset[node] :][:3]
    np.testing.assert_allclose(at, PLACE, atol=0.3)
    weights = solved.estimate.sighting_weights
    stamps = [each.sighting.stamp_ns - 1 for each in solved.graph.sightings]
    assert {k for k, w in zip(stamps, weights.tolist(), strict=True) if w < 0.1} == {*jumping}


def test_the_number_of_fixes_that_align_is_bounded_and_they_span_the_path():
    fold, fixes = placed_by_fixes(4 * MOST_FIXES)
    station = fold_submaps(
        add_start(EMPTY_FOLD, InitialPoseFactor(*STATION, STATION_POSE)),
        [fold.contributions[0]],
        JoinSettings(),
    ).main
    robot = fold_submaps(EMPTY_FOLD, [fold.contributions[1]], JoinSettings()).main
    assert observer_of(station.graph, fixes[0]) is not None
    used, aside = sound_ties(station, robot, ties(station.graph, robot.graph, fixes))
    assert 0.9 * MOST_FIXES < len(used) <= MOST_FIXES
    assert len(used) + len(aside) == len(fixes)
    stamps = [each.seen.stamp_ns for each in used if each.seen is not None]
    assert max(stamps) - min(stamps) > 0.95 * len(fixes)
