from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import Path
from teamslam.sim.studies.experiments.true_minimum import compare_minima
from teamslam.team.estimation.map_joining.gauss_newton import Island, JoinSettings
from teamslam.team.estimation.map_joining.minima import search_minima, solve_minimum
from tests.estimation.sighting_world import joined_with, mirrored
from tests.estimation.submap_world import Team, team

OPTIONS = JoinSettings(robust=False)


def world(
    seed: int, submaps: int = 8, **more: Any
) -> tuple[Team, Island, dict[int, np.ndarray], dict[str, Path]]:
    made = team(seed, submaps=submaps, **more)
    island = solve_minimum(joined_with(made.submaps, made.starts, (), OPTIONS, 1000).main).island
    stamps = 1000 * np.arange(1, submaps + 1)
    paths = {robot: Path(stamps, poses) for robot, poses in made.paths.items()}
    return made, island, dict(enumerate(made.landmarks)), paths


def test_a_map_of_sound_submaps_is_in_the_minimum_of_the_truth():
    rises = []
    for seed in range(8):
        _, island, landmarks, paths = world(seed)
        found = compare_minima(island, landmarks, paths)
        assert not found.wrong
        assert not found.excluded
        assert found.dof == 2 * len(island.graph.landmarks) + 6
        rises.append(found.rise / found.dof)
    assert 0.6 < np.mean(rises) < 1.5, "the likelihood ratio is χ² of what is held"


def test_a_map_that_is_folded_wrongly_is_another_minimum():
    wrong = 0
    sparse = {"size": 60.0, "reach": 15.0, "sigmas": (0.3, 0.15, 1.0)}
    for seed in range(8):
        _, solved, landmarks, paths = world(seed, submaps=20, robots=1, landmarks=3, **sparse)
        island = search_minima([solved]).best.island
        free = np.repeat(~island.graph.fixed, np.diff(island.graph.offset))
        anywhere = np.random.default_rng(seed).uniform(-30.0, 30.0, len(free))
        lost = solve_minimum(replace(island, state=np.where(free, anywhere, island.state)))
        found = compare_minima(lost.island, landmarks, paths)
        assert found.wrong == (lost.cost > solve_minimum(island).cost + 1.0)
        wrong += found.wrong
    assert wrong >= 2, "the state anywhere is often lost"


@pytest.mark.parametrize(("bearing_sigma", "lower"), [(30.0, False), (0.02, True)])
def test_the_other_one_of_two_places_is_wrong(bearing_sigma, lower):
    island, across = mirrored(bearing_sigma, OPTIONS)
    stamps = np.array([1000, 2000, 3000, 4000, 5000])
    poses = {
        robot: np.array([[x + k * np.cos(a), y + k * np.sin(a), a] for k in range(1, 6)])
        for robot, (x, y, a) in {"r0": (0.0, 0.0, 0.0), "r1": (0.0, 3.0, 0.2)}.items()
    }
    paths = {robot: Path(stamps, way) for robot, way in poses.items()}
    assert not compare_minima(solve_minimum(island).island, {}, paths).wrong
    found = compare_minima(solve_minimum(across).island, {}, paths)
    assert found.other_minimum
    assert (found.lower > 1.0) == lower


def test_a_map_that_is_not_at_rest_is_wrong():
    _, island, landmarks, paths = world(2)
    off = island.state.copy()
    at = island.graph.offset[next(iter(island.graph.landmarks.values()))]
    step = 1e-4
    while replace(island, state=off).cost < island.cost + 3.0:
        off[at] += step
    found = compare_minima(replace(island, state=off), landmarks, paths)
    assert found.wrong
    assert found.lower == pytest.approx(3.0, abs=0.1)
