from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import core
from teamslam.team.config import BIASES, FrontEnd, MotionModel, MotionNoise, Sensor
from teamslam.team.estimation import se2
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.window import random_numbers
from teamslam.team.estimation.map_joining import joining, marginals
from teamslam.team.estimation.map_joining.joining import (
    JoinSettings,
    add_start,
    fold_submaps,
    solve_fold,
)
from teamslam.team.estimation.models import increment_of, noise_of
from tests.core.test_odometry import shift_of
from tests.estimation.submap_world import local_truth, team, wrap

SIGMA = {
    "bearing": 0.01,
    "clock_offset": 0.01,
    "forward_scale": 0.05,
    "range_offset": 0.02,
    "range_scale": 0.01,
}
MOTION = MotionModel(
    "turn-then-drive", MotionNoise(per_s=0.02), MotionNoise(per_s=0.01), calibrated_speed=(0.0, 0.1)
)


# --- the columns of a window ---


def window_of(bearing, clock_offset, forward_scale, range_offset, range_scale, white=1.0):
    sensor = Sensor(range_sigma=0.05, bearing_sigma=0.01, range_white=white, bearing_white=white)
    front = FrontEnd(particles=1600, resample_below=0.0, biases=BIASES)
    window, random = windows.open_window(front, sensor), random_numbers(1, "r1", 0, 0)
    landmarks = np.array([[4, 3], [6, -3], [9, 2], [3, -4], [11, -2], [8, 6]], dtype=float)
    pose = np.zeros(3)
    for _ in range(8):
        pose = se2.compose(pose, increment_of(MOTION, 1.0, 1.0, 0.1).mean)
        earlier = increment_of(MOTION, -clock_offset, 1.0, 0.1).mean
        there = se2.compose(pose, earlier)
        offset = landmarks - there[:2]
        ranges = np.hypot(*offset.T)
        seen = np.flatnonzero(np.hypot(*(landmarks - pose[:2]).T) < 8.0)
        bearings = wrap(np.arctan2(*offset.T[::-1]) - there[2])[seen]
        windows.advance(
            window,
            increment_of(MOTION, 1.0, 1.0 / (1.0 + forward_scale), 0.1),
            seen.astype(np.uint32),
            ranges[seen] * (1.0 + range_scale) + range_offset,
            bearings + bearing,
            random,
            shift_of(MOTION, (1.0, 1.0, 0.1)).tolist(),
        )
    return windows.gaussian(window)


@pytest.mark.parametrize("white", [1.0, 0.3])
@pytest.mark.parametrize(
    ("bias", "size"),
    [
        ("bearing", 4e-3),
        ("clock_offset", 0.02),
        ("range_offset", 0.02),
        ("range_scale", 4e-3),
        ("forward_scale", 1e-2),
    ],
)
def test_a_column_is_how_the_particles_mean_answers_an_error_in_the_measurements(bias, size, white):
    errors = dict.fromkeys(BIASES, 0.0)
    up, down = (window_of(**(errors | {bias: sign * size}), white=white) for sign in (1.0, -1.0))
    row = window_of(**errors, white=white).sensitivity[BIASES.index(bias)]
    answered = -(up.mean - down.mean) / (2.0 * size)
    assert np.abs(answered - row).max() < 0.15 * np.abs(row).max()


def test_the_clocks_derivative_changes_as_the_curvature_states():
    """The true landmark places less those by a late clock are S b + ½ D b²."""
    late, errors = 0.8, dict.fromkeys(BIASES, 0.0)
    true, off = window_of(**errors), window_of(**(errors | {"clock_offset": late}))
    clock = BIASES.index("clock_offset")
    linear = off.mean + late * off.sensitivity[clock]
    bent = linear + 0.5 * late**2 * off.curvature[clock]
    spread = [np.ptp((each - true.mean)[3:].reshape(-1, 2), axis=0) for each in (linear, bent)]
    assert (spread[1] < 0.4 * spread[0]).all()
    assert not np.delete(off.curvature, clock, axis=0).any()


def some_window(seed, sensor, mark=(), mount=(0.0, 0.0, 0.0)):
    rng, random = np.random.default_rng(seed), random_numbers(seed, "r1", 0, 0)
    window = core.Window(5, noise_of(sensor), mount=mount)
    motions = []
    for k in range(6):
        step = increment_of(MOTION, 1.0, rng.uniform(0.5, 2.0), rng.normal(0.0, 0.3))
        ids = rng.choice(np.array([3, 9, 4], np.uint32), 0 if k == 2 else 2, replace=False)
        ranges, bearings = rng.uniform(2.0, 9.0, len(ids)), rng.uniform(-3.0, 3.0, len(ids))
        own = np.empty((len(ids), 0))
        if k == 3:
            own = np.array([[0.05, 0.006, 0.002, 0.0], [0.0, 0.0, 0.0, -1.0]])
        shift = np.append(rng.normal(size=3), rng.uniform(0.2, 1.0))
        window.advance(step.keyframe(core.Scan(ids, ranges, bearings, own), shift.tolist()), random)
        motions.append((step.covariance, shift))
        if k in mark:
            window.mark(k)
    return window, motions


