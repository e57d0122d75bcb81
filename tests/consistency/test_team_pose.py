"""NEES of a robot's pose in the team's frame.

The mutants count a submap twice, or treat later submaps unlike the centre.
"""

from dataclasses import replace

import numpy as np

from teamslam.team.estimation.consistency import nees
from teamslam.team.estimation.map_joining.conditioning import SubmapCorrection
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.submap import LocalMap
from tests.consistency import RIGHT, TOO_SMALL, judge
from tests.estimation.map_joining.test_conditioning import joined, later, team_pose
from tests.estimation.submap_world import prior_for, team, wrap

RUNS = 200


def nees_per_dof(pose, covariance, truth):
    error = pose - truth
    error[2] = wrap(error[2])
    return nees(error, covariance) / 3


def assert_right_and_mutant_too_small(rows):
    """rows: NEES per degree of freedom of the filter and of the mutant, by run."""
    right, mutant = np.mean(list(rows), axis=0)
    assert judge(right, 3, RUNS) == RIGHT
    assert judge(mutant, 3, RUNS) == TOO_SMALL


def test_the_team_pose_is_consistent_and_counting_a_submap_twice_is_not():
    def rows():
        for seed in range(RUNS):
            world = team(seed, submaps=5)
            before, after = later(world, "r0", 4)
            prior = prior_for(joined(before, world.starts), "r0", 0)
            local = after[0].local
            halved = LocalMap(local.ids, local.mean, 0.5 * local.covariance)
            yield [
                nees_per_dof(
                    *team_pose(prior._replace(covariance=p * prior.covariance), [], each),
                    world.paths["r0"][4],
                )
                for each, p in ((local, 1.0), (halved, 0.5))
            ]

    assert_right_and_mutant_too_small(rows())


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

    def rows():
        for seed in range(RUNS):
            rng = np.random.default_rng(seed)
            world = team(seed, submaps=6)
            error = {robot: SIGMA * rng.standard_normal() for robot in ("r0", "r1")}
            world.submaps = [
                with_shared_error(each, error[each.robot], rng) for each in world.submaps
            ]
            before, after = later(world, "r0", 4)
            prior = prior_for(joined(before, world.starts, SHARED), "r0", 0)
            yield [
                nees_per_dof(
                    *team_pose(prior, [shared.taken(each.local) for each in after], None),
                    world.paths["r0"][5],
                )
                for shared in (prior.shared, SubmapCorrection())
            ]

    assert_right_and_mutant_too_small(rows())


def test_the_team_pose_is_consistent_whatever_the_lag_of_the_last_broadcast():
    def rows():
        for seed in range(RUNS):
            rng = np.random.default_rng(seed)
            world = team(seed + 1000, submaps=6)
            known = int(rng.integers(1, 6))  # windows of r0 in its newest broadcast
            of_others = int(rng.integers(0, known + 1))  # its teammate's come later
            lasts = {"r0": known, "r1": of_others}
            inside = [each for each in world.submaps if each.sequence < lasts[each.robot]]
            own = [each for each in world.submaps if each.robot == "r0"]
            pending = [each.local for each in own if each.sequence >= known]
            prior = prior_for(joined(inside, world.starts), "r0", 0)
            yield [
                nees_per_dof(
                    *team_pose(
                        prior._replace(covariance=prior.covariance / times),
                        [LocalMap(x.ids, x.mean, x.covariance / times) for x in pending],
                        None,
                    ),
                    world.paths["r0"][5],
                )
                for times in (1, 2)
            ]

    assert_right_and_mutant_too_small(rows())
