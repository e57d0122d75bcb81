import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.core import moments
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.models import Increment, Noise
from teamslam.team.library import Keyframe, fastslam_step
from tests.estimation.submap_world import wrap

quick = settings(deadline=None, max_examples=60)
SENSOR = Sensor(range_sigma=0.1, range_sigma_per_m=0.001, bearing_sigma=0.002)
LANDMARKS = np.array([[60.0, 5.0], [10.0, 70.0], [-40.0, -50.0]])
IDS = np.array([7, 3, 5], np.uint32)
STANDING = Increment.identity()
MOTION = Increment(np.array([1.0, 0.2, 0.1]), np.diag([0.05, 0.03, 0.004]) ** 2)
RANK_TWO = np.array([[0.05, 0.0], [0.0, 0.03], [0.0, 0.004]])


def observed(state, k):
    dx, dy = state[3 + 2 * k] - state[0], state[4 + 2 * k] - state[1]
    return np.array([np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - state[2])])


def moved(state, motion):
    c, s = np.cos(state[2]), np.sin(state[2])
    x, y = state[:2] + np.array([[c, -s], [s, c]]) @ motion[:2]
    return np.array([x, y, state[2] + motion[2], *state[3:]])


def jacobian(function, at):
    columns = [
        (function(at + step) - function(at - step)) / 2e-5 for step in 1e-5 * np.eye(len(at))
    ]
    return np.stack(columns, axis=1)


def kalman(motions, keyframes):
    """Mean, covariance and log evidence of the joint Gaussian over (pose, landmarks).

    A first sight places its landmark; keyframes hold (landmark, measurement) pairs.
    """
    mean, P, log_evidence, seen = np.zeros(9), np.zeros((9, 9)), 0.0, set()
    for motion, measurements in zip(motions, keyframes, strict=True):
        F = jacobian(lambda state, m=motion.mean: moved(state, m), mean)
        mean = moved(mean, motion.mean)
        turn = np.eye(9)[:, :3]
        c, s = np.cos(mean[2]), np.sin(mean[2])
        turn[:2, :2] = [[c, -s], [s, c]]
        P = F @ P @ F.T + turn @ motion.covariance @ turn.T
        for k, z in measurements:
            if k not in seen:
                seen.add(k)
                direction = mean[2] + z[1]
                mean[3 + 2 * k : 5 + 2 * k] = mean[:2] + z[0] * np.array(
                    [np.cos(direction), np.sin(direction)]
                )
                P[3 + 2 * k, 3 + 2 * k] = P[4 + 2 * k, 4 + 2 * k] = 1e8
                flat = True
            else:
                flat = False
            H = jacobian(lambda state, k=k: observed(state, k), mean)
            distance = observed(mean, k)[0]
            R = np.diag([0.1**2 + (0.001 * distance) ** 2, 0.002**2])
            S = H @ P @ H.T + R
            innovation = z - observed(mean, k)
            innovation[1] = wrap(innovation[1])
            if not flat:
                log_evidence -= 0.5 * innovation @ np.linalg.solve(S, innovation)
                log_evidence -= 0.5 * np.linalg.slogdet(2.0 * np.pi * S)[1]
            K = np.linalg.solve(S, H @ P).T
            mean = mean + K @ innovation
            A = np.eye(9) - K @ H
            P = A @ P @ A.T + K @ R @ K.T
    return mean, P, log_evidence


def simulated(seed, steps=5, covariance=MOTION.covariance):
    rng = np.random.default_rng(seed)
    truth = np.concatenate((np.zeros(3), LANDMARKS.ravel()))
    motions, keyframes = [], []
    for step in range(steps):
        motion = STANDING if step == 0 else Increment(MOTION.mean, covariance)
        noise = rng.multivariate_normal(np.zeros(3), motion.covariance, method="svd")
        truth = moved(moved(truth, motion.mean), noise)
        measurements = []
        for k in range(3):
            z = observed(truth, k)
            sigma = np.array([np.hypot(0.1, 0.001 * z[0]), 0.002])
            measurements.append((k, z + sigma * rng.standard_normal(2)))
        motions.append(motion)
        keyframes.append(measurements)
    return motions, keyframes


def filtered(motions, keyframes, count, proposal, resample_below=0.5, seed=0):
    rng = np.random.default_rng(seed)
    particles, log_evidence, infos = fastslam.at_poses(np.zeros((count, 3))), 0.0, []
    for motion, measurements in zip(motions, keyframes, strict=True):
        z = np.array([measurement for _, measurement in measurements])
        ids = IDS[[k for k, _ in measurements]]
        keyframe = Keyframe(increment=motion, ids=ids, ranges=z[:, 0], bearings=z[:, 1])
        particles, info = fastslam_step(
            particles, keyframe, SENSOR, rng, proposal=proposal, resample_below=resample_below
        )
        log_evidence += info.log_evidence
        infos.append(info)
    return particles, log_evidence, infos


