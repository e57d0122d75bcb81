import dataclasses
import functools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.sim.studies.estimators import ekf_slam
from teamslam.sim.studies.estimators.ekf_slam import EkfSlam
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.config import Sensor
from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.gaussian import NotACovarianceError, cholesky_factor
from teamslam.team.estimation.hybrid_slam.window import NOTHING
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import compose, exponential
from tests.estimation.submap_world import wrap
from tests.support import state_error

SENSOR = Sensor(range_sigma=0.2, range_sigma_per_m=0.01, bearing_sigma=0.03)
STANDING = Increment.identity()
quick = settings(deadline=None, max_examples=40)
seeds = st.integers(0, 2**32 - 1)


def observed(x, slot):
    dx, dy = x[3 + 2 * slot] - x[0], x[4 + 2 * slot] - x[1]
    return np.array([np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - x[2])])


def jacobian(function, at, h=1e-6):
    columns = []
    for step in h * np.eye(len(at)):
        difference = function(at + step) - function(at - step)
        columns.append(difference / (2.0 * h))
    return np.stack(columns, axis=1)


def some_state(rng, landmarks=4):
    angles = rng.uniform(-np.pi, np.pi, landmarks)
    points = rng.uniform(5.0, 15.0, landmarks)[:, None] * np.column_stack(
        (np.cos(angles), np.sin(angles))
    )
    n = 3 + 2 * landmarks
    root = rng.normal(scale=0.1, size=(n, n)) + 0.1 * np.eye(n)
    mean = np.concatenate((rng.uniform(-1.0, 1.0, 3), points.ravel()))
    ids = rng.permutation(20)[:landmarks].astype(np.uint32)
    P = root @ root.T
    return EkfSlam(ids, mean, 0.5 * (P + P.T))


def some_motion(rng):
    root = rng.normal(scale=0.05, size=(3, 3))
    return Increment(rng.uniform([0.0, -0.3, -0.4], [1.0, 0.3, 0.4]), root @ root.T)


def textbook(state, motion, slots, measurements):
    """Thrun et al. 2005, table 3.3, with dense matrices and numerical Jacobians."""

    def moved(x, xi):
        c, s = np.cos(x[2]), np.sin(x[2])
        step = compose(motion.mean, exponential(xi))
        there = np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])
        return np.concatenate((x[:3] + there, x[3:]))

    F = jacobian(lambda x: moved(x, np.zeros(3)), state.mean)
    G = jacobian(lambda xi: moved(state.mean, xi), np.zeros(3))
    mean = moved(state.mean, np.zeros(3))
    P = F @ state.covariance @ F.T + G @ motion.covariance @ G.T
    predicted = np.concatenate([observed(mean, slot) for slot in slots])
    H = np.concatenate([jacobian(lambda x, k=k: observed(x, k), mean) for k in slots])
    sigmas = [(np.hypot(0.2, 0.01 * observed(mean, slot)[0]), 0.03) for slot in slots]
    R = np.diag(np.concatenate(sigmas) ** 2)
    innovation = np.concatenate(measurements) - predicted
    innovation[1::2] = wrap(innovation[1::2])
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    A = np.eye(len(mean)) - K @ H
    squared = innovation @ np.linalg.solve(H @ P @ H.T + R, innovation)
    mean = mean + K @ innovation
    mean[2] = wrap(mean[2])
    return mean, A @ P @ A.T + K @ R @ K.T, squared


@quick
@given(seeds)
def test_a_step_is_the_textbooks_with_all_measurements_of_the_keyframe_at_once(seed):
    rng = np.random.default_rng(seed)
    state, motion = some_state(rng), some_motion(rng)
    slots = rng.integers(0, 4, rng.integers(1, 6))
    there = np.concatenate((compose(state.mean[:3], motion.mean), state.mean[3:]))
    measurements = [observed(there, k) + rng.normal(scale=[0.2, 0.03]) for k in slots]
    z = np.array(measurements)
    step = RobotStep("r1", motion, SENSOR, state.ids[slots], z[:, 0], z[:, 1])
    after = ekf_slam.filter_step(state, step)
    mean, P, squared = textbook(state, motion, slots, measurements)
    judged = ekf_slam.innovation(state, step)
    assert judged.dof == 2 * len(slots)
    assert judged.squared == pytest.approx(squared, rel=1e-5)
    np.testing.assert_allclose(after.mean, mean, atol=1e-7)
    np.testing.assert_allclose(after.covariance, P, atol=1e-7)
    np.testing.assert_array_equal(after.covariance, after.covariance.T)
    cholesky_factor(after.covariance, "the state")


