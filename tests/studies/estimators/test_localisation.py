import dataclasses
import functools

import numpy as np
import pytest

from teamslam.sim.studies.estimators import localisation
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.hybrid_slam.window import NOTHING
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import compose, exponential
from tests.estimation.submap_world import wrap
from tests.support import state_error

IDS = np.array([2, 5, 9], np.uint32)
LANDMARKS = np.array([[9.0, 2.0], [-4.0, 7.0], [1.0, -8.0]])
SENSOR = Sensor(range_sigma=0.8, range_sigma_per_m=0.02, bearing_sigma=0.15)
MOTION = Increment(np.array([1.0, 0.1, 0.2]), np.diag([0.1, 0.05, 0.05]) ** 2)
STANDING = Increment.identity()


def sights(pose, landmarks=LANDMARKS):
    d = landmarks - pose[:2]
    return np.hypot(*d.T), wrap(np.arctan2(d[:, 1], d[:, 0]) - pose[2])


def log_likelihood(poses, seen, ranges, bearings, sensor=SENSOR):
    """Σ log p(z | pose) of many poses, by broadcasting."""
    d = LANDMARKS[seen] - poses[:, None, :2]
    r = np.hypot(d[..., 0], d[..., 1])
    sigma = np.hypot(sensor.range_sigma, sensor.range_sigma_per_m * r)
    turn = wrap(np.arctan2(d[..., 1], d[..., 0]) - poses[:, 2:] - bearings)
    terms = ((r - ranges) / sigma) ** 2 + (turn / sensor.bearing_sigma) ** 2
    return (-0.5 * terms - np.log(sigma)).sum(axis=1)


def test_from_an_unknown_start_it_has_the_posterior_of_a_grid():
    exact = Increment(MOTION.mean, np.zeros((3, 3)))
    truth = np.array([0.5, -1.0, 0.4])
    r1, b1 = sights(truth)
    r2, b2 = sights(compose(truth, MOTION.mean))
    r1, b2 = r1 + np.array([0.5, -0.3, 0.4]), b2 + np.array([0.1, -0.05, 0.02])
    x, y, heading = (
        np.linspace(-5.0, 5.0, 81),
        np.linspace(-5.0, 5.0, 81),
        np.linspace(-np.pi, np.pi, 180, endpoint=False),
    )
    grid = np.stack(np.meshgrid(x, y, heading, indexing="ij"), axis=-1).reshape(-1, 3)
    c, s = np.cos(grid[:, 2]), np.sin(grid[:, 2])
    dx, dy, turn = MOTION.mean
    later = grid + np.column_stack((c * dx - s * dy, s * dx + c * dy, np.full(len(grid), turn)))
    log_weight = log_likelihood(grid, [0, 1], r1[:2], b1[:2])
    log_weight += log_likelihood(later, [2], r2[2:], b2[2:])
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = weight @ later
    P = (later - mean).T @ ((later - mean) * weight[:, None])

    random = np.random.default_rng(0)
    low, high = np.array([-5.0, -5.0]), np.array([5.0, 5.0])
    state = localisation.initial_state_anywhere(low, high, 200_000, IDS, LANDMARKS, random)
    state = dataclasses.replace(state, resample_below=0.0)
    first = RobotStep("r1", STANDING, SENSOR, IDS[:2], r1[:2], b1[:2])
    state = localisation.filter_step(state, first, random)
    second = RobotStep("r1", exact, SENSOR, IDS[2:], r2[2:], b2[2:])
    state = localisation.filter_step(state, second, random)
    found, spread = localisation.pose_gaussian(state)
    sigma = np.sqrt(np.diag(P))
    effective = core.effective_sample_size(state.cloud.log_weights)
    assert effective > 300.0
    assert np.abs((found - mean) / sigma).max() < 4.0 / np.sqrt(effective)
    assert np.abs((spread - P) / np.outer(sigma, sigma)).max() < 6.0 / np.sqrt(effective)


@functools.cache
def short_run(seed, repeat):
    """NEES and NIS of eight steps; each measurement counts `repeat` times."""
    random, judged = np.random.default_rng(seed), NOTHING
    truth, state = np.zeros(3), localisation.initial_state(np.zeros(3), 1000, IDS, LANDMARKS)
    for _ in range(8):
        xi = np.array([0.1, 0.05, 0.05]) * random.standard_normal(3)
        truth = compose(compose(truth, MOTION.mean), exponential(xi))
        ranges, bearings = sights(truth)
        sigma = np.hypot(0.8, 0.02 * ranges)
        ranges = ranges + sigma * random.standard_normal(3)
        bearings = wrap(bearings + 0.15 * random.standard_normal(3))
        keyframe = [np.repeat(part, repeat) for part in (IDS, ranges, bearings)]
        step = RobotStep("r1", MOTION, SENSOR, *keyframe)
        judged = judged.plus(localisation.innovation(state, step))
        state = localisation.filter_step(state, step, random)
    pose = localisation.pose_gaussian(state)
    return nees(state_error(pose.mean, truth), pose.covariance), 3, *judged


@pytest.mark.parametrize("column", [0, 2], ids=["NEES", "NIS"])
def test_it_is_consistent_and_one_that_counts_measurements_twice_is_not(column):
    for repeat in (1, 2):
        runs = np.array([short_run(seed, repeat) for seed in range(200)])
        dof = runs[:, column + 1].sum()
        low, high = chi2_interval(int(dof), 0.999, 1)
        assert (low < runs[:, column].sum() / dof < high) == (repeat == 1)
