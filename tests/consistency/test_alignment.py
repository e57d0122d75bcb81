"""The NEES and the cost of the alignment of two frames."""

import numpy as np

from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.map_joining.alignment import aligned
from tests.estimation.map_joining.test_alignment import (
    pairs,
)
from tests.estimation.submap_world import correlated, seen_from, wrap


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
        found = aligned(noisy_a.reshape(-1, 2), P, noisy_b.reshape(-1, 2), Q)
        error = found.a_from_b - truth
        error[2] = wrap(error[2])
        errors += nees(error, found.covariance)
        cost += found.chi2
        assert found.dof == 5
    low, high = chi2_interval(3, 0.999, runs)
    assert low < errors / (3 * runs) < high
    low, high = chi2_interval(5, 0.999, runs)
    assert low < cost / (5 * runs) < high