@pytest.mark.parametrize(("proposal", "count"), [("fastslam2", 5000), ("fastslam1", 20000)])
@pytest.mark.parametrize("factor", [np.linalg.cholesky(MOTION.covariance), RANK_TWO])
def test_a_nearly_linear_problem_gets_the_posterior_of_the_kalman_filter(proposal, count, factor):
    motions, keyframes = simulated(1, covariance=factor @ factor.T)
    mean, P, log_evidence = kalman(motions, keyframes)
    particles, found_evidence, _ = filtered(motions, keyframes, count, proposal)
    np.testing.assert_array_equal(particles.ids, IDS)
    found, spread = moments(
        particles.poses, np.exp(particles.log_weights), particles.means, particles.covariances, 1.0
    )
    sigma = np.sqrt(np.diag(P))
    error = found - mean
    error[2] = wrap(error[2])
    effective = core.effective_sample_size(particles.log_weights)
    assert effective > 0.05 * count
    assert np.abs(error / sigma).max() < 5.0 / np.sqrt(0.2 * effective)
    assert np.abs((spread - P) / np.outer(sigma, sigma)).max() < 0.12
    assert abs(found_evidence - log_evidence) < 0.2


def test_from_equal_particles_the_second_proposal_leaves_equal_weights():
    # The proposal is then the exact posterior of the motion, and p(z) is the same for all.
    count, rng = 400, np.random.default_rng(8)
    block = np.array([0.04, 0.03, 0.05])
    known = fastslam.Particles(
        np.zeros((count, 3)),
        np.full(count, -np.log(count)),
        IDS,
        np.tile(LANDMARKS, (count, 1, 1)),
        np.tile(block, (count, 3, 1)),
    )
    root = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.003, -0.004, 0.006]])
    truth = moved(np.concatenate((np.zeros(3), LANDMARKS.ravel())), MOTION.mean)
    shift = np.array([[0.1, -0.2], [0.1, 0.2], [-0.2, 0.1]])
    z = np.array([observed(truth, k) for k in range(3)]) + shift * [1.0, 0.01]
    motion = Increment(MOTION.mean, root @ root.T)
    keyframe = Keyframe(increment=motion, ids=IDS, ranges=z[:, 0], bearings=z[:, 1])
    after, info = fastslam_step(known, keyframe, SENSOR, rng)
    assert info.effective_sample_size > (1.0 - 3e-5) * count
    assert np.std(after.poses[:, 2]) < 0.5 * np.linalg.norm(root[2])


weights = st.lists(st.floats(-30.0, 0.0), min_size=1, max_size=12).map(
    lambda values: core.normalise(np.array(values))[0]
)


@quick
@given(weights)
def test_resampling_is_unbiased_and_never_off_by_one_copy(log_weights):
    expected = len(log_weights) * np.exp(log_weights)
    counts = np.array(
        [
            np.bincount(core.systematic_parents(log_weights, u), minlength=len(log_weights))
            for u in (np.arange(500) + 0.5) / 500
        ]
    )
    assert (np.abs(counts - expected) < 1.0 + 1e-9).all()
    np.testing.assert_allclose(counts.mean(axis=0), expected, atol=0.005)


def factor_of_motion(covariance):
    """L of three particles at zero that move by Exp(L n), n short along each axis."""
    small = 1e-30
    window = core.Window(3, (0.01, 0.0, 1.0, 1e-3, 1.0))
    window.step(Increment(np.zeros(3), covariance).keyframe(), small * np.eye(3))
    return window.particles()[0].T / small


@quick
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=9, max_size=9), st.integers(0, 3), st.floats(1e-6, 1e3)
)
@example([3.6e-165, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0], 1, 610.0)
def test_a_covariance_of_any_rank_is_the_product_of_its_factor(entries, rank, scale):
    half = scale * np.array(entries).reshape(3, 3)[:, :rank]
    covariance = half @ half.T
    L = factor_of_motion(covariance)
    assert (np.abs(np.triu(L, 1)) < 1e-20).all()
    deviation = np.sqrt(np.diag(covariance))
    assert (np.abs(L @ L.T - covariance) <= 5e-5 * np.outer(deviation, deviation) + 1e-12).all()


def test_a_particle_s_step_depends_neither_on_its_place_nor_on_the_others():
    """Blocks of 16: 37 particles in two orders, and one of them alone."""
    rng = np.random.default_rng(3)
    starts, normals = rng.normal(0.0, 0.1, (37, 3)), rng.normal(0.0, 1.0, (37, 3))
    means = np.array([[4.0, 1.0], [2.0, -3.0]]) + rng.normal(0.0, 0.1, (37, 2, 2))
    spread = np.tile([0.05, 0.01, 0.04], (37, 2, 1))
    seen = np.array([4, 9, 9], np.uint32), np.array([4.1, 3.5, 3.6]), np.array([0.2, -1.0, -0.9])
    noise = Noise(0.01, 0.0, 1.0, 1e-3, 1.0)

    def stepped(order):
        known = np.array([4], np.uint32), means[order, :1], spread[order, :1]
        weights = np.full(len(order), -np.log(len(order)))
        window = core.Window.of_particles(starts[order], weights, *known, noise)
        log_sum = window.step(MOTION.keyframe(core.Scan(*seen)), normals[order])
        poses, logs, _, placed, spread_after = window.particles()
        return poses, placed, spread_after, logs + log_sum + np.log(len(order))

    whole = stepped(np.arange(37))
    for order in (rng.permutation(37), np.array([36]), np.arange(20, 37)):
        *after, weights = stepped(order)
        for each, reference in zip(after, whole[:-1], strict=True):
            np.testing.assert_array_equal(each, reference[order])
        np.testing.assert_allclose(weights, whole[-1][order], rtol=0.0, atol=1e-12)
