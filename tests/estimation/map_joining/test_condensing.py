from dataclasses import replace

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.condensed import (
    HISTORY,
    SubmapCosts,
    select_newest,
)
from teamslam.team.estimation.map_joining.condensing import Limits, condense_submaps
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    JoinSettings,
    add_start,
    fold_submaps,
)
from teamslam.team.estimation.map_joining.relinearising import restore_submaps
from tests.estimation.sighting_world import joined_with, meeting
from tests.estimation.submap_world import team

LAG = 3
ROBUST = JoinSettings()


def ticks_of(world):
    ends = sorted({each.end_ns for each in world.submaps})
    return [[each for each in world.submaps if each.end_ns == end] for end in ends]


def empty_fold(world):
    fold = EMPTY_FOLD
    for start in world.starts:
        fold = add_start(fold, start)
    return fold


def both(world, settings):
    full = bounded = empty_fold(world)
    for tick in ticks_of(world):
        full = fold_submaps(full, tick, settings)
        bounded = fold_submaps(condense_submaps(bounded, Limits(0, LAG)), tick, settings)
    return full, bounded


def apart(one, other):
    """Distance of two maps in σ² of the first, per degree of freedom."""
    a, b = marginals.landmark_map(one), marginals.landmark_map(other)
    assert a.ids.tolist() == b.ids.tolist()
    difference = (a.means - b.means).ravel()
    return difference @ np.linalg.solve(a.covariance, difference) / len(difference)


@pytest.mark.parametrize(
    "settings", [JoinSettings(robust=False), ROBUST], ids=["squares", "robust"]
)
@pytest.mark.parametrize("seed", range(2))
def test_the_bounded_fold_is_close_to_the_full_one(seed, settings):
    full, bounded = both(team(seed, submaps=20), settings)
    island = bounded.main
    assert bounded.size == full.size == 40
    assert len(island.graph.submaps) <= 2 * (LAG + 6)
    assert bounded.condensed_count + len(bounded.contributions) == 40
    assert bounded.next_sequence(("r0", 0)) == 20
    assert apart(full, bounded) < 1e-3
    variances = [np.diag(marginals.landmark_map(each).covariance) for each in (full, bounded)]
    assert np.allclose(*variances, rtol=0.05)
    mine, theirs = marginals.joint_cost(full), marginals.joint_cost(bounded)
    assert theirs.dof == pytest.approx(mine.dof, rel=0.08)
    assert theirs.chi2 / theirs.dof == pytest.approx(mine.chi2 / mine.dof, rel=0.05)
    assert {*theirs.submaps.streams} == {("r0", 0), ("r1", 0)}
    assert marginals.confirmed(bounded, 3) == marginals.confirmed(full, 3)


def test_a_submap_that_is_condensed_twice_is_not_consistent():
    world = team(1, submaps=20)
    full, bounded = both(world, JoinSettings())
    island = bounded.main
    old = island.graph.condensed
    one = old.factor
    twice = core.Quadratic(
        one.nodes, one.at, one.headings, 2.0 * one.information, 2.0 * one.slope, one.cost
    )
    wrong = replace(island, graph=replace(island.graph, condensed=replace(old, factor=twice)))
    claimed = replace(bounded, islands={bounded.main_key: wrong})
    variances = [np.diag(marginals.landmark_map(each).covariance) for each in (full, claimed)]
    assert not np.allclose(*variances, rtol=0.05)


def test_what_is_linearised_again_is_the_full_solution():
    world = team(2, submaps=20)
    full, bounded = both(world, JoinSettings())
    again = restore_submaps(bounded, world.submaps, [])
    assert again.condensed_count == 0
    assert len(again.contributions) == again.size == full.size
    assert apart(full, again) < 1e-6 <= apart(full, bounded) * 1e3
    smaller = condense_submaps(again, Limits(0, LAG))
    assert smaller.condensed_count == 2 * (20 - LAG)
    assert apart(full, smaller) < 1e-6


def test_an_inter_robot_measurement_that_was_left_out_is_not_restored():
    world = meeting(3, robots=3, submaps=9)
    bad, *others = world.sightings
    fold = joined_with(world.submaps, world.starts, others, JoinSettings(robust=False))
    fold = condense_submaps(replace(fold, left_out=frozenset({bad.key})), Limits(0, lag=2))
    assert fold.condensed_count == 21
    raw = restore_submaps(fold, world.submaps, world.sightings)
    assert raw.condensed_count == 0
    assert len(raw.main.graph.sightings) == len(others)


def test_the_costs_of_the_newest_submaps_of_each_stream_are_stored():
    streams = [(f"r{k % 3}", 0) for k in range(3 * HISTORY)] + [("r1", 0)] * 4
    costs = SubmapCosts(tuple(streams), np.arange(4.0 * len(streams)).reshape(4, -1))
    expected = [k for k in range(len(streams)) if k not in (1, 4, 7, 10)]
    found = select_newest(costs)
    assert found.streams == tuple(streams[k] for k in expected)
    np.testing.assert_array_equal(found.table, costs.table[:, expected])
    assert select_newest(found).streams == found.streams
