from dataclasses import replace

import numpy as np

from teamslam.team.estimation.consistency import nees
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.alignment import Maps, align
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.marginals import joint_cost, landmark_map
from tests.consistency import RIGHT, TOO_SMALL, judge
from tests.estimation.hybrid_slam.test_sensitivity import SIGMA, biased_team, fold_of
from tests.estimation.map_joining.test_alignment import pairs
from tests.estimation.map_joining.test_joining import joined
from tests.estimation.sighting_world import joined_with, meeting
from tests.estimation.submap_world import correlated, seen_from, solved, team, wrap

RUNS = 100


def consistency(runs):
    """Judge NEES and joint cost of pairs of a fold and the true landmarks."""
    errors = cost = dof = joint = 0.0
    for fold, landmarks in runs:
        found = landmark_map(fold)
        if len(found.ids):
            errors += nees((found.means - landmarks[found.ids]).ravel(), found.covariance)
            dof += found.means.size
        agreement = joint_cost(fold)
        cost += agreement.chi2
        joint += agreement.dof
    return judge(errors / dof, round(dof)), judge(cost / joint, round(joint))


def teams(options):
    for seed in range(RUNS):
        world = team(seed, robots=2, submaps=5, landmarks=4)
        fold = joined(world.submaps, world.starts, options, tick=10)
        yield solved(fold, options), world.landmarks


def test_map_and_joint_cost_are_consistent_and_a_submap_counted_twice_is_not():
    assert consistency(teams(JoinSettings())) == (RIGHT, RIGHT)
    twice, _ = consistency(teams(JoinSettings(covariance_factor=0.5)))
    assert twice == TOO_SMALL


def meetings(change):
    for seed in range(RUNS):
        world = meeting(seed, robots=2, submaps=3, landmarks=2, reach=7.0)
        sightings = [replace(each, covariance=change * each.covariance) for each in world.sightings]
        fold = joined_with(world.submaps, world.starts, sightings, JoinSettings(), 100)
        yield solved(fold, JoinSettings()), world.landmarks


def test_a_map_with_sightings_is_consistent_and_one_that_counts_each_fourfold_is_not():
    assert consistency(meetings(1.0)) == (RIGHT, RIGHT)
    _, cost_of_mutant = consistency(meetings(0.25))
    assert cost_of_mutant == TOO_SMALL


def test_the_alignment_and_its_chi_square_are_consistent():
    runs, errors, cost = 300, 0.0, 0.0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        truth = np.array([20.0, -5.0, 2.0])
        points = rng.uniform(-20.0, 20.0, (4, 2))
        there = pairs(seen_from(truth, points[:, 0] + 1j * points[:, 1]))
        P, Q = correlated(np.full(8, 0.3), rng), correlated(np.full(8, 0.2), rng)
        noisy_a = points.ravel() + np.linalg.cholesky(P) @ rng.normal(size=8)
        noisy_b = there.ravel() + np.linalg.cholesky(Q) @ rng.normal(size=8)
        found = align(Maps(noisy_a.reshape(-1, 2), P, noisy_b.reshape(-1, 2), Q))
        error = found.a_from_b - truth
        error[2] = wrap(error[2])
        errors += nees(error, found.covariance)
        cost += found.chi2
        assert found.dof == 5
    assert judge(errors / (3 * runs), 3, runs) == RIGHT
    assert judge(cost / (5 * runs), 5, runs) == RIGHT


def without_columns(submaps):
    return [
        replace(each, local=replace(each.local, biases=(), sensitivity=np.empty((0, 0))))
        for each in submaps
    ]


def nees_of_map_and_biases(seeds, *, blind=False):
    of_map = of_biases = dof = 0.0
    for seed in seeds:
        world, submaps, errors = biased_team(seed)
        options = JoinSettings(bias_sigma=SIGMA)
        taken = without_columns(submaps) if blind else submaps
        fold = fold_of(world, taken, options, tick=12, full=solved)
        found = marginals.landmark_map(fold)
        of_map += nees((found.means - world.landmarks[found.ids]).ravel(), found.covariance)
        dof += found.means.size
        for (robot, _), bias, value, sigma in marginals.bias_estimates(fold):
            truth = errors[robot][0 if bias == "bearing" else 1]
            of_biases += ((value - truth) / sigma) ** 2 / (4 * len(seeds))
    return of_map / dof, of_biases


SEEDS = range(100)


def test_map_and_biases_are_consistent_and_without_bias_states_they_are_not():
    of_map, of_biases = nees_of_map_and_biases(SEEDS)
    assert judge(of_map, 10, len(SEEDS)) == RIGHT
    assert judge(of_biases, 4, len(SEEDS)) == RIGHT
    mutant, _ = nees_of_map_and_biases(SEEDS[:15], blind=True)
    assert mutant > 2.0
