"""FastSLAM over a whole run: the same filter as a window's, and as over-confident as known."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.studies.estimators import plain_fastslam
from team.estimation.consistency import chi2_interval, nees, state_error
from team.estimation.geometry import compose, transformed
from team.estimation.hybrid_slam.fastslam import Particles
from team.estimation.models import increment_of
from team.estimation.randomness import generator
from tests.estimation.estimator_runs import keyframes_of, map_errors, run, world
from tests.estimation.hybrid_slam.test_window import ACCURATE, COARSE, ROBOT, drive, driven, wrap

PROPOSALS = ["fastslam1", "fastslam2"]


def filtered(drive_, sensor, state, random, repeat=1):
    for (distance, turn), keyframe in zip(drive_.motions, drive_.keyframes, strict=True):
        measurements = (np.repeat(part, repeat) for part in keyframe)
        increment = increment_of(ROBOT, 1.0, distance, turn)
        state = plain_fastslam.filter_step(state, increment, sensor, *measurements, random)
    return state


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_it_is_a_window_that_never_closes(proposal):
    told = drive(1, COARSE, steps=20)
    window = driven(told, COARSE, 60, proposal=proposal)
    state = plain_fastslam.initial_state(np.zeros(3), 60, proposal, 0.5)
    state = filtered(told, COARSE, state, generator(0, "r1", 0, 0))
    for field in dataclasses.fields(Particles):
        ours, theirs = (getattr(each.particles, field.name) for each in (state, window))
        assert ours.tobytes() == theirs.tobytes()


@settings(deadline=None, max_examples=20)
@given(st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0), st.floats(-3.0, 3.0)))
def test_another_start_pose_moves_the_answer_with_it(start):
    shift, told = np.array(start), drive(2, ACCURATE, steps=4)
    here, there = (
        filtered(
            told,
            ACCURATE,
            plain_fastslam.initial_state(pose, 20, "fastslam2", 0.0),
            np.random.default_rng(0),
        )
        for pose in (np.zeros(3), shift)
    )
    one, other = (plain_fastslam.landmark_gaussian(state) for state in (here, there))
    moved = np.array([transformed(shift, point) for point in one.means])
    np.testing.assert_allclose(other.means, moved, atol=1e-6)
    c, s = np.cos(shift[2]), np.sin(shift[2])
    turn = np.kron(np.eye(len(moved)), np.array([[c, -s], [s, c]]))
    np.testing.assert_allclose(other.covariance, turn @ one.covariance @ turn.T, atol=1e-6)
    pose = compose(shift, plain_fastslam.pose_gaussian(here).mean)
    difference = plain_fastslam.pose_gaussian(there).mean - pose
    np.testing.assert_allclose([*difference[:2], wrap(difference[2])], 0.0, atol=1e-6)


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


def tagged(state):
    """Each particle knows a landmark 99 that is never read, at its own number."""
    count = len(state.particles.poses)
    particles = dataclasses.replace(
        state.particles,
        ids=np.array([99], np.uint32),
        means=np.tile(np.arange(count, dtype=float)[:, None, None], (1, 1, 2)),
        covariances=np.ones((count, 1, 3)),
    )
    return dataclasses.replace(state, particles=particles)


def test_the_threshold_says_when_a_step_begins_with_a_resampling():
    told = drive(4, ACCURATE)
    survivors = {}
    for below in (0.0, 0.5, 1.0):
        start = tagged(plain_fastslam.initial_state(np.zeros(3), 200, "fastslam1", below))
        end = filtered(told, ACCURATE, start, np.random.default_rng(2)).particles
        survivors[below] = len(np.unique(end.means[:, 0, 0]))
    assert survivors[0.0] == 200 > 2 * survivors[0.5] > 0
    assert survivors[1.0] < 100


def short_run(seed, repeat):
    """NEES and dof of the map after a short drive, each measurement told `repeat` times."""
    told = drive(seed, ACCURATE, steps=8)
    start = plain_fastslam.initial_state(np.zeros(3), 500, "fastslam2", 0.5)
    state = filtered(told, ACCURATE, start, np.random.default_rng(seed), repeat)
    landmarks = plain_fastslam.landmark_gaussian(state)
    error = (landmarks.means - told.landmarks[landmarks.ids]).ravel()
    if not len(error):
        return 0.0, 0
    return nees(error, landmarks.covariance), len(error)


def test_a_short_run_is_consistent_and_one_that_counts_measurements_twice_is_not():
    honest, twice = (np.array([short_run(seed, k) for seed in range(200)]) for k in (1, 2))
    low, high = chi2_interval(int(honest[:, 1].sum()), 0.999, 1)
    assert low < honest[:, 0].sum() / honest[:, 1].sum() < high
    assert not low < twice[:, 0].sum() / twice[:, 1].sum() < high


@pytest.mark.parametrize(("name", "at_least"), [("thesis", 50.0), ("thesis-b", 500.0)])
@pytest.mark.parametrize("proposal", PROPOSALS)
def test_over_a_whole_run_it_is_over_confident_by_nature(name, at_least, proposal):
    # Measured over 20 runs with 50 particles: 911 and 1302 (coarse), 4e4 and 2e4 (accurate).
    values, poses = [], []
    for seed in (1, 2):
        robots, streams = world(name, seed)
        for config, stream in zip(robots, streams.streams, strict=True):
            state = plain_fastslam.initial_state(stream.start.pose, 50, proposal, 0.5)
            keyframes = keyframes_of(config, stream)
            random = generator(seed, config.id, 0, 0)
            state = run(state, plain_fastslam.filter_step, keyframes, config, random)
            landmarks = plain_fastslam.landmark_gaussian(state)
            error = map_errors(landmarks, streams)
            values.append(nees(error, landmarks.covariance) / len(error))
            pose = plain_fastslam.pose_gaussian(state)
            poses.append(nees(state_error(pose.mean, stream.truth[-1]), pose.covariance) / 3.0)
    assert np.mean(values) > at_least
    assert np.mean(poses) > 10.0 > chi2_interval(3, 0.999, len(poses))[1]


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_the_same_inputs_give_the_same_bytes_and_stay_untouched(proposal):
    told = drive(5, COARSE)
    start = plain_fastslam.initial_state(np.ones(3), 25, proposal, 1.0)
    kept = [getattr(start.particles, f.name).copy() for f in dataclasses.fields(Particles)]
    once, twice = (filtered(told, COARSE, start, np.random.default_rng(3)) for _ in range(2))
    for field, before in zip(dataclasses.fields(Particles), kept, strict=True):
        ours, again = (getattr(each.particles, field.name) for each in (once, twice))
        assert ours.tobytes() == again.tobytes()
        np.testing.assert_array_equal(getattr(start.particles, field.name), before)
