"""The landmarks' own sigma widens the map's covariance and not the robots' priors."""

from dataclasses import replace

import numpy as np

from teamslam.team.estimation.map_joining.joining import JoinSettings, converged
from teamslam.team.estimation.map_joining.marginals import landmark_blocks, landmark_map, prior_for
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import team


def test_the_map_has_the_landmarks_own_sigma_and_the_robots_priors_have_not():
    world = team(3)
    settings = JoinSettings()
    fold = converged(joined_with(world.submaps, world.starts, (), settings, 1000), settings)
    island = replace(fold.main, settings=replace(settings, landmark_sigma=0.03))
    wider = replace(fold, islands={**fold.islands, fold.main_key: island})
    before, after = landmark_map(fold), landmark_map(wider)
    n = len(before.covariance)
    np.testing.assert_array_equal(after.means, before.means)
    np.testing.assert_allclose(after.covariance, before.covariance + 9e-4 * np.eye(n), rtol=1e-12)
    blocks, wide = landmark_blocks(fold), landmark_blocks(wider)
    np.testing.assert_allclose(wide.covariances, blocks.covariances + 9e-4 * np.eye(2), rtol=1e-12)
    robot = world.submaps[0].robot
    one, other = (prior_for(each, robot, world.submaps[0].incarnation) for each in (fold, wider))
    np.testing.assert_array_equal(one.covariance, other.covariance)
