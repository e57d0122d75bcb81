from dataclasses import replace

import numpy as np
import pytest

from teamslam.sim.studies.estimators.feedback import absorb_fused_map
from teamslam.team.core import WholeMap
from teamslam.team.estimation.gaussian import NotACovarianceError
from teamslam.team.estimation.map_joining.conditioning import (
    compose_pose,
    initial_map,
    join_submap,
    remove_landmarks,
)
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    add_start,
    fold_submaps,
    solve_fold,
)
from tests.estimation.submap_world import correlated, prior_for, team

LINEAR = (0.1, 1e-5, 0.2)


def map_of(local):
    bare = local.without_nodes
    return WholeMap(bare.ids, bare.mean, bare.covariance)


def whole_of(world, count=None):
    whole = initial_map(world.starts[0].pose, world.starts[0].covariance)
    for each in world.submaps[:count]:
        whole = join_submap(whole, each.local)
    return whole


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("covariance", [None, np.diag([0.2, 0.1, 1e-10])])
def test_joining_one_after_the_other_equals_the_joint_solution_in_the_linear_case(seed, covariance):
    world = team(seed, robots=1, submaps=6, sigmas=LINEAR)
    world.starts[0] = replace(world.starts[0], covariance=covariance)
    settings = JoinSettings(step_tolerance=1e-11)
    fold = solve_fold(
        fold_submaps(add_start(EMPTY_FOLD, world.starts[0]), world.submaps, settings), settings
    )
    expected = prior_for(fold, "r0", 0)
    found = whole_of(world)
    sigma = np.sqrt(np.diag(expected.covariance))
    mean = np.concatenate([expected.pose, expected.means.ravel()])
    np.testing.assert_array_equal(found.ids, expected.ids)
    np.testing.assert_allclose(found.mean / sigma, mean / sigma, atol=2e-2)
    relative = np.outer(sigma, sigma)
    np.testing.assert_allclose(
        found.covariance / relative, expected.covariance / relative, atol=1e-3
    )


def test_the_pose_follows_the_absorbed_landmarks_by_regression():
    whole = whole_of(team(7, robots=1, submaps=5))
    ids = whole.ids[1:3]
    P_ll = whole.covariance[5:9, 5:9]
    P_pl = whole.covariance[:3, 5:9]
    told, spread = whole.mean[5:9] + 0.1, 0.25 * P_ll
    after = absorb_fused_map(whole, ids, told.reshape(-1, 2), spread)
    gain = P_pl @ np.linalg.inv(P_ll)
    np.testing.assert_allclose(after.mean[:3], whole.mean[:3] + gain @ np.full(4, 0.1))
    expected = whole.covariance[:3, :3] - gain @ (P_ll - spread) @ gain.T
    np.testing.assert_allclose(after.covariance[:3, :3], expected, rtol=1e-9)
    np.testing.assert_allclose(after.covariance[5:9, 5:9], spread, rtol=1e-12)
    np.testing.assert_allclose(after.covariance[:3, 5:9], gain @ spread, rtol=1e-9)


def test_absorbing_adds_unknown_landmarks_and_keeps_their_ties():
    whole = whole_of(team(8, robots=1, submaps=3))
    rng = np.random.default_rng(1)
    known = int(whole.ids[0])
    ids = np.array([known, 900], np.uint32)
    told = np.array([whole.mean[3:5], [7.0, 8.0]])
    spread = correlated(np.full(4, 0.3), rng)
    after = absorb_fused_map(whole, ids, told, spread)
    assert after.ids[-1] == 900
    np.testing.assert_array_equal(after.mean[-2:], [7.0, 8.0])
    np.testing.assert_allclose(after.covariance[-2:, 3:5], spread[2:, :2])
    gain = whole.covariance[:3, 3:5] @ np.linalg.inv(whole.covariance[3:5, 3:5])
    np.testing.assert_allclose(after.covariance[:3, -2:], gain @ spread[:2, 2:], atol=1e-12)
    assert np.linalg.eigvalsh(after.covariance)[0] > 0.0


def test_the_end_pose_is_that_of_joining_without_the_landmark_that_the_gate_leaves_out():
    world = team(6, robots=1, submaps=4, landmarks=12, reach=30.0)
    whole, local = whole_of(world, 3), world.submaps[3].local
    known = np.intersect1d(whole.ids, local.ids)
    assert len(known) >= 4
    bad = int(np.searchsorted(local.ids, known[1]))
    entry = len(local.mean) - 2 * len(local.ids) + 2 * bad
    moved = local.mean.copy()
    moved[entry] += 40.0 * np.sqrt(local.covariance[entry, entry] + whole.covariance.max())
    pose, seen, refused = compose_pose(whole, map_of(replace(local, mean=moved)))
    expected = join_submap(whole, remove_landmarks(local, np.arange(len(local.ids)) == bad))
    assert (seen, refused) == (len(known), 1)
    np.testing.assert_allclose(pose.mean, expected.mean[:3], rtol=1e-12)
    np.testing.assert_allclose(pose.covariance, expected.covariance[:3, :3], rtol=1e-9)
    all_of_it, seen, refused = compose_pose(whole, map_of(local))
    assert (seen, refused) == (len(known), 0)
    np.testing.assert_allclose(all_of_it.mean, join_submap(whole, local).mean[:3], rtol=1e-12)


def test_a_map_whose_shared_landmarks_have_no_covariance_has_no_end_pose():
    world = team(6, robots=1, submaps=4, landmarks=12, reach=30.0)
    whole, local = whole_of(world, 3), world.submaps[3].local
    with pytest.raises(NotACovarianceError, match="not positive definite"):
        compose_pose(WholeMap(whole.ids, whole.mean, -2.0 * whole.covariance), map_of(local))
