import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from teamslam.sim.studies.rules.map_fusion import covariance_intersection, kalman
from teamslam.team.estimation.gaussian import LandmarkGaussian
from tests.estimation.submap_world import correlated


def one(x, variance, id_=1):
    return LandmarkGaussian(
        np.array([id_], np.uint32), np.array([[x, 0.0]]), np.diag([variance, 1.0])
    )


def random_map(ids, seed, sigma=1.0):
    rng = np.random.default_rng(seed)
    n = 2 * len(ids)
    return LandmarkGaussian(
        np.array(ids, np.uint32), rng.normal(size=(len(ids), 2)), correlated(np.full(n, sigma), rng)
    )


def test_the_intersection_of_crossed_ellipses_meets_in_the_middle():
    a = LandmarkGaussian(np.array([1], np.uint32), np.array([[1.0, 0.0]]), np.diag([1.0, 4.0]))
    b = LandmarkGaussian(np.array([1], np.uint32), np.array([[0.0, 1.0]]), np.diag([4.0, 1.0]))
    fused = covariance_intersection([a, b])
    np.testing.assert_allclose(fused.covariance, 1.6 * np.eye(2), atol=1e-6)
    np.testing.assert_allclose(fused.means, [[0.8, 0.8]], atol=1e-6)


def test_kalman_equals_the_sum_of_the_information_of_maps_that_overlap():
    a, b, c = random_map([1, 2, 5], 2), random_map([2, 3, 5], 3, 0.5), random_map([3, 4], 4)
    information, vector = np.zeros((10, 10)), np.zeros(10)
    for each in (a, b, c):
        place = np.concatenate([2 * (id_ - 1) + np.arange(2) for id_ in each.ids.astype(int)])
        own = np.linalg.inv(each.covariance)
        information[np.ix_(place, place)] += own
        vector[place] += own @ each.means.ravel()
    fused = kalman([a, b, c])
    covariance = np.linalg.inv(information)
    np.testing.assert_array_equal(fused.ids, [1, 2, 3, 4, 5])
    np.testing.assert_allclose(fused.covariance, covariance, atol=1e-10)
    np.testing.assert_allclose(fused.means.ravel(), covariance @ vector, atol=1e-10)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32))
def test_the_intersection_holds_for_inputs_that_share_their_error(seed):
    """For any joint error with these marginals, the claimed covariance is at least the true one."""
    rng = np.random.default_rng(seed)
    n = 4
    joint = correlated(rng.uniform(0.5, 2.0, 2 * n), rng)
    shared = rng.normal(size=(2 * n, 2))
    joint += shared @ shared.T
    P_a, P_b = joint[:n, :n], joint[n:, n:]
    ids = np.array([1, 2], np.uint32)
    x = rng.normal(size=2 * n)

    def fused_mean(errors):
        return covariance_intersection(
            [
                LandmarkGaussian(ids, errors[:n].reshape(-1, 2), P_a),
                LandmarkGaussian(ids, errors[n:].reshape(-1, 2), P_b),
            ]
        )

    claimed = fused_mean(x).covariance
    weights = np.array([fused_mean(unit).means.ravel() for unit in np.eye(2 * n)]).T
    true = weights @ joint @ weights.T
    assert np.linalg.eigvalsh(claimed - true)[0] > -1e-8
