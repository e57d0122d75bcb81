import math

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.core import predicted
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import compose, exponential, inverse, tangent, wrapped
from tests.estimation.hybrid_slam import one_landmark

SENSOR = (0.04, 0.001, 0.003)
POSE = (1.5, -0.7, 0.9)
MEAN, COVARIANCE = np.array([4.0, 2.5]), np.array([[0.3, 0.11], [0.11, 0.2]])
OWN = {
    "none": np.empty(0),
    "refused": np.array([9.0, 9.0, 9.0, -1.0]),
    "range and bearing": np.array([0.05, 0.006, 0.002, 0.0]),
    "point": np.array([0.05, 0.006, 0.002, 1.0]),
}


def noise(own: np.ndarray, distance: float) -> np.ndarray:
    if len(own) and own[3] >= 0.0:
        return np.array([[own[0], own[1]], [own[1], own[2]]])
    return np.diag([SENSOR[0] + SENSOR[1] * distance**2, SENSOR[2]])


def log_density(e: np.ndarray, S: np.ndarray) -> float:
    return -0.5 * float(e @ np.linalg.solve(S, e) + np.linalg.slogdet(2.0 * math.pi * S)[1])


def kalman(e: np.ndarray, H: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    S = H @ COVARIANCE @ H.T + R
    K = COVARIANCE @ H.T @ np.linalg.inv(S)
    return MEAN + K @ e, COVARIANCE - K @ H @ COVARIANCE, log_density(e, S)


def updated(z: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    packed = COVARIANCE[[0, 0, 1], [0, 1, 1]]
    mean, packed, likelihood = one_landmark.updated(
        MEAN, packed, POSE, (z[:1], z[1:]), SENSOR, own[None]
    )
    return mean, packed[[[0, 1], [1, 2]]], likelihood


@pytest.mark.parametrize("kind", ["none", "refused", "range and bearing"])
def test_the_range_and_then_the_bearing_are_the_joint_update(kind):
    """Range first, then the bearing less its regression on the range: the same Gaussian."""
    h = np.array(predicted(np.array(POSE), MEAN))
    z = h + np.array([0.2, -0.05])
    H = core.predict(np.array(POSE), MEAN[None])[2][0]
    expected = kalman(z - h, H, noise(OWN[kind], h[0]))
    for got, textbook in zip(updated(z, OWN[kind]), expected, strict=True):
        np.testing.assert_allclose(got, textbook, rtol=1e-10)


def test_a_measured_point_is_a_linear_measurement_in_the_plane():
    """Its density is that of (range, bearing of the predicted range) times `distance`."""
    h = np.array(predicted(np.array(POSE), MEAN))
    z = h + np.array([0.3, 0.4])
    to_map = tangent(POSE[2] + z[1])[:2, :2]
    point = np.array(POSE[:2]) + to_map @ np.array([z[0], 0.0])
    along = np.diag([1.0, z[0]])
    covariance = to_map @ along @ noise(OWN["point"], h[0]) @ along @ to_map.T
    mean, spread, likelihood = kalman(point - MEAN, np.eye(2), covariance)
    got = updated(z, OWN["point"])
    np.testing.assert_allclose(got[0], mean, rtol=1e-10)
    np.testing.assert_allclose(got[1], spread, rtol=1e-10)
    assert got[2] == pytest.approx(likelihood + math.log(h[0]), rel=1e-10)


EVIDENCE, REACH, FIELD = math.log(100.0), 3.0, 6.0


def least_prior(
    motion: np.ndarray, covariance: np.ndarray, z: np.ndarray, own: np.ndarray
) -> float:
    """Least log odds of an inlier at which two scans' measurements agree."""
    none, some = -20.0, EVIDENCE
    while some - none > 1e-12:
        prior = 0.5 * (none + some)
        noise = SENSOR[0], SENSOR[1], 1.0, SENSOR[2], 1.0
        consensus = core.Consensus(noise, 1e6, FIELD, 1.0 / (1.0 + math.exp(prior)))
        for step, each in ((np.zeros((4, 3)), z[0]), (np.vstack((motion, covariance)), z[1])):
            seen = np.array([7], np.uint32), each[:1], each[1:], own.reshape(1, -1)
            consensus.add(Increment(step[0], step[1:]).keyframe(core.Scan(*seen)))
        taken = consensus.agreeing()
        assert taken.all() or not taken.any()
        none, some = (none, prior) if taken.all() else (prior, some)
    return some


@pytest.mark.parametrize("kind", ["none", "range and bearing"])
def test_one_measurement_predicts_another_with_all_of_their_noise(kind):
    """S = R + Hₓ C Hₓᵀ + Hₗ Σ Hₗᵀ, with Jacobians by differences.

    Both agree where log p + prior + log(reach · field of view), the best-supported one's support,
    exceeds EVIDENCE − prior.
    """
    own = OWN[kind]
    seen, z, pose = np.array([REACH, 0.4]), np.array([2.4, 0.9]), np.array([0.8, -0.3, 0.2])
    A = np.array([[0.2, 0.0, 0.0], [0.05, 0.1, 0.0], [-0.02, 0.03, 0.07]])
    spread = A @ A.T

    def log_likelihood(of, given, there):
        def h(xi, given):
            point = given[0] * np.array([math.cos(given[1]), math.sin(given[1])])
            return np.array(predicted(there(xi), point))

        def slopes(f, at):
            step = 1e-6 * np.eye(len(at))
            return np.array([(f(at + d) - f(at - d)) / 2e-6 for d in step]).T

        Hx = slopes(lambda xi: h(xi, given), np.zeros(3))
        Hl = slopes(lambda g: h(np.zeros(3), g), given)
        expected = h(np.zeros(3), given)
        S = noise(own, expected[0]) + Hx @ spread @ Hx.T + Hl @ noise(own, given[0]) @ Hl.T
        return log_density(np.array([of[0] - expected[0], wrapped(of[1] - expected[1])]), S)

    moved = lambda xi: compose(pose, exponential(xi))  # noqa: E731
    logs = (log_likelihood(z, seen, moved), log_likelihood(seen, z, lambda xi: inverse(moved(xi))))
    expected = 0.5 * (EVIDENCE - math.log(REACH * FIELD) - max(logs))
    assert expected < EVIDENCE
    assert least_prior(pose, spread, np.array([seen, z]), own) == pytest.approx(expected, rel=1e-6)
