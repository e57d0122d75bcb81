"""A map is asked by its cost whether it lies in the truth's minimum."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import Path
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments.plain_cost import PlainCost
from teamslam.sim.studies.experiments.true_minimum import final_fold, judged, true_minimum
from teamslam.team.config import FrontEnd
from teamslam.team.estimation.map_joining.gauss_newton import Island, JoinSettings
from teamslam.team.estimation.map_joining.joining import solve_fold
from teamslam.team.estimation.map_joining.marginals import joint_cost
from teamslam.team.estimation.map_joining.minima import search_minima, solve_minimum
from tests.estimation.sighting_world import joined_with, meeting, mirrored
from tests.estimation.submap_world import Team, team
from tests.studies.test_experiment_runs import short

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
        found = judged(island, landmarks, paths)
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
        found = judged(lost.island, landmarks, paths)
        assert found.wrong == (lost.cost > solve_minimum(island).cost + 1.0)
        wrong += found.wrong
    assert wrong >= 2, "the state anywhere is often lost"


@pytest.mark.parametrize(("bearing_sigma", "lower"), [(30.0, False), (0.02, True)])
def test_the_other_one_of_two_places_is_wrong(bearing_sigma, lower):
    """Two places that are equally likely, and one that the measurements exclude."""
    island, across = mirrored(bearing_sigma, OPTIONS)
    stamps = np.array([1000, 2000, 3000, 4000, 5000])
    poses = {
        robot: np.array([[x + k * np.cos(a), y + k * np.sin(a), a] for k in range(1, 6)])
        for robot, (x, y, a) in {"r0": (0.0, 0.0, 0.0), "r1": (0.0, 3.0, 0.2)}.items()
    }
    paths = {robot: Path(stamps, way) for robot, way in poses.items()}
    assert not judged(solve_minimum(island).island, {}, paths).wrong
    found = judged(solve_minimum(across).island, {}, paths)
    assert found.other_minimum
    assert (found.lower > 1.0) == lower


def test_submaps_that_deny_the_truth_are_found():
    _, island, landmarks, paths = world(3)
    moved = {id_: place + np.array([2.0, 0.0]) * (id_ == 1) for id_, place in landmarks.items()}
    found = judged(island, moved, paths)
    assert found.excluded
    assert not found.wrong


@pytest.mark.parametrize("biases", [(), FrontEnd().biases], ids=["without biases", "default"])
def test_a_run_is_asked_for_its_own_final_map(biases):
    scenario = short(80)
    robots = tuple(
        msgspec.structs.replace(
            each, front_end=msgspec.structs.replace(each.front_end, biases=biases)
        )
        for each in scenario.robots
    )
    scenario = msgspec.structs.replace(scenario, robots=robots)
    samples = list(run_team(scenario, streams_of(scenario)))
    fold, published = final_fold(samples), final_map(samples).chi2
    robust = solve_fold(fold, replace(fold.main.settings, robust=True))
    rel = 0.05 if biases else 1e-6
    assert joint_cost(robust).chi2 == pytest.approx(published, rel=rel)
    assert fold.main.cost > (1.0 - 1e-6) * published, "plain squares bound the robust loss"
    found = true_minimum(samples, evaluate(samples))
    assert not found.wrong
    assert not found.excluded


def test_a_map_that_is_not_at_rest_is_wrong():
    """The map is judged as published, without a further solution by the team's solver."""
    _, island, landmarks, paths = world(2)
    off = island.state.copy()
    at = island.graph.offset[next(iter(island.graph.landmarks.values()))]
    step = 1e-4
    while replace(island, state=off).cost < island.cost + 3.0:
        off[at] += step
    found = judged(replace(island, state=off), landmarks, paths)
    assert found.wrong
    assert found.lower == pytest.approx(3.0, abs=0.1)


def test_the_judge_s_cost_is_the_map_joining_s():
    """Two programs, one cost: with inter-robot measurements, pose nodes, an uncertain start."""
    met = meeting(3)
    starts = [replace(each, covariance=np.diag([0.04, 0.04, 0.01])) for each in met.starts]
    island = joined_with(met.submaps, starts, met.sightings, OPTIONS).main
    rng = np.random.default_rng(0)
    fixed = np.zeros(len(island.state), dtype=np.bool_)
    cost = PlainCost(island.graph, 1.0, fixed)
    assert len(island.graph.sightings) > 4
    for _ in range(3):
        state = island.state + 0.3 * rng.normal(size=len(island.state))
        assert cost.of(state) == pytest.approx(replace(island, state=state).cost, rel=1e-9)
        J, h = cost.jacobian(state), 1e-6
        gradient = 2.0 * J.T @ cost.residuals(state)
        for k in rng.choice(len(state), 5, replace=False):
            moved = h * np.eye(len(state))[k]
            slope = (cost.of(state + moved) - cost.of(state - moved)) / (2.0 * h)
            assert gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-3)
