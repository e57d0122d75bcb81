"""Joined submaps equal the batch over all raw measurements, in any order of arrival."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.gaussian import NotDeterminedError
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import solve_fold
from teamslam.team.estimation.map_joining.marginals import (
    joint_cost,
    landmark_map,
    main_priors,
    trajectory,
)
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import prior_for, team

EXACTLY = JoinSettings(step_tolerance=1e-11)


def joined(submaps, starts, options=EXACTLY, tick=4):
    return joined_with(submaps, starts, (), options, tick)


# --- the linear case: a robot that knows its heading, so raw measurements and submaps are linear
# ---

STEPS, POINTS = 12, 3
HEADING_VARIANCE = 1e-12


def raw_measurements(seed=5):
    """Steps (12, 2) and landmarks seen from the end of each step (12, 3, 2), sigma 0.1 and 0.3."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.normal(1.0, 0.5, (STEPS, 2)), axis=0)
    points = rng.uniform(-5.0, 15.0, (POINTS, 2))
    steps = np.diff(truth, axis=0, prepend=0.0) + rng.normal(0.0, 0.1, (STEPS, 2))
    sights = points[None] - truth[:, None] + rng.normal(0.0, 0.3, (STEPS, POINTS, 2))
    return steps, sights


def batch(steps, sights):
    """Least squares over all positions and landmarks: mean and covariance of (last, landmarks)."""
    n = len(steps)
    rows, right, weight = [], [], []
    for axis in range(2):
        for t in range(n):
            row = np.zeros((n + POINTS, 2))
            row[t, axis] = 1.0
            if t:
                row[t - 1, axis] = -1.0
            rows.append(row.ravel())
            right.append(steps[t, axis])
            weight.append(1 / 0.1)
            for j in range(POINTS):
                row = np.zeros((n + POINTS, 2))
                row[n + j, axis], row[t, axis] = 1.0, -1.0
                rows.append(row.ravel())
                right.append(sights[t, j, axis])
                weight.append(1 / 0.3)
    A = np.array(rows) * np.array(weight)[:, None]
    covariance = np.linalg.inv(A.T @ A)
    mean = covariance @ (A.T @ (np.array(right) * np.array(weight)))
    return mean[2 * (n - 1) :], covariance[2 * (n - 1) :, 2 * (n - 1) :]


def windows(steps, sights, length):
    """Submaps of `length` steps each: the batch of the window in the frame of its start."""
    made = []
    for k, begin in enumerate(range(0, STEPS, length)):
        mean, covariance = batch(steps[begin : begin + length], sights[begin : begin + length])
        full = block_diag(covariance[:2, :2], HEADING_VARIANCE, covariance[2:, 2:])
        full[3:, :2], full[:2, 3:] = covariance[2:, :2], covariance[:2, 2:]
        local = LocalMap(np.arange(POINTS, dtype=np.uint32), np.insert(mean, 2, 0.0), full)
        made.append(Contribution("r0", 0, k, 1000 * (k + 1), local))
    return made


@pytest.mark.parametrize("length", [1, 2, 3, 4, 6, 12])
def test_joined_submaps_equal_the_batch_over_all_raw_measurements(length):
    steps, sights = raw_measurements()
    fold = solve_fold(
        joined(windows(steps, sights, length), [InitialPoseFactor("r0", 0, np.zeros(3))]), EXACTLY
    )
    mean, covariance = batch(steps, sights)
    prior = prior_for(fold, "r0", 0)
    keep = np.delete(np.arange(3 + 2 * POINTS), 2)
    estimate = np.concatenate([prior.pose, prior.means.ravel()])[keep]
    np.testing.assert_allclose(estimate, mean, atol=2e-5)
    np.testing.assert_allclose(prior.covariance[np.ix_(keep, keep)], covariance, atol=1e-8)


# --- a function of the set, not of its order ---


@pytest.mark.parametrize("seed", range(4))
def test_the_incremental_solution_converges_to_the_one_from_scratch(seed):
    world = team(seed, robots=3, submaps=10)
    one_by_one = solve_fold(joined(world.submaps, world.starts, tick=1), EXACTLY)
    at_once = solve_fold(joined(world.submaps, world.starts, tick=1000), EXACTLY)
    np.testing.assert_allclose(
        landmark_map(one_by_one).means, landmark_map(at_once).means, atol=1e-8
    )


# --- the mathematics of one factor ---


def test_the_kernels_gradient_is_the_slope_of_the_cost_that_is_minimised():
    world = team(7, submaps=3)
    starts = [replace(start, covariance=0.1 * np.eye(3)) for start in world.starts]
    island = joined(world.submaps, starts, JoinSettings()).main
    gradient = island.estimate.gradient
    for k in range(0, len(island.state), 5):
        shift = 1e-6 * np.eye(len(island.state))[k]
        up, down = (replace(island, state=island.state + s * shift).cost for s in (1, -1))
        assert (up - down) / 4e-6 == pytest.approx(gradient[k], rel=1e-4, abs=1e-4)


