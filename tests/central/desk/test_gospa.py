"""GOSPA against sets whose distance is known."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from teamslam.central.desk.evaluation.matching import assign, gospa, half_spacing

TRUE = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])


def test_of_equal_sets_in_another_order_it_is_zero() -> None:
    found = gospa(TRUE[::-1], TRUE, 2.0)
    assert (found.distance_m, found.missed, found.false) == (0.0, 0, 0)


def test_each_missed_and_each_false_one_costs_half_the_square_of_the_cut_off() -> None:
    found = gospa(np.array([[0.3, 0.0], [9.0, 9.0]]), TRUE, 2.0)
    assert found.distance_m == pytest.approx(np.sqrt(0.09 + 0.5 * 4.0 * 3))
    assert (found.missed, found.false) == (2, 1)
    assert found.localisation_m == pytest.approx(0.3)


def test_a_duplicate_is_a_false_one() -> None:
    found = gospa(np.concatenate((TRUE, TRUE[:1] + 0.1)), TRUE, 2.0)
    assert (found.missed, found.false) == (0, 1)


def test_the_cut_off_is_half_of_the_spacing() -> None:
    assert half_spacing(TRUE) == 2.0
    assert half_spacing(TRUE[:1]) is None


def test_points_are_assigned_with_the_least_sum_of_squared_distances() -> None:
    rng = np.random.default_rng(0)
    for n, m in ((0, 3), (1, 1), (4, 7), (7, 4), (12, 12)):
        found, true = rng.uniform(0.0, 3.0, (n, 2)), rng.uniform(0.0, 3.0, (m, 2))
        rows, columns, squared = assign(found, true, 1.0)
        costs = np.minimum(((found[:, None] - true[None]) ** 2).sum(axis=2), 1.0)
        best = costs[linear_sum_assignment(costs)].sum()
        assert len({*rows.tolist()}) == len({*columns.tolist()}) == len(squared)
        assert squared.sum() + min(n, m) - len(squared) == pytest.approx(best)
