"""The map's NEES and the joint cost, per degree of freedom.

The mutant counts each submap twice.
"""

from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.marginals import (
    joint_cost,
    landmark_map,
)
from tests.estimation.map_joining.test_joining import (
    joined,
)
from tests.estimation.submap_world import solved, team

RUNS = 200


def consistency(options):
    """Mean map NEES per degree of freedom and mean joint cost per degree of freedom."""
    errors = cost = dof = joint = 0.0
    for seed in range(RUNS):
        world = team(seed, robots=2, submaps=5, landmarks=4)
        fold = solved(joined(world.submaps, world.starts, options, tick=10), options)
        found = landmark_map(fold)
        truth = world.landmarks[found.ids]
        errors += nees((found.means - truth).ravel(), found.covariance)
        dof += found.means.size
        agreement = joint_cost(fold)
        cost += agreement.chi2
        joint += agreement.dof
    return errors / dof, round(dof), cost / joint, round(joint)


def test_map_and_joint_cost_are_consistent_and_a_submap_counted_twice_is_not():
    ratio, dof, cost, joint = consistency(JoinSettings())
    low, high = chi2_interval(dof, 0.999, 1)
    assert low < ratio < high
    least, most = chi2_interval(joint, 0.999, 1)
    assert least < cost < most
    twice, _, _, _ = consistency(JoinSettings(covariance_factor=0.5))
    assert twice > high