# --- redundancy ---


@pytest.mark.parametrize("gate", [13.8, np.inf], ids=["landmarks by themselves", "as a whole"])
def test_with_a_robust_loss_the_redundancies_add_up_too_since_each_counts_with_its_weight(gate):
    """Σ (dim − w tr(JᵀP⁻¹J Σ)) = Σ dim − unknowns: Σ is the inverse of Σ w JᵀP⁻¹J."""
    world = team(11, robots=2, submaps=10)
    options = JoinSettings(landmark_gate=gate, step_tolerance=1e-9)
    fold = solve_fold(joined(with_outlier(world, 15), world.starts, options), options)
    costs, graph = joint_cost(fold).submaps, fold.main.graph
    assert min(fold.main.estimate.landmark_weights if gate < np.inf else costs.weight) < 0.3
    redundancy = costs.dof.sum()
    assert redundancy == pytest.approx(graph.dimensions.sum() - graph.unknowns)
    if gate == np.inf:
        unweighted = ((graph.dimensions - costs.dof) / costs.weight).sum()
        assert unweighted > graph.unknowns + 1.0, "the mutant, which takes all as believed"


# --- marginals ---


def test_of_many_landmarks_a_prior_has_the_nearest():
    world = team(9, robots=3)
    fold = joined(world.submaps, world.starts)
    streams = [("r0", 0), ("r2", 0)]
    few = main_priors(fold, streams, 4, sorted(fold.main.graph.landmarks))
    assert sorted(few) == streams
    for robot, incarnation in streams:
        prior, everything = few[robot, incarnation], prior_for(fold, robot, incarnation)
        distance = np.linalg.norm(everything.means - everything.pose[:2], axis=1)
        assert set(prior.ids) == set(everything.ids[np.argsort(distance)[:4]])
        same = prior_for(fold, robot, incarnation, prior.ids.tolist())
        for one, other in zip(prior[:4], same[:4], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-15)


def test_an_uncertain_start_is_composed_with_the_submap_that_leaves_it():
    start = InitialPoseFactor("r0", 0, np.array([1.0, 2.0, 0.5]), np.diag([0.04, 0.09, 0.01]))
    local = LocalMap(
        np.zeros(0, np.uint32), np.array([2.0, 0.0, 0.1]), np.diag([0.01, 0.01, 0.001])
    )
    path = trajectory(joined([Contribution("r0", 0, 0, 10, local)], [start]), "r0", 0)
    c, s = np.cos(0.5), np.sin(0.5)
    J = np.array([[1, 0, -2 * s], [0, 1, 2 * c], [0, 0, 1]])
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    expected = J @ start.covariance @ J.T + R @ local.covariance @ R.T
    np.testing.assert_allclose(path.poses[0], [1 + 2 * c, 2 + 2 * s, 0.6], atol=1e-12)
    np.testing.assert_allclose(path.covariances[0], expected, atol=1e-12)


def test_a_graph_without_a_gauge_names_a_node_that_is_not_determined():
    world = team(10, robots=1)
    island = joined(world.submaps, world.starts).main
    graph = replace(island.graph, fixed=np.zeros_like(island.graph.fixed))
    with pytest.raises(NotDeterminedError, match=r"r0 \(incarnation 0\)|landmark"):
        _ = replace(island, graph=graph).posterior


# --- outliers ---


def with_outlier(world, k):
    bad = world.submaps[k]
    mean = bad.local.mean.copy()
    mean[3:] *= 3.0
    return [
        *world.submaps[:k],
        replace(bad, local=replace(bad.local, mean=mean)),
        *world.submaps[k + 1 :],
    ]


@pytest.mark.parametrize("tick", [1, 40])
def test_one_wrong_submap_in_forty_moves_the_map_much_unless_the_loss_is_robust(tick):
    world = team(11, robots=2, submaps=20)
    submaps = with_outlier(world, 15)

    def moved(options):
        clean, wrong = (
            landmark_map(solve_fold(joined(each, world.starts, options, tick), options))
            for each in (world.submaps, submaps)
        )
        sigma = np.sqrt(np.diag(clean.covariance)).reshape(-1, 2)
        return np.sqrt(np.mean(((wrong.means - clean.means) / sigma) ** 2))

    assert moved(JoinSettings(robust=False)) > 2.0
    assert moved(JoinSettings()) < 0.3


def test_a_true_loop_closure_is_not_taken_for_an_outlier():
    world = team(12, robots=1, submaps=30, landmarks=8, reach=6.0, sigmas=(0.1, 0.1, 0.05))
    options = JoinSettings()
    plain = landmark_map(solve_fold(joined(world.submaps, world.starts, tick=1), EXACTLY))
    robust = landmark_map(solve_fold(joined(world.submaps, world.starts, options, 1), options))
    sigma = np.sqrt(np.diag(plain.covariance)).reshape(-1, 2)
    assert (np.abs(robust.means - plain.means) < 1.5 * sigma).all()
