from dataclasses import replace

import numpy as np
import pytest

from teamslam.team.core import WholeMap
from teamslam.team.estimation.consistency import nees
from teamslam.team.estimation.gaussian import PoseGaussian, curved
from teamslam.team.estimation.map_joining import conditioning
from teamslam.team.estimation.map_joining.conditioning import (
    SubmapCorrection,
    compose_pose,
    join_pending,
    remove_landmarks,
)
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, joint_marginal
from teamslam.team.estimation.map_joining.marginals import trajectory
from teamslam.team.estimation.se2 import compose, exponential, tangent
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import prior_for, solved, team, wrap

OPTIONS = JoinSettings(step_tolerance=1e-11)
LINEAR = (0.1, 1e-5, 0.2)


def joined(submaps, starts, settings=OPTIONS):
    return solved(joined_with(submaps, starts, (), settings, len(submaps)), settings)


def team_pose(prior, pending, open_window):
    bare = None if open_window is None else open_window.without_nodes
    running = None if bare is None else WholeMap(bare.ids, bare.mean, bare.covariance)
    return compose_pose(join_pending(prior.whole, pending).whole, running).pose


def later(world, robot, known):
    """The team's submaps up to each robot's `known`-th, and this robot's further ones."""
    before = [each for each in world.submaps if each.sequence < known]
    after = [each for each in world.submaps if each.robot == robot and each.sequence >= known]
    return before, after


@pytest.mark.parametrize("known", [3, 5, 7])
@pytest.mark.parametrize("seed", range(3))
def test_conditioning_equals_the_full_join_in_the_linear_case(seed, known):
    world = team(seed, submaps=8, sigmas=LINEAR)
    before, after = later(world, "r1", known)
    prior = prior_for(joined(before, world.starts), "r1", 0)
    locals_ = [each.local for each in after]
    pose, covariance = team_pose(prior, locals_[:-1], locals_[-1])
    everything = joined(before + after, world.starts)
    path = trajectory(everything, "r1", 0)
    sigma = np.sqrt(np.diag(path.covariances[-1]))
    np.testing.assert_allclose(pose / sigma, path.poses[-1] / sigma, atol=2e-2)
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(covariance / scale, path.covariances[-1] / scale, atol=1e-3)


def test_an_open_window_is_one_more_submap():
    world = team(4, submaps=6, sigmas=LINEAR)
    before, after = later(world, "r0", 4)
    prior = prior_for(joined(before, world.starts), "r0", 0)
    one, two = (each.local for each in after)
    closed, spread = team_pose(prior, [one, two], None)
    running, of_running = team_pose(prior, [one], two)
    sigma = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(running / sigma, closed / sigma, atol=1e-3)
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(of_running / scale, spread / scale, atol=1e-3)


def one_after_the_other(prior, pending):
    """Mutant: each submap is linearised at the guess before it."""
    whole = prior.whole
    for each in pending:
        whole = conditioning.join_submap(whole, each)
    return whole.mean[:3]


def test_a_poor_prior_and_later_submaps_give_the_pose_of_the_full_join():
    """With submaps of 0.5 rad, later measurements determine the heading of earlier ones, too."""
    away = {"ours": [], "one after the other": []}
    for seed in range(12):
        world = team(seed, submaps=8, landmarks=10, size=60.0, reach=20.0, sigmas=(0.3, 0.5, 2.0))
        before, after = later(world, "r0", 2)
        prior = prior_for(joined(before, world.starts), "r0", 0)
        pending = [each.local for each in after]
        path = trajectory(joined(before + after, world.starts), "r0", 0)
        poses = {
            "ours": join_pending(prior.whole, pending).whole.mean[:3],
            "one after the other": one_after_the_other(prior, pending),
        }
        for name, pose in poses.items():
            off = pose - path.poses[-1]
            off[2] = wrap(off[2])
            away[name].append(nees(off, path.covariances[-1]) / 3)
    assert max(away["ours"]) < 0.01
    assert max(away["one after the other"]) > 0.1


def overconfident(local, shift):
    mean, scale = local.mean.copy(), np.ones(len(local.mean))
    mean[:3] += shift
    scale[:3] = 0.3
    return LocalMap(local.ids, mean, local.covariance * np.outer(scale, scale))


