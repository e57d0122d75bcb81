import numpy as np
import pytest

from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.estimation.map_joining.conditioning import Posed, initial_map
from teamslam.team.estimation.map_joining.localising import locate_robot
from teamslam.team.estimation.se2 import compose, inverse, transformed, wrapped
from teamslam.team.estimation.submap import LocalMap

PLACES = np.array([[0.0, 0.0], [6.0, 1.0], [3.0, 7.0], [-4.0, 5.0], [2.0, -6.0], [8.0, 8.0]])
START, MOTION = np.array([3.0, 2.0, 2.4]), np.array([1.5, 0.4, 0.7])


def spread(rng, n, sigma):
    root = sigma * (np.eye(n) + 0.4 * rng.standard_normal((n, n)) / np.sqrt(n))
    return root @ root.T


def drawn(seed, seen, moved=()):
    rng = np.random.default_rng(seed)
    n = len(PLACES)
    P = spread(rng, 2 * n, 0.05)
    means = PLACES + rng.multivariate_normal(np.zeros(2 * n), P).reshape(-1, 2)
    team = LandmarkGaussian(np.arange(1, n + 1, dtype=np.uint32), means, P)
    places = PLACES.copy()
    for k, by in moved:
        places[k] += by
    back = inverse(START)
    local = np.array([transformed(back, places[k]) for k in seen])
    mean = np.concatenate([MOTION, local.ravel()])
    Q = spread(rng, len(mean), 0.05)
    ids = np.array([k + 1 for k in seen], np.uint32)
    return team, LocalMap(ids, rng.multivariate_normal(mean, Q), Q)


def placed(team, window) -> Posed | str:
    return locate_robot(team, initial_map(np.zeros(3), None), window)


def nees(found: Posed) -> float:
    error = found.pose.mean - compose(START, MOTION)
    error[2] = wrapped(error[2])
    return float(error @ np.linalg.solve(found.pose.covariance, error))


@pytest.mark.parametrize("seen", [(0, 1), (1, 2, 4), tuple(range(6))])
def test_the_error_of_a_placement_has_the_stated_covariance(seen):
    found = [placed(*drawn(seed, seen)) for seed in range(300)]
    kept = [nees(each) for each in found if isinstance(each, Posed)]
    assert len(kept) >= 297
    assert 0.85 < np.mean(kept) / 3.0 < 1.15
    assert np.mean(np.array(kept) < 8.02) > 0.92  # two standard deviations


def test_one_landmark_two_vague_ones_or_a_mirrored_map_place_nothing():
    team, window = drawn(1, (0,))
    assert placed(team, window) == "1 shared landmark, 2 needed"
    vague = team._replace(covariance=1e4 * team.covariance)
    assert "too close" in str(placed(vague, drawn(1, (0, 1))[1]))
    mirrored = team._replace(means=team.means * [1.0, -1.0])
    assert "disagree" in str(placed(mirrored, drawn(1, range(6))[1]))


def test_a_landmark_that_has_moved_is_left_out():
    team, window = drawn(1, range(6), moved=[(2, (2.0, -1.0))])
    found = placed(team, window)
    assert isinstance(found, Posed)
    assert (found.known, found.refused) == (6, 1)
    assert nees(found) < 14.2


def test_the_covariance_factor_of_submaps_holds_for_the_robots_own_map():
    team, window = drawn(1, range(6))
    exact = team._replace(covariance=1e-8 * team.covariance)
    one, four = (
        locate_robot(exact, initial_map(np.zeros(3), None), window, factor) for factor in (1.0, 4.0)
    )
    assert isinstance(one, Posed)
    assert isinstance(four, Posed)
    assert np.allclose(four.pose.covariance, 4.0 * one.pose.covariance, rtol=1e-3)