@quick
@given(seeds)
def test_a_first_sight_adds_the_landmark_with_its_cross_terms_and_changes_nothing_else(seed):
    rng = np.random.default_rng(seed)
    state = some_state(rng)
    z = np.array([rng.uniform(2.0, 20.0), rng.uniform(-np.pi, np.pi)])
    new = np.array([33], np.uint32)
    after = ekf_slam.filter_step(state, RobotStep("r1", STANDING, SENSOR, new, z[:1], z[1:]))
    n = len(state.mean)
    np.testing.assert_allclose(after.mean[:n], state.mean)
    np.testing.assert_allclose(after.covariance[:n, :n], state.covariance)

    def placed(x):
        direction = x[2] + x[-1]
        return x[:2] + x[-2] * np.array([np.cos(direction), np.sin(direction)])

    x = np.concatenate((state.mean, z))
    J = jacobian(placed, x)
    joint = np.zeros((n + 2, n + 2))
    joint[:n, :n] = state.covariance
    joint[n, n], joint[n + 1, n + 1] = 0.04 + (0.01 * z[0]) ** 2, 0.0009
    np.testing.assert_allclose(after.mean[n:], placed(x))
    np.testing.assert_allclose(after.covariance[n:, n:], J @ joint @ J.T, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(after.covariance[n:, :n], J[:, :n] @ state.covariance, atol=1e-7)


@functools.cache
def short_run(seed, repeat):
    """NEES, NIS and dofs of ten steps among six landmarks, each measurement `repeat` times."""
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(-12.0, 12.0, (6, 2))
    sensor = Sensor(range_sigma=0.05, bearing_sigma=0.005)
    motion = Increment(np.array([0.5, 0.0, 0.15]), np.diag([0.02, 0.01, 0.01]) ** 2)
    truth, state, judged = np.zeros(3), ekf_slam.initial_state(np.zeros(3)), NOTHING
    for _ in range(10):
        xi = np.array([0.02, 0.01, 0.01]) * rng.standard_normal(3)
        truth = compose(compose(truth, motion.mean), exponential(xi))
        d = landmarks - truth[:2]
        ranges = np.hypot(*d.T)
        seen = np.flatnonzero(ranges > 2.0)
        z = np.column_stack((ranges, np.arctan2(d[:, 1], d[:, 0]) - truth[2]))[seen]
        z = z + np.array([0.05, 0.005]) * rng.standard_normal(z.shape)
        ids = np.repeat(seen.astype(np.uint32), repeat)
        z = np.repeat(z, repeat, axis=0)
        keyframe = ids, z[:, 0], wrap(z[:, 1])
        step = RobotStep("r1", motion, sensor, *keyframe)
        judged = judged.plus(ekf_slam.innovation(state, step))
        state = ekf_slam.filter_step(state, step)
    local = ekf_slam.local_map(state)
    error = state_error(local.mean, np.concatenate((truth, landmarks[local.ids].ravel())))
    return nees(error, local.covariance), len(error), *judged


@pytest.mark.parametrize("column", [0, 2], ids=["NEES", "NIS"])
def test_a_short_window_is_consistent_and_one_that_counts_measurements_twice_is_not(column):
    honest, twice = (np.array([short_run(seed, k) for seed in range(200)]) for k in (1, 2))
    for runs, is_right in ((honest, True), (twice, False)):
        dof = runs[:, column + 1].sum()
        low, high = chi2_interval(int(dof), 0.999, 1)
        assert (low < runs[:, column].sum() / dof < high) == is_right


def test_a_state_whose_covariance_is_none_any_more_is_named_not_carried_on():
    """Rounding or a diverged filter leaves a covariance with a negative pivot."""
    rng = np.random.default_rng(0)
    state = some_state(rng)
    broken = dataclasses.replace(state, covariance=state.covariance - np.eye(11))
    measurements = (state.ids[:1], np.array([9.0]), np.array([0.1]))
    with pytest.raises(NotACovarianceError, match="prediction of measurements"):
        ekf_slam.filter_step(broken, RobotStep("r1", STANDING, SENSOR, *measurements))
