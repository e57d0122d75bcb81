"""A window becomes one Gaussian: against batch least squares, in edge cases, over many runs.

Truth and measurements are made without the filter's models.
"""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares

from teamslam.team.config import FrontEnd, MotionModel, MotionNoise, Sensor
from teamslam.team.core import POSE_JITTER, moments, sample_factor
from teamslam.team.estimation.consistency import nees
from teamslam.team.estimation.gaussian import cholesky_factor
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.window import random_numbers
from teamslam.team.estimation.models import Increment, increment_of
from tests.estimation.submap_world import wrap
from tests.support import state_error

STEP_M, STEP_RAD = 0.05, np.deg2rad(3.0)
ROBOT = MotionModel(
    kind="turn-then-drive", forward=MotionNoise(per_s=STEP_M), turn=MotionNoise(per_s=STEP_RAD)
)
ACCURATE = Sensor(range_sigma=0.2, bearing_sigma=np.deg2rad(2.0))
COARSE = Sensor(range_sigma=2.0, bearing_sigma=np.deg2rad(10.0))
NOTHING = (np.empty(0, np.uint32), np.empty(0), np.empty(0))


@dataclasses.dataclass
class Drive:
    motions: list
    keyframes: list
    truth: np.ndarray
    landmarks: np.ndarray


def drive(seed, sensor, steps=12, noise=1.0):
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(-40.0, 40.0, (18, 2))
    pose, motions, keyframes = np.zeros(3), [], []
    for _ in range(steps):
        distance, turn = 0.98, rng.uniform(-0.15, 0.15)
        motions.append((distance, turn))
        distance += noise * STEP_M * rng.standard_normal()
        heading = pose[2] + turn + noise * STEP_RAD * rng.standard_normal()
        x, y = pose[:2] + distance * np.array([np.cos(heading), np.sin(heading)])
        pose = np.array([x, y, wrap(heading)])
        offset = landmarks - pose[:2]
        ranges = np.hypot(offset[:, 0], offset[:, 1])
        bearings = np.arctan2(offset[:, 1], offset[:, 0]) - heading
        seen = np.flatnonzero((ranges > 3.0) & (ranges < 20.0))
        ranges = ranges[seen] + sensor.range_sigma * rng.standard_normal(len(seen))
        bearings = wrap(bearings[seen] + sensor.bearing_sigma * rng.standard_normal(len(seen)))
        keyframes.append((seen.astype(np.uint32), ranges, bearings))
    return Drive(motions, keyframes, pose, landmarks)


def driven(run, sensor, particles=100, seed=0, motion=ROBOT, twice=False, **front_end):
    front_end = FrontEnd(particles=particles, **front_end)
    window, random = windows.open_window(front_end, sensor), random_numbers(seed, "r1", 0, 0)
    for (distance, turn), keyframe in zip(run.motions, run.keyframes, strict=True):
        measurements = tuple(np.repeat(part, 2) for part in keyframe) if twice else keyframe
        windows.advance(window, increment_of(motion, 1.0, distance, turn), *measurements, random)
    return window


def move(window, motion, seed):
    random = random_numbers(seed, "a", 0, 0)
    window.core.move(motion.keyframe(), random)


def bytes_of(window):
    values = [window.paths, *window.core.measurements()[:3]]
    values += [getattr(window.particles, f.name) for f in dataclasses.fields(window.particles)]
    return [value.tobytes() for value in values]


