"""NEES of maps with a common scale error of the ranges, and of the scale.

The mutants lack the bias state, or evaluate the scale at measured ranges.
"""

import numpy as np

from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from tests.consistency import RIGHT, judge
from tests.estimation.map_joining.test_range_scale import (
    COMMON,
    LANDMARKS,
    MARKER,
    OWN,
    SIGMA,
    carts,
    fold_of,
)

SEEDS = range(100)


def scale_errors(seeds, *, joined_ranges, way=0.01):
    found = []
    for seed in seeds:
        submaps, starts, errors = carts(seed, robots=1, submaps=20, way=way)
        options = JoinSettings(bias_sigma=SIGMA, joined_ranges=joined_ranges)
        estimates = marginals.bias_estimates(fold_of(submaps, starts, options))
        found += [(each.value - errors[each.stream[0]]) / each.sigma for each in estimates]
    return np.array(found)


def test_the_scale_of_ranges_is_unbiased_at_joined_ranges_and_at_the_measured_ones_it_is_not():
    unbiased = scale_errors(SEEDS, joined_ranges=True)
    assert judge(np.mean(unbiased**2), 1, len(unbiased)) == RIGHT
    assert abs(np.mean(unbiased)) < 3.3 / np.sqrt(len(unbiased))
    mutant = scale_errors(SEEDS[:50], joined_ranges=False)
    assert abs(np.mean(mutant)) > 3.3 / np.sqrt(len(mutant))


def test_a_scale_that_only_its_prior_determines_is_not_overconfident():
    """Without odometry the scale is undetermined: measured bearings must not determine it."""
    errors = scale_errors(range(300, 330), joined_ranges=True, way=1.0)
    assert abs(np.mean(errors)) < 3.3 / np.sqrt(len(errors))
    assert np.mean(errors**2) < chi2_interval(1, 0.999, len(errors))[1]


def nees_of_maps(seeds, common_bias_sigma):
    sigmas = {"bias_sigma": {"range_scale": 0.1 * OWN}, "common_bias_sigma": common_bias_sigma}
    options = JoinSettings(**sigmas, joined_ranges=True)
    errors = {"own": 0.1 * OWN, "common": COMMON, "way": 0.05, "marker": MARKER}
    total = 0.0
    for seed in seeds:
        submaps, starts, _ = carts(seed, submaps=3, **errors)
        found = marginals.landmark_map(fold_of(submaps, starts, options))
        total += nees((found.means - LANDMARKS).ravel(), found.covariance)
    return total / len(seeds)


def test_a_map_is_consistent_only_with_a_state_of_each_error_that_all_robots_share():
    states = {"range_scale": COMMON, "marker": MARKER}
    assert judge(nees_of_maps(SEEDS, states) / 10.0, 10, len(SEEDS)) == RIGHT
    for missing in states:
        less = {name: sigma for name, sigma in states.items() if name != missing}
        assert nees_of_maps(SEEDS[:25], less) / 10.0 > 1.25
