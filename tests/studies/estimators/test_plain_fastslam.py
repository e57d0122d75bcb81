import dataclasses

import numpy as np
import pytest

from teamslam.sim.studies.estimators import plain_fastslam
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import random_numbers
from teamslam.team.estimation.models import increment_of
from tests.estimation.hybrid_slam.test_window import ACCURATE, COARSE, ROBOT, drive, driven

PROPOSALS = ["fastslam1", "fastslam2"]


def filtered(drive_, sensor, state, random, repeat=1):
    for (distance, turn), keyframe in zip(drive_.motions, drive_.keyframes, strict=True):
        measurements = (np.repeat(part, repeat) for part in keyframe)
        step = RobotStep("r1", increment_of(ROBOT, 1.0, distance, turn), sensor, *measurements)
        state = plain_fastslam.filter_step(state, step, random)
    return state


class CoreNumbers(np.random.Generator):
    """The core's random numbers of a window, drawn as from NumPy's generator."""

    def __init__(self):
        super().__init__(np.random.Philox(0))
        self._random = random_numbers(0, "r1", 0, 0)

    def random(self):
        return self._random.uniform()

    def standard_normal(self, shape):
        return self._random.normals(*shape)


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_it_is_a_window_that_never_closes(proposal):
    told = drive(1, COARSE, steps=20)
    window = driven(told, COARSE, 60, proposal=proposal)
    state = plain_fastslam.initial_state(np.zeros(3), 60, proposal, 0.5)
    state = filtered(told, COARSE, state, CoreNumbers())
    for field in dataclasses.fields(Particles):
        ours, theirs = (getattr(each.particles, field.name) for each in (state, window))
        assert ours.tobytes() == theirs.tobytes()


def test_the_map_is_the_mixture_of_the_particles_maps_by_id():
    told = drive(3, COARSE)
    state = plain_fastslam.initial_state(np.zeros(3), 30, "fastslam2", 0.5)
    particles = filtered(told, COARSE, state, np.random.default_rng(1)).particles
    ids, means, P = plain_fastslam.landmark_moments(particles)
    order = np.argsort(particles.ids)
    np.testing.assert_array_equal(ids, np.sort(particles.ids))
    maps = particles.means[:, order].reshape(30, -1)
    w = np.exp(particles.log_weights)
    mean = w @ maps
    expected = (maps - mean).T @ ((maps - mean) * w[:, None])
    for k, slot in enumerate(order):
        xx, xy, yy = w @ particles.covariances[:, slot]
        expected[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += [[xx, xy], [xy, yy]]
    np.testing.assert_allclose(means.ravel(), mean)
    np.testing.assert_allclose(P, expected, atol=1e-12)
    assert np.abs(expected[:2, 2:]).max() > 1e-3


def short_run(seed, repeat):
    told = drive(seed, ACCURATE, steps=8)
    start = plain_fastslam.initial_state(np.zeros(3), 500, "fastslam2", 0.5)
    state = filtered(told, ACCURATE, start, np.random.default_rng(seed), repeat)
    landmarks = plain_fastslam.landmark_gaussian(state)
    error = (landmarks.means - told.landmarks[landmarks.ids]).ravel()
    if not len(error):
        return 0.0, 0
    return nees(error, landmarks.covariance), len(error)


def test_a_short_run_is_consistent_and_one_that_counts_measurements_twice_is_not():
    honest, twice = (np.array([short_run(seed, k) for seed in range(80)]) for k in (1, 2))
    low, high = chi2_interval(int(honest[:, 1].sum()), 0.999, 1)
    assert low < honest[:, 0].sum() / honest[:, 1].sum() < high
    assert not low < twice[:, 0].sum() / twice[:, 1].sum() < high