def batch(run, sensor, ids):
    """MAP over (noise of every step, landmarks) by scipy's least squares.

    Mean and Laplace covariance of (end pose, landmarks in the order of ids).
    """
    steps = len(run.motions)

    def path(noise):
        pose, poses = np.zeros(3), []
        for (distance, turn), (far, aside) in zip(run.motions, noise.reshape(-1, 2), strict=True):
            heading = pose[2] + turn + STEP_RAD * aside
            reach = distance + STEP_M * far
            pose = np.array(
                [pose[0] + reach * np.cos(heading), pose[1] + reach * np.sin(heading), heading]
            )
            poses.append(pose)
        return poses

    def residuals(unknowns):
        landmarks = unknowns[2 * steps :].reshape(-1, 2)
        parts = [unknowns[: 2 * steps]]
        for pose, (seen, ranges, bearings) in zip(
            path(unknowns[: 2 * steps]), run.keyframes, strict=True
        ):
            offset = landmarks[np.searchsorted(ids, seen)] - pose[:2]
            parts.append((ranges - np.hypot(offset[:, 0], offset[:, 1])) / sensor.range_sigma)
            predicted = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
            parts.append(wrap(bearings - predicted) / sensor.bearing_sigma)
        return np.concatenate(parts)

    def reported(unknowns):
        return np.concatenate((path(unknowns[: 2 * steps])[-1], unknowns[2 * steps :]))

    start = np.concatenate((np.zeros(2 * steps), run.landmarks[ids].ravel()))
    found = least_squares(residuals, start, method="lm", xtol=1e-12)
    J = np.stack(
        [(reported(found.x + h) - reported(found.x - h)) / 2e-6 for h in 1e-6 * np.eye(len(start))],
        axis=1,
    )
    return reported(found.x), J @ np.linalg.solve(found.jac.T @ found.jac, J.T)


def test_a_window_agrees_with_batch_least_squares_over_the_same_measurements():
    sensor = Sensor(range_sigma=0.1, bearing_sigma=0.01)
    run = drive(11, sensor, steps=8)
    local = windows.gaussian(driven(run, sensor, particles=4000))
    mean, P = batch(run, sensor, local.ids)
    sigma = np.sqrt(np.diag(P))
    assert np.abs(state_error(local.mean, mean) / sigma).max() < 0.25
    correlation = (local.covariance - P) / np.outer(sigma, sigma)
    assert np.abs(correlation).max() < 0.25


def test_solving_the_landmarks_again_takes_out_the_bias_of_the_first_measurement():
    with_ekf, again = [], []
    for seed in range(300):
        run = drive(seed, COARSE)
        window = driven(run, COARSE, 100, seed)
        local = windows.gaussian(window)
        truth = np.concatenate((run.truth, run.landmarks[local.ids].ravel()))
        order, particles = np.argsort(window.particles.ids), window.particles
        mean, P = moments(
            particles.poses,
            np.exp(particles.log_weights),
            np.ascontiguousarray(particles.means[:, order]),
            np.ascontiguousarray(particles.covariances[:, order]),
            1.0,
        )
        P[np.arange(3), np.arange(3)] += POSE_JITTER
        with_ekf.append(nees(state_error(mean, truth), P))
        again.append(nees(state_error(local.mean, truth), local.covariance))
    assert np.mean(again) < 0.98 * np.mean(with_ekf)


def test_the_same_window_gives_the_same_bytes_and_nothing_changes_it():
    run = drive(5, ACCURATE)
    window = driven(run, ACCURATE, seed=9)
    kept = bytes_of(window)
    once, twice = windows.gaussian(window), windows.gaussian(window)
    windows.of_base(window)
    assert bytes_of(window) == kept == bytes_of(driven(run, ACCURATE, seed=9))
    assert once.mean.tobytes() == twice.mean.tobytes()
    assert once.covariance.tobytes() == twice.covariance.tobytes()
    assert bytes_of(driven(run, ACCURATE, seed=10)) != kept


STANDING = Increment.identity()
GAP = Increment(np.array([3.0, 0.0, 1.0]), np.diag([400.0, 100.0, 25.0]))
SIGHT = (np.array([4], np.uint32), np.array([8.0]), np.array([0.5]))
FAR = (np.array([4, 9], np.uint32), np.array([1e6, 5.0]), np.array([3.1, -3.1]))
ELSEWHERE = (np.array([4], np.uint32), np.array([25.0]), np.array([-2.6]))
UNDERFOOT = (np.array([4], np.uint32), np.array([1e-9]), np.array([2.0]))
DRIVEN = (1.0, 0.1)
"""A metre and a turn of a tenth [rad] in one second: no increment at import, it takes a kernel."""


def increment(motion):
    return motion if isinstance(motion, Increment) else increment_of(ROBOT, 1.0, *motion)


