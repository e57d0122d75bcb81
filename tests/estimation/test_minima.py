"""Wrong minima are found out: by a start that needs no guess, by the cost, by a second place."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from team.estimation import gauss_newton
from team.estimation.contribution import Contribution, Start
from team.estimation.gauss_newton import JoinSettings
from team.estimation.joining import EMPTY_FOLD, converged, folded, started
from team.estimation.minima import doubts, minimum, searched, suspicious
from team.estimation.relaxation import relaxed
from team.estimation.sighting import Sighting
from team.estimation.submap import LocalMap
from tests.estimation.sighting_world import joined_with, meeting
from tests.estimation.submap_world import local_truth, seen_from, team, wrap

OPTIONS = JoinSettings()


def island_of(world, sightings=()):
    return joined_with(world.submaps, world.starts, sightings, OPTIONS, 1000).main


def thrown(island, seed):
    """The same island with every unknown anywhere."""
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
    found = relaxed(island.graph, thrown(island, seed).state)
    for robot, path in world.paths.items():
        for node, pose in zip(island.graph.streams[robot, 0][1:], path, strict=True):
            begin = island.graph.offset[node]
            error = found[begin : begin + 3] - pose
            np.testing.assert_allclose([*error[:2], wrap(error[2])], 0.0, atol=1e-3)


def test_the_relaxation_takes_sightings_and_priors():
    world = meeting(2, robots=2, submaps=3, sigmas=(1e-4, 1e-4))
    exact = [replace(s, covariance=1e-8 * np.eye(3)) for s in world.starts]
    island = joined_with(world.submaps, exact, world.sightings, OPTIONS, 1000).main
    solved = minimum(island).island.state
    found = relaxed(island.graph, thrown(island, 3).state)
    points = island.graph.offset[:-1]
    away = np.hypot(*(found - solved)[np.array([points, points + 1])])
    assert away.max() < 1.0


def test_a_search_leaves_the_wrong_minimum_that_gauss_newton_stays_in():
    wrong = 0
    for seed in range(8):
        sparse = {"size": 60.0, "reach": 15.0, "sigmas": (0.3, 0.15, 1.0)}
        island = island_of(team(seed, robots=1, submaps=20, landmarks=3, **sparse))
        right = searched([island]).best.cost
        lost = thrown(island, seed)
        alone = minimum(lost).cost
        wrong += alone > right + 1.0
        search = searched([lost])
        assert search.best.cost < right + 0.1
        assert search.gained == pytest.approx(alone - search.best.cost)
        assert doubts(search) == []
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
    fold = EMPTY_FOLD
    for start in world.starts:
        fold = started(fold, start)
    clean, told = (
        converged(folded(fold, submaps, OPTIONS), OPTIONS) for submaps in (world.submaps, spoilt)
    )
    assert clean.doubts == ()
    (text,) = told.doubts
    assert "the map does not fit its submaps: chi²" in text
    assert suspicious(told.main, told.main.cost)


@pytest.mark.parametrize("seed", [1, 12])
def test_a_long_curved_valley_is_gone_along_to_its_end(seed, monkeypatch):
    far = {"size": 100.0, "reach": 20.0, "sigmas": (0.02, 0.3, 3.0)}
    island = island_of(team(seed, robots=1, submaps=30, landmarks=3, **far))
    island = replace(island, state=relaxed(island.graph, island.state))
    found = minimum(island)
    assert found.iterations < 25
    assert found.change < OPTIONS.step_tolerance
    monkeypatch.setattr(gauss_newton, "SHARES", (1.0,))
    creeping = minimum(island)
    assert creeping.iterations == OPTIONS.max_iterations, "the mutant damps at once"
    assert creeping.cost > found.cost + 10.0


def test_a_map_that_is_not_settled_is_said():
    island = thrown(island_of(team(1, robots=1, submaps=20, landmarks=3)), 1)
    hasty = replace(island, settings=replace(OPTIONS, max_iterations=1))
    assert any("is not settled: after 1 iterations" in text for text in doubts(searched([hasty])))


@pytest.mark.parametrize(("landmark_sigma", "said"), [(6.0, True), (0.2, False)])
def test_a_robot_whose_heading_no_landmark_gives_is_said(landmark_sigma, said):
    world = team(4, robots=2, submaps=3, landmarks=4, sigmas=(0.1, 0.02, landmark_sigma))
    wide = np.diag([100.0, 100.0, 9.0])
    starts = [world.starts[0], replace(world.starts[1], covariance=wide)]
    island = joined_with(world.submaps, starts, (), OPTIONS).main
    found = [text for text in doubts(searched([island])) if "is placed weakly" in text]
    assert [text.split(" is ")[0] for text in found] == ["r1 (epoch 0)"] * said


# --- two places for one robot ---


def mirrored(bearing_sigma):
    """r1 drives straight beside r0, who sees how far it is but hardly where: left or right."""
    ranges_seen = []
    stamps = np.arange(1, 5) * 1000
    submaps = []
    paths = {"r0": np.zeros(3), "r1": np.array([0.0, 3.0, 0.2])}
    nodes = {}
    for robot, start in paths.items():
        c, s = np.cos(start[2]), np.sin(start[2])
        along = [np.array([start[0] + k * c, start[1] + k * s, start[2]]) for k in range(1, 6)]
        nodes[robot] = along[:4]
        mean = np.concatenate(
            [local_truth(start, pose, np.zeros((0, 2))) for pose in (along[4], *along[:4])]
        )
        local = LocalMap(np.zeros(0, np.uint32), mean, 1e-4 * np.eye(len(mean)), stamps)
        submaps.append(Contribution(robot, 0, 0, 5000, local))
    for stamp, observer, seen in zip(stamps.tolist(), nodes["r0"], nodes["r1"], strict=True):
        to = seen_from(observer, seen[0] + 1j * seen[1])
        bearing = np.angle(to) if bearing_sigma < 1.0 else 0.0
        reading = np.array([abs(to), bearing])
        covariance = np.diag([0.01, bearing_sigma]) ** 2
        ranges_seen.append(Sighting("r0", 0, 0, stamp, "r1", reading, covariance))
    starts = [Start("r0", 0, np.zeros(3)), Start("r1", 0, paths["r1"], np.diag([100.0, 100, 9]))]
    island = joined_with(submaps, starts, ranges_seen, OPTIONS).main
    across = island.state.copy()
    for node in (*island.graph.streams["r1", 0], *island.graph.poses.values()):
        across[island.graph.offset[node] + 1] *= -1.0
        across[island.graph.offset[node] + 2] *= -1.0
    return [island, replace(island, state=across)]


def test_a_second_place_that_fits_as_well_is_found_and_said():
    search = searched(mirrored(bearing_sigma=30.0))
    assert search.second is not None
    assert search.ambiguous
    (text,) = doubts(search)
    assert "another map fits about as well" in text


def test_a_place_that_the_readings_exclude_is_no_second_place():
    search = searched(mirrored(bearing_sigma=0.02))
    assert not search.ambiguous
    assert doubts(search) == []
