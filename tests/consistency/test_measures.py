import numpy as np
import pytest
from scipy.special import chdtri, gammaincinv

from teamslam.team.core import chi2_quantiles
from teamslam.team.estimation.consistency import (
    chi2_interval,
    chi2_limit,
    chi2_quantile,
    covariance_scale,
    coverage,
    nees,
)
from teamslam.team.estimation.gaussian import NotACovarianceError
from teamslam.team.estimation.map_joining.conditioning import GATE
from teamslam.team.estimation.map_joining.nonlinearity import UNLIKELY
from tests.support import state_error

L = np.array([[0.5, 0.0, 0.0], [0.3, 0.2, 0.0], [-0.1, 0.4, 0.1]])


def values(runs, scale=1.0):
    errors = np.random.default_rng(1).standard_normal((runs, 3)) @ L.T
    return np.array([nees(error, scale * L @ L.T) for error in errors])


def test_nees_is_the_squared_length_of_the_whitened_error():
    error = np.array([0.2, -0.1, 0.3])
    assert nees(error, L @ L.T) == pytest.approx(error @ np.linalg.solve(L @ L.T, error))


def test_errors_of_the_given_covariance_are_inside_the_interval_and_others_outside_on_both_sides():
    low, high = chi2_interval(3, 0.999, 400)
    assert low < values(400).mean() / 3 < high
    assert values(400, scale=0.75).mean() / 3 > high
    assert values(400, scale=1.3).mean() / 3 < low


def test_the_interval_holds_its_share_of_means():
    low, high = chi2_interval(3, 0.9, 10)
    means = values(20000).reshape(-1, 10).mean(axis=1) / 3
    assert abs(np.mean((means > low) & (means < high)) - 0.9) < 0.02
    assert abs(np.mean(means <= low) - 0.05) < 0.015


def test_more_runs_make_the_interval_narrower_about_one():
    widths = [np.ptp(chi2_interval(5, 0.95, runs)) for runs in (1, 10, 100, 1000)]
    assert widths == sorted(widths, reverse=True)
    assert chi2_interval(36, 0.95, 50) == pytest.approx((0.936, 1.066), abs=1e-3)


def test_coverage_counts_the_runs_inside_the_ellipsoid_whatever_their_dimension():
    rng = np.random.default_rng(2)
    dof = rng.integers(3, 20, 5000)
    squares = rng.chisquare(dof)
    assert abs(coverage(squares, dof.astype(float), 0.95) - 0.95) < 0.01
    assert coverage(2.0 * squares, dof.astype(float), 0.95) < 0.75


def test_the_error_of_a_heading_is_the_short_way_round():
    estimate, truth = np.array([1.0, 2.0, 3.1, 7.0]), np.array([0.0, 0.0, -3.1, 5.0])
    error = state_error(estimate, truth)
    np.testing.assert_allclose(error, [1.0, 2.0, 6.2 - 2.0 * np.pi, 2.0])
    np.testing.assert_array_equal(estimate, [1.0, 2.0, 3.1, 7.0])


def test_a_matrix_that_is_no_covariance_is_rejected():
    with pytest.raises(NotACovarianceError, match="an estimation error"):
        nees(np.ones(2), np.diag([1.0, -1.0]))


def test_quantiles_that_are_written_as_numbers_are_those_of_the_library():
    assert chi2_limit(1, 1e-3) == UNLIKELY
    assert chi2_quantile(0.9999, 2) == GATE


def test_limits_of_few_degrees_of_freedom_are_the_librarys_to_twelve_digits():
    for tail in (1e-2, 1e-3, 1e-6):
        for dof in (*range(1, 40), 99, 100, 599, 600):
            assert chi2_limit(dof, tail) == float(f"{chdtri(dof, tail):.12g}")


def test_limits_and_quantiles_of_any_degrees_of_freedom_are_the_librarys():
    dof = np.concatenate([np.linspace(1.0, 60.0, 119), np.geomspace(1.0, 30_000.0, 40)])
    for below in (1e-3, 0.025, 0.5, 0.975, 0.999, 1.0 - 1e-7):
        found = chi2_quantiles(below, 1.0 - below, dof)
        np.testing.assert_allclose(found, 2.0 * gammaincinv(0.5 * dof, below), rtol=1e-13)
        assert chi2_quantile(below, 7.5) == pytest.approx(2.0 * gammaincinv(3.75, below), rel=1e-11)
    for many in (601, 2_500, 40_000):
        assert chi2_limit(many, 1e-5) == pytest.approx(chdtri(many, 1e-5), rel=1e-11)
    assert np.isnan(chi2_quantiles(0.5, 0.5, np.array([0.0, -1.0, 0.9]))).all()


@pytest.mark.parametrize("count", [1, 2, 7, 300])
def test_a_covariance_scale_is_the_median_of_the_ratios_weighted_by_degrees_of_freedom(count):
    rng = np.random.default_rng(count)
    dof = rng.uniform(0.5, 20.0, count)
    dof[0] = 3.0
    squared = np.round(4.0 * rng.chisquare(dof))  # some ratios are equal
    judged = dof >= 1.0
    ratio, weight = squared[judged] / chi2_quantile(0.5, dof[judged]), dof[judged]
    order = np.argsort(ratio, kind="stable")
    middle = np.cumsum(weight[order]) - 0.5 * weight[order]
    expected = np.interp(0.5 * weight.sum(), middle, ratio[order])
    found = covariance_scale(squared, dof)
    assert found.value == expected
    assert found.log_sigma == pytest.approx(1.3 * np.sqrt(2.0 / weight.sum()))
    assert covariance_scale(squared, np.full(count, 0.9)) is None