CASES = {
    "nothing at all": [],
    "standing without a measurement": [(STANDING, NOTHING)],
    "moving without a measurement": [(DRIVEN, NOTHING)] * 5,
    "one measurement from the start": [(STANDING, SIGHT)],
    "one measurement after motion": [(DRIVEN, SIGHT)],
    "standing before one landmark": [(STANDING, SIGHT)] * 8,
    "a gap": [(GAP, NOTHING)],
    "a gap and a measurement": [(GAP, SIGHT)],
    "a measurement, a gap and the measurement": [(DRIVEN, SIGHT), (GAP, SIGHT), (DRIVEN, SIGHT)],
    "a very far landmark": [(DRIVEN, FAR), (DRIVEN, FAR)],
    "a landmark that jumps": [(DRIVEN, SIGHT), (DRIVEN, ELSEWHERE), (STANDING, ELSEWHERE)],
    "a landmark underfoot": [(DRIVEN, UNDERFOOT), (STANDING, UNDERFOOT), (DRIVEN, SIGHT)],
}


@pytest.mark.parametrize("particles", [4, 100])
@pytest.mark.parametrize("case", CASES)
def test_an_odd_window_still_becomes_a_covariance(case, particles):
    random = random_numbers(2, "a", 0, 0)
    window = windows.open_window(FrontEnd(particles=particles), ACCURATE)
    for motion, keyframe in CASES[case]:
        windows.advance(window, increment(motion), *keyframe, random)
    local = windows.gaussian(window)
    assert np.isfinite(local.mean).all()
    cholesky_factor(local.covariance, case)
    np.testing.assert_array_equal(local.covariance, local.covariance.T)
    assert len(local.mean) == 3 + 2 * len({i for _, (ids, _, _) in CASES[case] for i in ids})


def test_the_information_of_few_particles_is_right_on_average_and_that_of_their_scatter_is_not():
    """E[P⁻¹] = Q⁻¹ over many windows; of the bare scatter it is N/(N − 5) = 4/3 of it."""
    count, runs, sigmas = 20, 600, np.array([0.1, 0.05, 1e-3])
    motion = Increment(np.array([1.0, 0.0, 0.0]), np.diag(np.square(sigmas)))
    information = {"window": 0.0, "scatter": 0.0}
    for seed in range(runs):
        window = windows.open_window(FrontEnd(particles=count), ACCURATE)
        move(window, motion, seed)
        P = windows.gaussian(window).covariance - np.diag(POSE_JITTER)
        scatter = np.cov((window.particles.poses / sigmas).T, bias=True)
        np.testing.assert_allclose(P / np.outer(sigmas, sigmas), 4.0 / 3.0 * scatter, atol=4e-3)
        for name, each in (("window", P / np.outer(sigmas, sigmas)), ("scatter", scatter)):
            information[name] += np.trace(np.linalg.inv(each)) / 3 / runs
    # The mean of 600 has a sigma of 1.5 %.
    assert 0.95 < information["window"] < 1.05
    assert information["scatter"] > 1.25


def test_a_pose_after_an_uncertain_turn_is_that_of_the_odometry_and_no_mean_of_coordinates():
    """A turn with a sigma of 0.4 rad bends the particles about the start, 10 m away."""
    step = increment_of(MotionModel(kind="turn-then-drive", turn=MotionNoise(0.4)), 1.0, 10.0, 0.0)
    window = windows.open_window(FrontEnd(particles=4000), ACCURATE)
    move(window, step, 2)
    local, alone = windows.gaussian(window), windows.motion_alone(step)
    x = window.particles.poses[:, 0]
    assert x.mean() < 10.0 - 0.9 * (0.5 * 10.0 * 0.4**2)
    assert x.var() > 1.0
    np.testing.assert_allclose(local.mean[:2], 10.0 * np.cos([0.0, np.pi / 2.0]), atol=0.1)
    assert abs(local.mean[0] - 10.0) < 1e-3
    assert local.covariance[0, 0] < 1e-3
    np.testing.assert_allclose(local.covariance[1:3, 1:3], alone.covariance[1:, 1:], rtol=0.1)


@pytest.mark.parametrize(
    ("weights", "factor"),
    [([0.1, 0.1] + [0.05] * 16, 1.0 / (1.0 - 5.0 * 0.06)), ([0.1] * 10, 2.0), ([1.0], 2.0)],
    ids=["unequal ones count for fewer", "ten", "one"],
)
def test_the_scatter_of_few_or_unequal_particles_is_taken_times_at_most_two(weights, factor):
    assert sample_factor(np.array(weights)) == pytest.approx(factor)
