from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation.consistency import nees
from teamslam.team.estimation.inter_robot import (
    CarriedPoint,
    carry_back,
    carry_on,
    point_seen,
    reduced,
)
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import solve_fold
from teamslam.team.estimation.map_joining.marginals import joint_cost, landmark_map, trajectory
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import compose, exponential, inverse, transformed
from tests.estimation.sighting_world import joined_with, meeting
from tests.estimation.submap_world import seen_from, wrap

EXACTLY = JoinSettings(step_tolerance=1e-11)
poses = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3.1, 3.1)).map(np.array)


def residual(observer, teammate, measurement, point=0.0):
    at = teammate[0] + 1j * teammate[1] + point * np.exp(1j * teammate[2])
    to = seen_from(observer, at)
    return np.array([measurement[0] - abs(to), wrap(measurement[1] - np.angle(to))])


def normal_equations(observer, teammate, measurement, point, information):
    """JᵀR⁻¹J, JᵀR⁻¹r and rᵀR⁻¹r of the graph of one inter-robot measurement."""
    carried = np.array([point.real, point.imag])
    one = [(0, 1, measurement, information, carried)]
    offset, fixed = np.array([0, 3, 6]), np.array([False, False])
    graph = core.SubmapGraph(offset, fixed, [], one, [], None)
    state, none = np.concatenate([observer, teammate]), np.empty(0)
    wide = np.array([1e6])
    at = core.Estimate(graph, state, none, wide, False, 1.0, 1.0, 1.0, False)
    values, gradient = at.normal_equations
    rows = [[graph.pattern.block(values, i, j) for j in (0, 1)] for i in (0, 1)]
    return np.block(rows), gradient, at.sighting_chi2[0]


@settings(deadline=None, max_examples=60)
@given(poses, poses, st.floats(0.1, 30.0), st.floats(-3.1, 3.1), st.sampled_from([0.0, 1.5 - 0.4j]))
def test_the_jacobian_of_a_sighting_is_what_central_differences_say(a, b, distance, bearing, point):
    if np.hypot(*(b - a)[:2]) < 0.1 + 2.0 * abs(point):
        return
    measurement = np.array([distance, bearing])
    r, jacobian = residual(a, b, measurement, point), np.empty((2, 6))
    if abs(r[1]) > 3.14:  # of either sign
        return
    h = 1e-6
    both = np.concatenate([a, b])
    for k, shift in enumerate(h * np.eye(6)):
        up, down = (
            residual((both + s)[:3], (both + s)[3:], measurement, point) for s in (shift, -shift)
        )
        difference = np.array([(up - down)[0], wrap((up - down)[1])]) / (2.0 * h)
        jacobian[:, k] = difference
    for row, of in enumerate(("range", "bearing")):
        found = normal_equations(a, b, measurement, point, np.diag(np.eye(2)[row]))
        J = jacobian[row]
        for value, expected in zip(found, (np.outer(J, J), r[row] * J, r[row] ** 2), strict=True):
            np.testing.assert_allclose(value, expected, rtol=1e-3, atol=1e-3, err_msg=of)


# --- redundancy ---


def test_sightings_shrink_the_trajectories_covariance_and_their_redundancy_counts():
    world = meeting(5, robots=3)
    plain, seen = (
        solve_fold(joined_with(world.submaps, world.starts, s, EXACTLY), EXACTLY)
        for s in ([], world.sightings)
    )
    for robot in ("r0", "r1", "r2"):
        before, after = (trajectory(fold, robot, 0).covariances[-1] for fold in (plain, seen))
        assert np.linalg.eigvalsh(before - after).min() > 0.0
    agreement, graph = joint_cost(seen), seen.main.graph
    redundancy = graph.dimensions.sum() + 2 * len(world.sightings) - graph.unknowns
    assert agreement.dof == pytest.approx(redundancy)
    assert sum(chi2 for chi2, _ in agreement.robots.values()) == pytest.approx(agreement.chi2)


# --- the set decides ---


def test_the_fold_without_a_robot_does_not_know_that_it_was_seen():
    world = meeting(7, robots=3)
    submaps = [each for each in world.submaps if each.robot != "r2"]
    starts = world.starts[:2]
    of_others = [s for s in world.sightings if "r2" not in (s.robot, s.teammate)]
    by_others = [s for s in world.sightings if s.robot != "r2"]
    options = JoinSettings()
    without, withdrawn = (
        solve_fold(joined_with(submaps, starts, each, options), options)
        for each in (of_others, by_others)
    )
    assert without.main.state.tobytes() == withdrawn.main.state.tobytes()
    for one, other in zip(landmark_map(without), landmark_map(withdrawn), strict=True):
        assert one.tobytes() == other.tobytes()


def test_one_outlier_among_sightings_does_not_bend_the_robust_map():
    world = meeting(8, robots=3)
    options = JoinSettings()
    wrong = replace(world.sightings[4], measurement=np.array([25.0, 2.0]))
    clean, spoilt = (
        landmark_map(solve_fold(joined_with(world.submaps, world.starts, s, options), options))
        for s in (world.sightings, [*world.sightings[:4], wrong, *world.sightings[5:]])
    )
    sigma = np.sqrt(np.diag(clean.covariance)).reshape(-1, 2)
    assert (np.abs(clean.means - spoilt.means) < 0.5 * sigma).all()


