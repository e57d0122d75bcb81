import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import least_squares

from teamslam.sim.studies.estimators import svd_joining
from teamslam.sim.studies.estimators.svd_joining import PointPairs, TooFewPointsError
from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.submap_world import local_truth, team, wrap

quick = settings(deadline=None, max_examples=30)


def joined(made, weighting):
    state = svd_joining.initial_state({start.robot: start.pose for start in made.starts}, weighting)
    for each in made.submaps:
        state = svd_joining.filter_step(state, each.robot, each.local)
    return svd_joining.solve(state)


def written_again(made):
    """Identity least squares by scipy: landmarks, last pose of each robot, σ̂² (JᵀJ)⁻¹."""
    robots = [start.robot for start in made.starts]
    ids = sorted({int(i) for each in made.submaps for i in each.local.ids})
    counts = {robot: sum(each.robot == robot for each in made.submaps) for robot in robots}
    first = dict(zip(robots, np.cumsum([0, *counts.values()])[:-1], strict=True))
    total = sum(counts.values())

    def residuals(x):
        ends, points = x[: 3 * total].reshape(-1, 3), x[3 * total :].reshape(-1, 2)
        parts = []
        for each in made.submaps:
            at = first[each.robot] + each.sequence
            start = made.starts[robots.index(each.robot)].pose
            start = ends[at - 1] if each.sequence else start
            seen = points[[ids.index(int(i)) for i in each.local.ids]]
            r = local_truth(start, ends[at], seen) - each.local.mean
            r[2] = wrap(r[2])
            parts.append(r)
        return np.concatenate(parts)

    guess = np.concatenate(
        [*(made.paths[robot] for robot in robots), made.landmarks[ids].reshape(-1)], axis=None
    )
    found = least_squares(residuals, guess, method="lm", xtol=1e-13, ftol=1e-13)
    ends = found.x[: 3 * total].reshape(-1, 3)
    last = {robot: ends[first[robot] + counts[robot] - 1] for robot in robots}
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    redundancy = len(found.fun) - len(found.x)
    return found.x[3 * total :].reshape(-1, 2), last, covariance * 2.0 * found.cost / redundancy


@pytest.mark.parametrize("robots", [1, 2, 3])
def test_the_identity_gives_the_least_squares_map_and_its_covariance(robots):
    made = team(robots, robots=robots, submaps=5, landmarks=5, reach=30.0)
    state = joined(made, "identity")
    points, last, covariance = written_again(made)
    landmarks = svd_joining.landmark_gaussian(state)
    np.testing.assert_allclose(landmarks.means, points, atol=1e-5)
    size = len(covariance) - points.size
    np.testing.assert_allclose(landmarks.covariance, covariance[size:, size:], rtol=1e-3, atol=1e-9)
    island = state.fold.main
    for robot, end in last.items():
        at = island.graph.offset[island.graph.streams[robot, 0][-1]]
        difference = island.state[at : at + 3] - end
        np.testing.assert_allclose([*difference[:2], wrap(difference[2])], 0.0, atol=1e-5)


def map_nees(weighting, honest, runs=80):
    """NEES and dof of the map over many teams; spherical submaps are drawn as weighted."""
    values = []
    for seed in range(runs):
        made = team(seed, robots=2, submaps=3, sigmas=(0.05, 0.05, 0.05))
        rng = np.random.default_rng(seed)
        state = svd_joining.initial_state(
            {start.robot: start.pose for start in made.starts}, weighting
        )
        for each in made.submaps:
            start = made.starts[int(each.robot[1])].pose
            start = made.paths[each.robot][each.sequence - 1] if each.sequence else start
            truth = local_truth(
                start, made.paths[each.robot][each.sequence], made.landmarks[each.local.ids]
            )
            noise = 0.05 * rng.standard_normal(len(truth))
            if not honest:
                noise[:2] += 4.0 * 0.05 * rng.standard_normal()
            local = LocalMap(each.local.ids, truth + noise, 0.05**2 * np.eye(len(truth)))
            state = svd_joining.filter_step(state, each.robot, local)
        landmarks = svd_joining.landmark_gaussian(svd_joining.solve(state))
        error = (landmarks.means - made.landmarks[landmarks.ids]).ravel()
        values.append((nees(error, landmarks.covariance), len(error)))
    total, dof = np.sum(values, axis=0)
    return total / dof, chi2_interval(int(dof), 0.999, 1)


def test_where_errors_are_spherical_the_map_is_consistent_and_where_they_are_not_it_is_not():
    ratio, (low, high) = map_nees("spherical", honest=True)
    assert low < ratio < high
    ratio, (low, high) = map_nees("spherical", honest=False, runs=40)
    assert not low < ratio < high


