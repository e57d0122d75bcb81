import numpy as np

from teamslam.sim.studies.estimators import hybrid_thesis, hybrid_thesis_coded
from teamslam.sim.studies.estimators.hybrid_thesis import ThesisState
from teamslam.sim.studies.estimators.hybrid_thesis_coded import CodedState
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.config import Sensor
from teamslam.team.estimation.models import Increment

SENSOR = Sensor(range_sigma=0.2, bearing_sigma=0.03)
MOTION = Increment(np.array([1.0, 0.0, 0.1]), np.diag([0.05, 0.02, 0.05]) ** 2)
STANDING = Increment.identity()
KNOWN = ThesisState(
    pose=np.array([1.0, 2.0, 3.0]),
    pose_covariance=np.zeros((3, 3)),
    ids=np.array([2, 5, 8], np.uint32),
    landmarks=np.array([[9.0, 2.0], [-4.0, 7.0], [0.0, -6.0]]),
    covariances=np.array([np.diag([0.3, 0.2]), np.diag([0.5, 0.9]), np.diag([0.1, 0.1])]),
    particles=10,
)


def ids(*values):
    return np.array(values, np.uint32)


def filter_step(state, motion, seen, ranges, bearings):
    measurements = ids(*seen), np.array(ranges, float), np.array(bearings, float)
    step = RobotStep("r1", motion, SENSOR, *measurements)
    return hybrid_thesis.filter_step(state, step, np.random.default_rng(0))


def test_standing_still_a_measurement_updates_its_landmark_as_the_kalman_filter_does():
    offset = KNOWN.landmarks[1] - KNOWN.pose[:2]
    r = np.hypot(*offset)
    z = np.array([r + 0.3, np.arctan2(offset[1], offset[0]) - KNOWN.pose[2] + 0.02])
    after = filter_step(KNOWN, STANDING, [5], z[:1], z[1:])
    e = offset / r
    H = np.array([e, [-e[1] / r, e[0] / r]])
    S = H @ KNOWN.covariances[1] @ H.T + np.diag([0.04, 0.0009])
    K = np.linalg.solve(S, H @ KNOWN.covariances[1]).T
    np.testing.assert_allclose(after.landmarks[1], KNOWN.landmarks[1] + K @ [0.3, 0.02])
    np.testing.assert_allclose(after.covariances[1], KNOWN.covariances[1] - K @ S @ K.T, atol=1e-15)
    np.testing.assert_allclose(after.pose, KNOWN.pose, atol=1e-12)


def test_a_new_landmark_has_the_covariance_of_its_measurement_and_of_the_steps_spread():
    state = hybrid_thesis.initial_state(np.array([1.0, 2.0, 0.5]), 5000)
    after = filter_step(state, STANDING, [4], [10.0], [0.2])
    c, s = np.cos(0.7), np.sin(0.7)
    np.testing.assert_allclose(after.landmarks, [[1.0 + 10.0 * c, 2.0 + 10.0 * s]])
    G = np.array([[c, -10.0 * s], [s, 10.0 * c]])
    np.testing.assert_allclose(after.covariances[0], G @ np.diag([0.04, 0.0009]) @ G.T)
    spread = filter_step(state, MOTION, [4], [10.0], [0.2])
    across = np.array([-np.sin(0.8), np.cos(0.8)])
    # Range 10 m: bearing and heading noise add in variance across the line of sight.
    expected = 100.0 * (0.03**2 + 0.05**2) + 0.02**2
    assert abs(across @ spread.covariances[0] @ across / expected - 1.0) < 0.1


def test_an_absorbed_map_replaces_what_it_knows_and_adds_what_it_does_not():
    landmarks = np.array([[1.0, 1.0], [5.0, 5.0]])
    covariances = np.array([0.01 * np.eye(2), 0.02 * np.eye(2)])
    after = hybrid_thesis.absorb_map(KNOWN, ids(5, 3), landmarks, covariances)
    np.testing.assert_array_equal(after.ids, [2, 3, 5, 8])
    np.testing.assert_array_equal(
        after.landmarks, [KNOWN.landmarks[0], landmarks[1], landmarks[0], KNOWN.landmarks[2]]
    )
    np.testing.assert_array_equal(after.covariances[1:3], covariances[::-1])
    np.testing.assert_array_equal(after.pose, KNOWN.pose)


SENSOR_HYBRID_THESIS_CODED = Sensor(range_sigma=2.0, bearing_sigma=0.1)
MOTION_HYBRID_THESIS_CODED = Increment(np.array([1.0, 0.0, 0.0]), np.diag([0.05, 0.0, 0.05]) ** 2)
ID = np.array([7], np.uint32)


def run(steps: int, particles: int = 50, seed: int = 1) -> list[CodedState]:
    generator = np.random.default_rng(seed)
    state = hybrid_thesis_coded.initial_state(np.zeros(3), particles)
    states = [state]
    for k in range(1, steps + 1):
        offset = np.array([10.0 - k, 5.0])
        measurement = np.array([np.hypot(*offset)]), np.array([np.arctan2(offset[1], offset[0])])
        step = RobotStep(
            "r1", MOTION_HYBRID_THESIS_CODED, SENSOR_HYBRID_THESIS_CODED, ID, *measurement
        )
        state = hybrid_thesis_coded.filter_step(state, step, generator)
        states.append(state)
    return states


def test_all_poses_and_landmarks_become_the_mean_and_covariances_stay_each_particles_own():
    state = run(3)[-1]
    assert len(np.unique(state.particles.poses, axis=0)) == 1
    assert len(np.unique(state.particles.means, axis=0)) == 1
    assert len(np.unique(state.particles.covariances, axis=0)) == 50
    assert len(np.unique(state.drawn.poses, axis=0)) == 50
    weights = np.exp(state.drawn.log_weights)
    np.testing.assert_allclose(
        state.particles.poses[0, :2], weights @ state.drawn.poses[:, :2], atol=1e-12
    )


def test_a_new_landmark_begins_with_15_m_and_the_printed_matrix():
    generator = np.random.default_rng(1)
    started = hybrid_thesis_coded.initial_state(np.zeros(3), 4)
    step = RobotStep(
        "r1", STANDING, SENSOR_HYBRID_THESIS_CODED, ID, np.array([10.0]), np.array([0.3])
    )
    state = hybrid_thesis_coded.filter_step(started, step, generator)
    s, c = np.sin(0.3), np.cos(0.3)
    Gz = np.array([[c, 10.0 * s], [s, 10.0 * c]])
    printed = Gz @ np.diag([15.0**2, 10.0 * np.pi / 18.0**2]) @ Gz.T
    found = state.particles.covariances[0, 0]
    np.testing.assert_allclose(found, [printed[0, 0], printed[0, 1], printed[1, 1]])
