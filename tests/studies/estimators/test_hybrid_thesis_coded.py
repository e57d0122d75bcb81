"""The program of the thesis' appendix: its differences from the thesis' text."""

import numpy as np
import pytest

from teamslam.sim.studies.estimators import hybrid_thesis_coded
from teamslam.sim.studies.estimators.hybrid_thesis_coded import CodedState
from teamslam.team.config import Sensor
from teamslam.team.estimation.hybrid_slam.fastslam import effective_sample_size
from teamslam.team.estimation.models import Increment

SENSOR = Sensor(range_sigma=2.0, bearing_sigma=0.1)
MOTION = Increment(np.array([1.0, 0.0, 0.0]), np.diag([0.05, 0.0, 0.05]) ** 2)
ID = np.array([7], np.uint32)


def run(steps: int, particles: int = 50, seed: int = 1) -> list[CodedState]:
    """Straight on, past a landmark at (10, 5) whose measurements have no error."""
    generator = np.random.default_rng(seed)
    state = hybrid_thesis_coded.started(np.zeros(3), particles)
    states = [state]
    for k in range(1, steps + 1):
        offset = np.array([10.0 - k, 5.0])
        measurement = np.array([np.hypot(*offset)]), np.array([np.arctan2(offset[1], offset[0])])
        state = hybrid_thesis_coded.filter_step(state, MOTION, SENSOR, ID, *measurement, generator)
        states.append(state)
    return states


def test_all_poses_and_landmarks_become_the_mean_and_covariances_stay_each_particles_own() -> None:
    state = run(3)[-1]
    assert len(np.unique(state.particles.poses, axis=0)) == 1
    assert len(np.unique(state.particles.means, axis=0)) == 1
    assert len(np.unique(state.particles.covariances, axis=0)) == 50
    assert len(np.unique(state.drawn.poses, axis=0)) == 50
    weights = np.exp(state.drawn.log_weights)
    np.testing.assert_allclose(
        state.particles.poses[0, :2], weights @ state.drawn.poses[:, :2], atol=1e-12
    )


def test_weights_go_on_until_few_particles_carry_them() -> None:
    effective = [effective_sample_size(s.particles.log_weights) for s in run(200)]
    assert effective[2] > 45.0
    assert effective[-1] < 0.5 * effective[2]


def test_a_new_landmark_begins_with_15_m_and_the_printed_matrix() -> None:
    generator = np.random.default_rng(1)
    started = hybrid_thesis_coded.started(np.zeros(3), 4)
    state = hybrid_thesis_coded.filter_step(
        started, Increment.identity(), SENSOR, ID, np.array([10.0]), np.array([0.3]), generator
    )
    s, c = np.sin(0.3), np.cos(0.3)
    Gz = np.array([[c, 10.0 * s], [s, 10.0 * c]])
    printed = Gz @ np.diag([15.0**2, 10.0 * np.pi / 18.0**2]) @ Gz.T
    found = state.particles.covariances[0, 0]
    np.testing.assert_allclose(found, [printed[0, 0], printed[0, 1], printed[1, 1]])


def test_what_is_absorbed_replaces_the_landmark_of_every_particle() -> None:
    before = run(3)[-1]
    ids, at = np.array([3, 7], np.uint32), np.array([[1.0, 2.0], [9.0, 5.5]])
    blocks = np.array([np.diag([0.2, 0.3]), np.diag([0.4, 0.5])])
    after = hybrid_thesis_coded.absorbed(before, ids, at, blocks)
    np.testing.assert_array_equal(after.particles.poses, before.particles.poses)
    np.testing.assert_array_equal(after.particles.log_weights, before.particles.log_weights)
    told = hybrid_thesis_coded.landmark_gaussian(after)
    np.testing.assert_array_equal(told.ids, ids)
    np.testing.assert_allclose(told.means, at)
    np.testing.assert_allclose(np.diag(told.covariance), [0.2, 0.3, 0.4, 0.5])


@pytest.mark.parametrize("steps", [0, 5])
def test_the_pose_is_that_of_the_last_steps_particles(steps: int) -> None:
    state = run(steps)[-1]
    mean, covariance = hybrid_thesis_coded.pose_gaussian(state)
    np.testing.assert_allclose(mean, state.particles.poses[0], atol=1e-12)
    assert (np.trace(covariance) > 0.0) == (steps > 0)
