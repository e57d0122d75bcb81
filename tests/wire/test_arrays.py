"""A pose's covariance is judged as a matrix of any size is."""

import numpy as np
import pytest

from teamslam.team.core import check_packed_covariance, check_pose_covariance
from teamslam.team.wire.arrays import from_floats


def verdict(check, *arguments):
    try:
        check(*arguments)
    except ValueError as error:
        return str(error).partition(":")[0]
    return "sound"


@pytest.mark.parametrize("seed", range(20))
def test_a_symmetric_pose_covariance_is_judged_as_a_packed_one_of_three_rows_is(seed):
    rng = np.random.default_rng(seed)
    scale = np.diag(10.0 ** rng.uniform(-100.0, 100.0, 3))
    root = rng.normal(size=(3, 3))
    P = root @ root.T
    for matrix in (P, P - 0.5 * np.eye(3), root[:, :2] @ root[:, :2].T - 1e-6 * np.eye(3), -P):
        scaled = scale @ (0.5 * (matrix + matrix.T)) @ scale
        packed = from_floats(scaled[np.triu_indices(3)])
        expected = verdict(check_packed_covariance, packed, 3, "it")
        assert verdict(check_pose_covariance, from_floats(scaled), "it") == expected


@pytest.mark.parametrize("place", [(0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)])
def test_symmetry_is_judged_by_the_standard_deviations(place):
    sigmas = np.array([1e-3, 10.0, 0.1])
    P = np.outer(sigmas, sigmas) * (0.3 + 0.7 * np.eye(3))
    for by, expected in ((5e-10, "sound"), (2e-9, "not symmetric")):
        other = P.copy()
        other[place] += by * sigmas[place[0]] * sigmas[place[1]]
        assert verdict(check_pose_covariance, from_floats(other), "it") == expected


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(9))
def test_no_entry_of_a_pose_covariance_is_infinite_or_no_number(value, place):
    P = np.eye(3).ravel()
    P[place] = value
    assert verdict(check_pose_covariance, from_floats(P), "it") == "not finite"
