from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.map_joining import gauss_newton
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, is_suspicious
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    add_start,
    fold_submaps,
    solve_fold,
)
from teamslam.team.estimation.map_joining.minima import (
    Search,
    search_minima,
    solve_minimum,
    warnings,
    widen_search,
)
from teamslam.team.estimation.map_joining.relaxation import relax_headings
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.sighting_world import joined_with, meeting, mirrored
from tests.estimation.submap_world import team, wrap

OPTIONS = JoinSettings(robust=False)


def island_of(world, sightings=()):
    return joined_with(world.submaps, world.starts, sightings, OPTIONS, 1000).main


def thrown(island, seed):
    rng = np.random.default_rng(seed)
    free = np.repeat(~island.graph.fixed, np.diff(island.graph.offset))
    state = np.where(free, rng.uniform(-30.0, 30.0, len(free)), island.state)
    state[island.graph.headings] = wrap(state[island.graph.headings])
    return replace(island, state=state)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 2**32))
def test_the_relaxation_of_exact_submaps_is_the_truth_whatever_the_guess(seed):
    world = team(seed % 50, robots=2, submaps=5, sigmas=(1e-7, 1e-7, 1e-7))
    island = island_of(world)
    found = relax_headings(island.graph, thrown(island, seed).state)
    for robot, path in world.paths.items():
        for node, pose in zip(island.graph.streams[robot, 0][1:], path, strict=True):
            begin = island.graph.offset[node]
            error = found[begin : begin + 3] - pose
            np.testing.assert_allclose([*error[:2], wrap(error[2])], 0.0, atol=1e-3)


def test_the_relaxation_takes_sightings_and_priors():
    world = meeting(2, robots=2, submaps=3, sigmas=(1e-4, 1e-4))
    exact = [replace(s, covariance=1e-8 * np.eye(3)) for s in world.starts]
    island = joined_with(world.submaps, exact, world.sightings, OPTIONS, 1000).main
    solved = solve_minimum(island).island.state
    found = relax_headings(island.graph, thrown(island, 3).state)
    points = island.graph.offset[:-1]
    away = np.hypot(*(found - solved)[np.array([points, points + 1])])
    assert away.max() < 1.0


def test_a_search_leaves_the_wrong_minimum_that_gauss_newton_stays_in():
    wrong = 0
    for seed in range(8):
        sparse = {"size": 60.0, "reach": 15.0, "sigmas": (0.3, 0.15, 1.0)}
        island = island_of(team(seed, robots=1, submaps=20, landmarks=3, **sparse))
        right = search_minima([island]).best.cost
        lost = thrown(island, seed)
        alone = solve_minimum(lost).cost
        wrong += alone > right + 1.0
        search = search_minima([lost])
        assert search.best.cost < right + 0.1
        assert search.gained == pytest.approx(alone - search.best.cost)
        assert warnings(search) == []
    assert wrong >= 2, "the mutant without a search is often lost"


def test_a_cost_that_the_degrees_of_freedom_do_not_allow_is_said():
    world = team(3, robots=2, submaps=8)
    bad = world.submaps[9]
    mean = bad.local.mean.copy()
    mean[3:] *= 3.0
    spoilt = [
        replace(each, local=replace(each.local, mean=mean)) if each is bad else each
        for each in world.submaps
    ]
    clean, told = (
        solve_fold(joined_with(submaps, world.starts, (), OPTIONS, len(submaps)), OPTIONS)
        for submaps in (world.submaps, spoilt)
    )
    assert clean.warnings == ()
    (text,) = told.warnings
    assert "the map does not fit its submaps: chi²" in text
    assert is_suspicious(told.main, told.main.cost)


@pytest.mark.parametrize("seed", [1, 12])
def test_a_long_curved_valley_is_gone_along_to_its_end(seed, monkeypatch):
    far = {"size": 100.0, "reach": 20.0, "sigmas": (0.02, 0.3, 3.0)}
    island = island_of(team(seed, robots=1, submaps=30, landmarks=3, **far))
    island = replace(island, state=relax_headings(island.graph, island.state))
    found = solve_minimum(island)
    assert found.iterations < 25
    assert found.change < OPTIONS.step_tolerance
    monkeypatch.setattr(gauss_newton, "HALVINGS", 0)
    creeping = solve_minimum(island)
    assert creeping.iterations == OPTIONS.max_iterations, "the mutant damps at once"
    assert creeping.cost > found.cost + 10.0