def stated(window, motions, points):
    """The smoother's response to each bias: dense, Jacobians by differences.

    Residuals are Log(motion⁻¹ ∘ x_{k−1}⁻¹ ∘ x_k) − shift b and h(x, landmark) + g b.
    """
    path, (keyframes, seen, _, own) = window.mean_path(), window.measurements()
    ids = np.sort(window.ids())
    steps = [se2.between(a, b) for a, b in zip([np.zeros(3), *path], path, strict=False)]
    white = noise_of(SMOOTHED)
    K, W, biased = len(path), [], []
    for covariance, shift in motions:
        W.append(np.linalg.inv(covariance + np.diag([1e-7, 1e-7, 1e-9])))
        biased.append([[0.0, 0.0, -each, 0.0, 0.0] for each in shift[:3]])
    for k, landmark, claim in zip(keyframes, seen, own, strict=True):
        slot = np.searchsorted(ids, landmark)
        distance = np.hypot(*(points[slot] - path[k][:2]))
        variance = white.range_variance + white.range_per_m2 * distance**2
        R = np.diag([variance, white.bearing_variance])
        if claim[3] >= 0.0:
            R = np.array([[claim[0], claim[1]], [claim[1], claim[2]]])
        W.append(np.linalg.inv(R))
        late = measured_later(path, [each[3] for _, each in motions], k, points[slot])
        biased.append([[0.0, late[0], 0.0, 1.0, distance], [1.0, late[1], 0.0, 0.0, 0.0]])

    def residuals(x):
        poses = [se2.compose(p, se2.exponential(x[3 * k : 3 * k + 3])) for k, p in enumerate(path)]
        found = [
            se2.logarithm(se2.between(step, se2.between(a, b)))
            for step, a, b in zip(steps, [np.zeros(3), *poses], poses, strict=False)
        ]
        for k, landmark in zip(keyframes, seen, strict=True):
            slot = np.searchsorted(ids, landmark)
            d = points[slot] + x[3 * K + 2 * slot :][:2] - poses[k][:2]
            at = points[slot] - path[k][:2]  # the bearing change, without a jump
            turn = np.angle(complex(*d) / complex(*at))
            found.append(np.array([np.hypot(*d), turn - x[3 * k + 2]]))
        return np.concatenate(found)

    n = 3 * K + 2 * len(ids)
    J = np.array([(residuals(d) - residuals(-d)) / 2e-6 for d in 1e-6 * np.eye(n)]).T
    weights = np.zeros((len(J), len(J)))
    at = 0
    for block in W:
        weights[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return -np.linalg.solve(J.T @ weights @ J, J.T @ weights @ np.vstack(biased))


def measured_later(path, seconds, k, point):
    """∂(range, bearing)/∂(delay of the stamp), by differences over ± 0.25 s about keyframe k."""
    ends, times = [np.zeros(3), *path], np.append(0.0, np.cumsum(seconds))
    first = max(j for j in range(k + 1) if j == 0 or times[k + 1] - times[j] >= 0.25)
    last = min(
        j for j in range(k + 1, len(ends)) if j == len(path) or times[j] - times[k + 1] >= 0.25
    )
    step = se2.logarithm(se2.between(ends[first], ends[last])) / (times[last] - times[first])

    def seen(delay):
        d = se2.transformed(
            se2.inverse(se2.compose(path[k], se2.exponential(-delay * step))), point
        )
        return np.array([np.hypot(*d), np.arctan2(d[1], d[0])])

    change = seen(1e-6) - seen(-1e-6)
    return np.array([change[0], wrap(change[1])]) / 2e-6


SMOOTHED = Sensor(range_sigma=0.1, range_sigma_per_m=0.02, bearing_sigma=0.02)


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.8)])
@pytest.mark.parametrize("seed", range(3))
def test_the_rows_are_those_of_a_dense_smoother_whose_jacobians_are_differences(seed, mount):
    nodes, away = (1, 4), se2.inverse(np.array(mount))
    window, motions = some_window(seed, SMOOTHED, nodes, mount)
    mean = window.close()[1]
    rows, _, fault = window.sensitivity(mean, True)
    assert fault == 0
    points = np.array([se2.transformed(away, p) for p in mean[9:].reshape(-1, 2)])
    answer = stated(window, motions, points).T
    path, turn = window.mean_path(), se2.tangent(mount[2])[:2, :2]

    def of_base(pose):
        return se2.compose(se2.compose(np.array(mount), pose), away)

    for at, k in enumerate((len(path) - 1, *nodes)):
        for row, xi in zip(rows[:, 3 * at : 3 * at + 3], answer[:, 3 * k : 3 * k + 3], strict=True):
            up, down = (
                of_base(se2.compose(path[k], se2.exponential(h * xi))) for h in (1e-6, -1e-6)
            )
            np.testing.assert_allclose(row, wrap_pose(up - down) / 2e-6, rtol=1e-5, atol=1e-5)
    expected = answer[:, 18:].reshape(5, -1, 2) @ turn.T
    np.testing.assert_allclose(rows[:, 9:], expected.reshape(5, -1), rtol=1e-5, atol=1e-5)


