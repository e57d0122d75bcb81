"""NEES of a robot's pose in the team's frame.

The mutants count a submap twice, or treat later submaps unlike the centre.
"""

from dataclasses import replace

import numpy as np

from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.map_joining.conditioning import (
    SubmapCorrection,
)
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.map_joining.test_conditioning import (
    joined,
    later,
    team_pose,
)
from tests.estimation.submap_world import prior_for, team, wrap


def test_the_team_pose_is_consistent_and_counting_a_submap_twice_is_not():
    runs, honest, twice = 200, 0.0, 0.0
    for seed in range(runs):
        world = team(seed, submaps=5)
        before, after = later(world, "r0", 4)
        prior = prior_for(joined(before, world.starts), "r0", 0)
        local = after[0].local
        halved = LocalMap(local.ids, local.mean, 0.5 * local.covariance)
        for_each = []
        for each, p in ((local, 1.0), (halved, 0.5)):
            told = prior._replace(covariance=p * prior.covariance)
            pose, covariance = team_pose(told, [], each)
            error = pose - world.paths["r0"][4]
            error[2] = wrap(error[2])
            for_each.append(nees(error, covariance) / 3)
        honest += for_each[0] / runs
        twice += for_each[1] / runs
    low, high = chi2_interval(3, 0.999, runs)
    assert low < honest < high
    assert twice > high


FACTOR, SIGMA = 2.5, 0.3


SHARED = JoinSettings(covariance_factor=FACTOR, bias_sigma={"range_scale": SIGMA})


def with_shared_error(submap, error, rng):
    """Errors of FACTOR times the stated covariance, and one that all submaps of a robot share."""
    local = submap.local
    n = len(local.mean)
    column = 0.5 * rng.standard_normal((1, n))
    column[0, 2] *= 0.1
    more = np.linalg.cholesky(local.covariance) @ rng.standard_normal(n)
    mean = local.mean - error * column[0] + np.sqrt(FACTOR - 1.0) * more
    return replace(
        submap, local=replace(local, mean=mean, biases=("range_scale",), sensitivity=column)
    )


def test_the_team_pose_is_overconfident_unless_it_joins_later_submaps_as_the_centre_does():
    """The mutant omits the covariance factor and the shared error of the prior."""
    runs, told, untold = 200, 0.0, 0.0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        world = team(seed, submaps=6)
        error = {robot: SIGMA * rng.standard_normal() for robot in ("r0", "r1")}
        world.submaps = [with_shared_error(each, error[each.robot], rng) for each in world.submaps]
        before, after = later(world, "r0", 4)
        prior = prior_for(joined(before, world.starts, SHARED), "r0", 0)
        for shared in (prior.shared, SubmapCorrection()):
            pose, spread = team_pose(prior, [shared.taken(each.local) for each in after], None)
            off = pose - world.paths["r0"][5]
            off[2] = wrap(off[2])
            share = nees(off, spread) / 3 / runs
            told, untold = (
                (told + share, untold) if shared is prior.shared else (told, untold + share)
            )
    low, high = chi2_interval(3, 0.999, runs)
    assert low < told < high
    assert untold > high


def test_the_team_pose_is_consistent_whatever_the_lag_of_the_last_broadcast():
    runs, honest, twice = 200, 0.0, 0.0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        world = team(seed + 1000, submaps=6)
        known = int(rng.integers(1, 6))  # windows of r0 in its newest broadcast
        of_others = int(rng.integers(0, known + 1))  # its teammate's come later
        pending = [
            each.local for each in world.submaps if each.robot == "r0" and each.sequence >= known
        ]
        inside = [
            each
            for each in world.submaps
            if each.sequence < (known if each.robot == "r0" else of_others)
        ]
        prior = prior_for(joined(inside, world.starts), "r0", 0)
        for times in (1, 2):
            told = prior._replace(covariance=prior.covariance / times)
            again = [LocalMap(x.ids, x.mean, x.covariance / times) for x in pending]
            pose, spread = team_pose(told, again, None)
            error = pose - world.paths["r0"][5]
            error[2] = wrap(error[2])
            share = nees(error, spread) / 3 / runs
            honest, twice = (honest + share, twice) if times == 1 else (honest, twice + share)
    low, high = chi2_interval(3, 0.999, runs)
    assert low < honest < high
    assert twice > high
