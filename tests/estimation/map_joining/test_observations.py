import numpy as np
import pytest

from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, joint_marginal
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import solved, team

STEP = 1e-6


@pytest.fixture(scope="module")
def island():
    world, settings = team(2), JoinSettings(covariance_factor=2.0)
    return solved(joined_with(world.submaps, world.starts, (), settings), settings).main


def placed(numbers):
    """A landmark at (u, v) from a start pose, of (x, y, θ, u, v), in the map."""
    x, y, heading, u, v = numbers
    point = x + 1j * y + np.exp(1j * heading) * (u + 1j * v)
    return np.array([point.real, point.imag])


def test_an_observation_has_the_covariance_of_the_start_pose_and_its_own(island):
    points, spread = island.estimate.observations
    row = 0
    for joined in island.graph.submaps:
        pose, P = joint_marginal(island, [int(joined.nodes[0])])
        local = joined.contribution.local
        for k, point in enumerate(local.landmarks):
            own = slice(3 + 2 * k, 5 + 2 * k)
            at = np.concatenate([pose, point])
            J = np.column_stack(
                [(placed(at + d) - placed(at - d)) / (2.0 * STEP) for d in STEP * np.eye(5)]
            )
            whole = np.zeros((5, 5))
            whole[:3, :3], whole[3:, 3:] = P, 2.0 * local.covariance[own, own]
            expected = J @ whole @ J.T
            np.testing.assert_allclose(points[row], placed(at), atol=1e-9)
            np.testing.assert_allclose(spread[row], expected[[0, 0, 1], [0, 1, 1]], rtol=1e-5)
            row += 1
    assert row == len(points) > 20