@pytest.mark.parametrize("seed", [2, 4, 7])
def test_after_a_bad_submap_the_landmarks_of_the_next_ones_bring_the_pose_back(seed):
    world = team(seed, submaps=10, landmarks=12)
    before, after = later(world, "r0", 5)
    prior = prior_for(joined(before, world.starts), "r0", 0)
    bad = overconfident(after[0].local, (1.0, -0.8, 0.1))
    told = join_pending(prior.whole, [bad, *(each.local for each in after[1:3])])
    off = told.whole.mean[:3] - world.paths["r0"][7]
    off[2] = wrap(off[2])
    assert told.disputed
    assert nees(off, told.whole.covariance[:3, :3]) < 16.3
    assert not any(
        join_pending(prior.whole, [e.local for e in after[:n]]).disputed for n in range(4)
    )


def misread(local, place, shift):
    mean = local.mean.copy()
    mean[3 + 2 * place : 5 + 2 * place] += shift
    return LocalMap(local.ids, mean, local.covariance)


@pytest.mark.parametrize("seed", range(3))
def test_a_misread_landmark_leaves_the_pose_as_it_is_without_it(seed, monkeypatch):
    world = team(seed, submaps=6)
    before, after = later(world, "r0", 4)
    prior = prior_for(joined(before, world.starts), "r0", 0)
    first, second = (each.local for each in after)
    known = [k for k, id_ in enumerate(second.ids.tolist()) if id_ in prior.ids]
    place = known[0]
    expected, covariance = team_pose(
        prior, [first], remove_landmarks(second, np.arange(len(second.ids)) == place)
    )
    wrong = misread(second, place, np.array([4.0, -3.0]))
    pose, spread = team_pose(prior, [first], wrong)
    np.testing.assert_array_equal(pose, expected)
    np.testing.assert_array_equal(spread, covariance)
    monkeypatch.setattr(conditioning, "GATE", np.inf)
    trusting, _ = team_pose(prior, [first], wrong)
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs((trusting - expected) / sigma).max() > 3.0


def test_a_submap_is_taken_with_the_variance_of_each_shared_error_that_it_knows():
    local = team(3, submaps=1).submaps[0].local
    n, rng = len(local.mean), np.random.default_rng(1)
    columns = rng.normal(size=(2, n))
    local = replace(local, biases=("bearing", "range_scale"), sensitivity=columns)
    shared = SubmapCorrection(
        1.5, (("range_scale", 0.2, 0.3), ("bearing", -0.1, 0.05), ("clock", 7.0, 7.0))
    )
    taken = shared.taken(local)
    S, B = columns, np.diag(np.square([0.05, 0.3]))
    np.testing.assert_allclose(taken.mean, local.mean + S.T @ [-0.1, 0.2])
    np.testing.assert_allclose(taken.covariance, 1.5 * local.covariance + S.T @ B @ S)
    np.testing.assert_array_equal(taken.ids, local.ids)
    assert SubmapCorrection().taken(local).covariance.tobytes() == local.covariance.tobytes()


def test_a_trajectory_has_the_joint_covariance_of_neighbouring_poses():
    world = team(5, submaps=4, sigmas=LINEAR)
    fold = joined(world.submaps, world.starts)
    island, path = fold.island("r1", 0), trajectory(fold, "r1", 0)
    nodes = island.graph.streams["r1", 0]
    np.testing.assert_array_equal(path.crosses[0], np.zeros((3, 3)))  # the start is exactly known
    for k in range(1, 4):
        mean, covariance = joint_marginal(island, [nodes[k], nodes[k + 1]])
        np.testing.assert_allclose(mean[3:], path.poses[k])
        np.testing.assert_allclose(covariance[3:, :3], path.crosses[k], rtol=1e-6, atol=1e-12)


def test_a_pose_behind_a_bad_heading_has_the_covariance_of_its_arc():
    """20 m beyond a heading known to 0.2 rad: against samples of pose ∘ Exp(ξ)."""
    generator = np.random.default_rng(1)
    mean = np.array([3.0, -2.0, 0.7])
    S = np.array([[0.1, 0.0, 0.0], [0.0, 16.1, 0.79], [0.0, 0.79, 0.04]])
    drawn = generator.multivariate_normal(np.zeros(3), S, 20_000)
    off = np.array([compose(mean, exponential(xi)) for xi in drawn]) - mean
    off[:, 2] = wrap(off[:, 2])
    T = tangent(mean[2])
    found = curved(PoseGaussian(mean, T @ S @ T.T))
    sampled = T.T @ (off.T @ off / len(off)) @ T
    told = T.T @ found.covariance @ T
    sigma = np.sqrt(np.diag(sampled))
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(told / scale, sampled / scale, atol=0.06)
    assert told[0, 0] > 4.0 * S[0, 0]  # along the path, which an ellipse does not contain
    np.testing.assert_array_equal(found.mean, mean)
    assert found.covariance[2, 2] == pytest.approx(S[2, 2])