@pytest.mark.parametrize(("landmark_sigma", "said"), [(6.0, True), (0.2, False)])
def test_a_robot_whose_heading_no_landmark_gives_is_said(landmark_sigma, said):
    world = team(4, robots=2, submaps=3, landmarks=4, sigmas=(0.1, 0.02, landmark_sigma))
    wide = np.diag([100.0, 100.0, 9.0])
    starts = [world.starts[0], replace(world.starts[1], covariance=wide)]
    island = joined_with(world.submaps, starts, (), OPTIONS).main
    found = [text for text in warnings(search_minima([island])) if "is placed weakly" in text]
    assert [text.split(" is ")[0] for text in found] == ["r1 (incarnation 0)"] * said


def test_a_second_place_that_fits_as_well_is_found_and_said():
    search = search_minima(mirrored(30.0, OPTIONS))
    assert search.second is not None
    assert search.ambiguous
    (text,) = warnings(search)
    assert "another map fits about as well" in text


def test_a_place_that_the_measurements_exclude_is_no_second_place():
    search = search_minima(mirrored(0.02, OPTIONS))
    assert not search.ambiguous
    assert warnings(search) == []


def hinged(apart, turn=0.1, sigma=0.8):
    """r1 passes one landmark, turns by `turn` ± `sigma` [rad], and passes the other one 10 m on.

    r0 knows their distance `apart` [m]: r1 has turned left or right.
    """
    near, point = [0.05, 0.05, 0.02], [0.05, 0.05]
    said = [
        ("r0", 0, [1.0, 0.0, 0.0, 0.0, 0.0, apart, 0.0], [*near, *point, *point], [0, 1]),
        ("r1", 0, [5.0, 0.0, 0.0, 0.0, 0.0], [*near, *point], [0]),
        ("r1", 1, [0.1, 0.0, turn], [0.05, 0.05, sigma], []),
        ("r1", 2, [9.0, 0.0, 0.0, 10.0, 0.0], [*near, *point], [1]),
    ]
    submaps = [
        Contribution(robot, 0, k, 1000 * (k + 1), LocalMap(np.array(ids, np.uint32), mean, P))
        for robot, k, mean, P, ids in (
            (robot, k, np.array(mean), np.diag(sigmas) ** 2, ids)
            for robot, k, mean, sigmas, ids in said
        )
    ]
    fold = add_start(EMPTY_FOLD, InitialPoseFactor("r0", 0, np.zeros(3)))
    return fold_submaps(fold, sorted(submaps, key=lambda each: each.key), OPTIONS)


@pytest.mark.parametrize("apart", [9.0, 13.0])
def test_a_chain_that_may_be_folded_to_the_other_side_is_said(apart):
    fold = hinged(apart)
    assert not search_minima([fold.main]).ambiguous, "the mutant that does not mirror sees one map"
    wider = widen_search(search_minima([fold.main]))
    assert wider.ambiguous
    turns = [
        each.state[each.graph.offset[each.graph.streams["r1", 0][2]] + 2]
        - each.state[each.graph.offset[each.graph.streams["r1", 0][1]] + 2]
        for each in (wider.best.island, wider.second.island)
    ]
    cosine = (apart**2 - 5.0**2 - 10.0**2) / (2.0 * 5.0 * 10.0)
    np.testing.assert_allclose(np.cos(turns), cosine, atol=0.1)
    assert turns[0] * turns[1] < 0.0
    (text,) = solve_fold(fold, OPTIONS).warnings
    assert "another map fits about as well" in text


def test_a_chain_that_is_known_to_turn_left_is_not_said():
    assert solve_fold(hinged(13.0, turn=1.1, sigma=0.2), OPTIONS).warnings == ()


def test_the_lower_one_of_two_sides_is_the_map():
    fold = hinged(13.0, turn=0.8, sigma=0.8)
    lower = widen_search(search_minima([fold.main]))
    other = Search(lower.second, 0.0, None)
    found = widen_search(other)
    assert found.best.cost == pytest.approx(lower.best.cost)
    assert found.gained == pytest.approx(lower.second.cost - lower.best.cost)
