"""Two places of one landmark: observations that agree with each other, not misread ones."""

import numpy as np
import pytest

from teamslam.team.estimation.map_joining.hypotheses import Sights, clusters_of

SIGMA_M = 0.05


def sights(elsewhere, n):
    """Draw n observations of a landmark, the last of them about the given places."""
    rng = np.random.default_rng(0)
    true = np.zeros((n, 2))
    true[n - len(elsewhere) :] = elsewhere
    spread = np.tile((SIGMA_M**2, 0.0, SIGMA_M**2), (n, 1))
    at = np.arange(n)
    return Sights(at, at, true + rng.normal(0.0, SIGMA_M, (n, 2)), spread)


@pytest.mark.parametrize(("n", "second"), [(24, 2), (177, 8), (24, 12)])
def test_observations_that_agree_are_a_second_place_however_few(n, second):
    found = clusters_of(sights(np.tile((8.0, -3.0), (second, 1)), n), 1.0)
    assert found is not None
    assert np.flatnonzero(found.second).tolist() in (
        list(range(n - second, n)),
        list(range(n - second)),
    )
    assert found.evidence > 30.0


@pytest.mark.parametrize(("n", "second"), [(24, 2), (177, 8), (177, 17)])
def test_scattered_observations_are_no_second_place(n, second):
    scattered = np.random.default_rng(1).uniform((2.0, -2.0), (6.0, 2.0), (second, 2))
    assert clusters_of(sights(scattered, n), 1.0) is None


def test_one_place_is_no_two():
    found = clusters_of(sights(np.empty((0, 2)), 40), 1.0)
    assert found is None or found.evidence < 0.0
