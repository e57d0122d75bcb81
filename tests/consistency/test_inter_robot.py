"""The NEES of a map with inter-robot measurements, and the joint cost.

The mutant counts each measurement fourfold.
"""

from dataclasses import replace

from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.marginals import joint_cost, landmark_map
from tests.estimation.sighting_world import joined_with, meeting
from tests.estimation.submap_world import solved

RUNS = 200


def consistency(change):
    """Mean NEES of map and last poses, mean joint cost; each per degree of freedom, with it."""
    errors = cost = 0.0
    dof = joint = 0.0
    for seed in range(RUNS):
        world = meeting(seed, robots=2, submaps=3, landmarks=2, reach=7.0)
        sightings = [replace(each, covariance=change * each.covariance) for each in world.sightings]
        fold = joined_with(world.submaps, world.starts, sightings, JoinSettings(), 100)
        fold = solved(fold, JoinSettings())
        found = landmark_map(fold)
        truth = world.landmarks[found.ids]
        if len(found.ids):
            errors += nees((found.means - truth).ravel(), found.covariance)
            dof += found.means.size
        agreement = joint_cost(fold)
        cost += agreement.chi2
        joint += agreement.dof
    return errors / dof, round(dof), cost / joint, round(joint)


def test_a_map_with_sightings_is_consistent_and_one_that_counts_each_fourfold_is_not():
    ratio, dof, cost, joint = consistency(1.0)
    low, high = chi2_interval(dof, 0.999, 1)
    assert low < ratio < high
    least, most = chi2_interval(joint, 0.999, 1)
    assert least < cost < most
    _, _, cost_of_mutant, _ = consistency(0.25)
    assert cost_of_mutant > most
