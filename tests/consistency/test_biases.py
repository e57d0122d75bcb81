"""The NEES of a map and of the biases estimated with it.

The mutant has no states of the biases.
"""

from dataclasses import replace

import numpy as np

from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.joining import JoinSettings
from tests.estimation.hybrid_slam.test_sensitivity import (
    SIGMA,
    biased_team,
    fold_of,
)
from tests.estimation.submap_world import solved


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


SEEDS = range(200)


def test_map_and_biases_are_consistent_and_without_bias_states_they_are_not():
    of_map, of_biases = nees_of_map_and_biases(SEEDS)
    low, high = chi2_interval(10, 0.999, len(SEEDS))
    assert low < of_map < high
    low, high = chi2_interval(4, 0.999, len(SEEDS))
    assert low < of_biases < high
    mutant, _ = nees_of_map_and_biases(SEEDS[:15], blind=True)
    assert mutant > 2.0