def two_maps(seed, sigma=0.1, common=4):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-10.0, 10.0, (common + 4, 2))
    a_from_b = np.array([*rng.uniform(-20.0, 20.0, 2), rng.uniform(-3.0, 3.0)])
    c, s = np.cos(a_from_b[2]), np.sin(a_from_b[2])
    in_b = (points - a_from_b[:2]) @ np.array([[c, -s], [s, c]])
    of_a, of_b = np.arange(common + 2), np.array([*range(common), common + 2, common + 3])
    maps = []
    for ids, truth in ((of_a, points), (of_b, in_b)):
        means = truth[ids] + sigma * rng.standard_normal((len(ids), 2))
        none = np.eye(2 * len(ids))
        maps.append(LandmarkGaussian(ids.astype(np.uint32) + 10, means, none))
    return maps, a_from_b, points


@quick
@given(st.integers(0, 10_000))
def test_turning_by_svd_and_taking_the_middle_is_the_minimum_of_the_whole_cost(seed):
    (a, b), _, _ = two_maps(seed, sigma=0.4)
    merged = svd_joining.exchange_maps(a, b)
    ids = merged.landmarks.ids
    of_a, of_b = np.searchsorted(ids, a.ids), np.searchsorted(ids, b.ids)

    def residuals(x):
        points, pose = x[3:].reshape(-1, 2), x[:3]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turned = b.means @ np.array([[c, s], [-s, c]]) + pose[:2]
        return np.concatenate((points[of_a] - a.means, points[of_b] - turned), axis=None)

    start = np.concatenate((merged.a_from_b.mean, merged.landmarks.means), axis=None)
    found = least_squares(residuals, start + 0.01, method="lm", xtol=1e-13, ftol=1e-13)
    np.testing.assert_allclose(found.x[3:], start[3:], atol=1e-5)
    np.testing.assert_allclose(found.x[:3], start[:3], atol=1e-5)
    redundancy = len(found.fun) - len(found.x)
    P = np.linalg.inv(found.jac.T @ found.jac) * 2.0 * found.cost / redundancy
    np.testing.assert_allclose(merged.landmarks.covariance, P[3:, 3:], rtol=1e-2, atol=1e-5)
    np.testing.assert_allclose(merged.a_from_b.covariance, P[:3, :3], rtol=1e-2, atol=1e-5)


def test_an_exchange_is_consistent_for_spherical_errors_and_not_if_landmarks_count_again():
    honest, twice, dof = [], [], 0
    for seed in range(80):
        (a, b), _, points = two_maps(seed, common=12)
        merged = svd_joining.exchange_maps(a, b).landmarks
        error = (merged.means - points).ravel()
        honest.append(nees(error, merged.covariance))
        # The mutant counts every common landmark six times, so the turn seems too well known.
        pairs = PointPairs(np.tile(a.means[:12], (5, 1)), np.tile(b.means[:12], (5, 1)))
        again = svd_joining.exchange_maps(a, b, pairs).landmarks
        twice.append(nees((again.means - points).ravel(), again.covariance))
        dof += len(error)
    low, high = chi2_interval(dof, 0.999, 1)
    # σ̂² has 21 degrees of freedom: E[1/σ̂²] = 21/19.
    assert low < np.sum(honest) / dof / (21.0 / 19.0) < high
    assert not low < np.sum(twice) / dof / (21.0 / 19.0) < high


def full_maps(seed, common=4, sigma=0.05):
    (a, b), a_from_b, points = two_maps(seed, sigma=0.0, common=common)
    rng = np.random.default_rng([seed, 1])
    maps = []
    for each in (a, b):
        n = 2 * len(each.ids)
        mixed = sigma * (np.eye(n) + 0.4 * rng.standard_normal((n, n)))
        error = mixed @ rng.standard_normal(n)
        means = each.means + error.reshape(-1, 2)
        maps.append(LandmarkGaussian(each.ids, means, mixed @ mixed.T))
    return maps, a_from_b, points


@pytest.mark.parametrize("form", ["spherical", "full"])
def test_two_maps_with_one_common_point_are_refused_with_the_number(form):
    (a, b), _, _ = (two_maps if form == "spherical" else full_maps)(0, common=1)
    exchange = svd_joining.exchange_maps if form == "spherical" else svd_joining.exchange_maps_fully
    with pytest.raises(TooFewPointsError, match="1 common point of two maps, 2 needed"):
        exchange(a, b)