def wrap_pose(difference):
    return np.array([*difference[:2], wrap(difference[2])])


@settings(deadline=None)
@given(
    st.floats(0.2, 2.0),
    st.floats(-1.0, 1.0),
    st.sampled_from(["velocity", "turn-then-drive"]),
    st.floats(-2.0, 2.0),
)
def test_a_shift_by_the_scale_of_speed_is_what_central_differences_of_two_motions_say(
    speed, rate, kind, more
):
    motion = msgspec.structs.replace(MOTION, kind=kind)

    def driven_with(scale):
        first = increment_of(motion, 0.5, scale * speed, rate).mean
        return se2.compose(first, increment_of(motion, 0.5, scale * speed, more).mean)

    h = 1e-6
    step = se2.between(driven_with(1.0 - h), driven_with(1.0 + h))
    column = shift_of(motion, (0.5, speed, rate), (0.5, speed, more))[:3]
    np.testing.assert_allclose(column, se2.logarithm(step) / (2 * h), atol=3e-2 * speed)


# --- the factor ---


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32), st.integers(0, 4), st.integers(0, 3))
def test_the_factor_with_biases_is_what_central_differences_say(seed, count, biases):
    rng = np.random.default_rng(seed)
    n = 3 + 2 * count
    state = rng.normal(0.0, 3.0, 6 + 2 * count + biases)
    mean, sensitivity = rng.normal(0.0, 3.0, n), rng.normal(size=(biases, n))
    curvature = 0.1 * rng.normal(size=(biases, n))
    root = rng.normal(size=(n, n)) + 3.0 * np.eye(n)
    information = root @ root.T

    def residual(x):
        points = x[6 : 6 + 2 * count].reshape(-1, 2)
        r = local_truth(x[:3], x[3:6], points) - mean
        b = x[6 + 2 * count :]
        r = r - b @ sensitivity - 0.5 * b**2 @ curvature
        r[2] = wrap(r[2])
        return r

    h = 1e-6
    steps = np.array([residual(state + d) - residual(state - d) for d in h * np.eye(len(state))])
    steps[:, 2] = wrap(steps[:, 2])
    jacobian = steps.T / (2 * h)
    at = np.array(
        [0, 3, *(6 + 2 * k for k in range(count)), *range(len(state) - biases, len(state))]
    )
    powers, points = np.zeros(biases, np.int64), np.zeros((count, 3))
    factor = core.SubmapFactor(mean, information, points, sensitivity, powers, curvature=curvature)
    hessian, gradient, chi2 = factor.normal(state, at)
    r = residual(state)
    tolerance = {"rtol": 1e-6, "atol": 1e-6 * np.abs(information).max() * 100}
    assert chi2 == pytest.approx(r @ information @ r)
    np.testing.assert_allclose(gradient, jacobian.T @ information @ r, **tolerance)
    np.testing.assert_allclose(hessian, jacobian.T @ information @ jacobian, **tolerance)


# --- the centre ---


def biased_team(seed):
    world = team(seed, robots=2, submaps=6, landmarks=5)
    rng = np.random.default_rng([seed, 7])
    errors = {robot: rng.normal(size=2) * (0.01, 0.01) for robot in world.paths}
    submaps = []
    for each in world.submaps:
        local = each.local
        rows = 20.0 * rng.normal(size=(2, len(local.mean)))
        rows[:, 2] *= 0.1
        mean = local.mean - errors[each.robot] @ rows
        mean[2] = wrap(mean[2])
        shifted = replace(local, mean=mean, biases=("bearing", "range_scale"), sensitivity=rows)
        submaps.append(replace(each, local=shifted))
    return world, submaps, errors


def fold_of(world, submaps, options, tick=4, full=solve_fold):
    fold = joining.EMPTY_FOLD
    for start in world.starts:
        fold = add_start(fold, start)
    for begin in range(0, len(submaps), tick):
        fold = fold_submaps(fold, submaps[begin : begin + tick], options)
    return full(fold, options)


def test_biases_stay_when_islands_merge():
    world, submaps, _ = biased_team(5)
    options = JoinSettings(bias_sigma=SIGMA)
    known = fold_of(world, submaps, options)
    world.starts = world.starts[:1]
    fold = fold_of(world, submaps, options)
    assert len(fold.islands) == 1
    assert [(b.stream, b.bias) for b in marginals.bias_estimates(fold)] == [
        (b.stream, b.bias) for b in marginals.bias_estimates(known)
    ]
    assert len(fold.main.graph.priors) == len(fold.main.graph.biases) == 4
    graph = fold.main.graph
    assert {graph.name(node) for node in graph.biases.values()} == {
        f"the bias {bias} of {robot} (incarnation 0)"
        for robot in ("r0", "r1")
        for bias in ("bearing", "range_scale")
    }