# --- free islands ---


def strangers(seed, count):
    """Two robots without a common landmark; r1's start is unknown; the first sightings of each."""
    world = meeting(seed, submaps=6)
    submaps = [
        each
        if each.robot == "r0"
        else replace(each, local=replace(each.local, ids=each.local.ids + 100))
        for each in world.submaps
    ]
    return submaps, world.starts[:1], world.sightings[:count], world


def test_two_islands_without_a_common_landmark_are_joined_by_a_sighting_and_its_reverse():
    for seed in range(4):
        submaps, starts, sightings, world = strangers(seed, 2)
        assert {s.robot for s in sightings} == {"r0", "r1"}
        fold = solve_fold(joined_with(submaps, starts, sightings, EXACTLY), EXACTLY)
        assert fold.reasons == {}
        assert fold.waiting == ()
        found = landmark_map(fold)
        truth = world.landmarks[found.ids % 100]
        assert nees((found.means - truth).ravel(), found.covariance) < 3.0 * found.means.size
        assert {stream[0] for stream in fold.main.graph.streams} == {"r0", "r1"}


def test_one_sighting_does_not_join_two_islands_and_the_fold_says_why():
    submaps, starts, sightings, _ = strangers(0, 1)
    fold = solve_fold(joined_with(submaps, starts, sightings, EXACTLY), EXACTLY)
    assert fold.reasons == {
        ("r1", 0): "r1 (incarnation 0) not joined: 0 shared landmarks and 1 sighting, 2 needed"
    }


def test_sightings_that_contradict_each_other_join_nothing():
    submaps, starts, sightings, _ = strangers(1, 6)
    turned = [
        replace(s, measurement=np.array([s.measurement[0], wrap(s.measurement[1] + 0.9 * k)]))
        for k, s in enumerate(sightings)
    ]
    fold = solve_fold(joined_with(submaps, starts, turned, EXACTLY), EXACTLY)
    (reason,) = fold.reasons.values()
    assert "0 shared landmarks and 6 sightings disagree" in reason


def test_islands_with_sightings_become_the_same_map_as_with_known_starts():
    submaps, _, sightings, world = strangers(2, 12)
    free = solve_fold(joined_with(submaps, world.starts[:1], sightings, EXACTLY), EXACTLY)
    vague = [world.starts[0], replace(world.starts[1], covariance=1e6 * np.eye(3))]
    known = solve_fold(joined_with(submaps, vague, sightings, EXACTLY), EXACTLY)
    np.testing.assert_allclose(landmark_map(free).means, landmark_map(known).means, atol=1e-3)


# --- carrying a sighting to its node ---

MOTION = Increment(np.array([0.4, 0.1, 0.3]), np.diag([0.02, 0.01, 0.015]) ** 2)


@pytest.mark.parametrize("back", [True, False])
def test_a_carried_point_has_the_mean_and_covariance_of_samples(back):
    rng = np.random.default_rng(1)
    sensor = Sensor(range_sigma=0.05, bearing_sigma=0.02, marker_sigma=0.03)
    seen = point_seen(sensor, 2.5, 0.8, 0.04)
    carried = (carry_back if back else carry_on)(seen, MOTION)
    samples = []
    for _ in range(20_000):
        xi = np.sqrt(np.diag(MOTION.covariance)) * rng.normal(size=3)
        moved = compose(MOTION.mean, exponential(xi))
        distance, bearing = 2.5 + 0.05 * rng.normal(), 0.8 + 0.02 * rng.normal()
        point = distance * np.exp(1j * bearing) + 0.05 * (rng.normal() + 1j * rng.normal())
        to = moved if back else inverse(moved)
        samples.append(transformed(to, np.array([point.real, point.imag])))
    np.testing.assert_allclose(carried.point, np.mean(samples, axis=0), atol=2e-3)
    spread = np.cov(np.array(samples).T)
    np.testing.assert_allclose(carried.covariance, spread, atol=0.06 * np.trace(spread))


@settings(deadline=None, max_examples=40)
@given(st.floats(0.2, 20.0), st.floats(-3.14, 3.14), st.floats(0.0, 0.3))
def test_looks_about_one_direction_reduce_to_their_middle_on_the_circle(distance, bearing, spread):
    looks = [
        CarriedPoint(
            np.array([np.cos(bearing + a), np.sin(bearing + a)]) * (distance + a), 0.01 * np.eye(2)
        )
        for a in (-spread, 0.0, spread)
    ]
    looks = [look for look in looks if np.hypot(*look.point) > 0.0]
    measurement, covariance = reduced(looks)
    if distance > spread:
        assert measurement[0] == pytest.approx(distance)
        assert wrap(measurement[1] - bearing) == pytest.approx(0.0, abs=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
