"""Pose nodes of a window: where the particles were then, matched jointly with where they ended."""

import numpy as np

from teamslam.team import core
from teamslam.team.config import FrontEnd, Sensor
from teamslam.team.core import POSE_JITTER
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.models import Increment
from tests.estimation.submap_world import wrap

STEP = Increment(np.array([0.5, 0.0, 0.2]), np.diag([0.03, 0.01, 0.02]) ** 2)
NOTHING = (np.empty(0, np.uint32), np.empty(0), np.empty(0))
SENSOR = Sensor()
LANDMARKS = {4: (2.0, 1.0), 9: (1.0, -2.0)}


def seen():
    ids = np.array(sorted(LANDMARKS), np.uint32)
    points = np.array([complex(*LANDMARKS[int(i)]) for i in ids])
    return ids, np.abs(points), np.angle(points)


def driven(marks, particles=200, sensor=SENSOR, biases=()):
    """Four keyframes; landmarks are seen at the first; marked as nodes: those in `marks`."""
    random = core.Random(b"a key of 16 byte")
    window = windows.open_window(FrontEnd(particles=particles, biases=biases), sensor)
    for k in range(4):
        windows.advance(window, STEP, *(seen() if k == 0 else NOTHING), random)
        if k in marks:
            windows.mark_node(window, 1000 * k)
    return window


def off(poses, mean):
    """Log(mean⁻¹ ∘ pose) of each pose, turned by the mean's heading."""
    turn = wrap(poses[:, 2] - mean[2])
    apart = (poses[:, :2] - mean[:2]) @ np.array([1.0, 1j])
    apart *= 0.5 * turn / np.tan(0.5 * turn) - 0.5j * turn
    return np.column_stack([apart.real, apart.imag, turn])


def test_a_node_is_the_weighted_mean_of_the_particles_of_its_keyframe_on_se2():
    window = driven({1, 3})
    local = windows.gaussian(window)
    weights = np.exp(window.particles.log_weights)
    assert local.node_stamps.tolist() == [1000, 3000]
    for node, keyframe in zip(local.nodes, (1, 3), strict=True):
        poses = window.paths[keyframe]
        np.testing.assert_allclose((weights @ off(poses, node))[:2], 0.0, atol=1e-12)
        direction = np.angle(weights @ np.exp(1j * poses[:, 2]))
        np.testing.assert_allclose(wrap(node[2] - direction), 0.0, atol=1e-12)


def test_the_covariance_of_nodes_and_end_is_that_of_the_particles_paths():
    window = driven({1, 2})
    local = windows.gaussian(window)
    weights = np.exp(window.particles.log_weights)
    poses = window.particles.poses, window.paths[1], window.paths[2]
    means = local.end_pose, *local.nodes
    deviations = np.hstack([off(*each) for each in zip(poses, means, strict=True)])
    expected = (weights[:, None] * deviations).T @ deviations
    effective = 1.0 / np.sum(weights**2)
    expected *= effective / (effective - 5.0)  # what a sample's inverse is too large by
    expected += np.diag(np.tile(POSE_JITTER, 3))
    np.testing.assert_allclose(local.covariance[:9, :9], expected, atol=1e-12)


def test_marking_nodes_changes_nothing_else_in_the_submap():
    plain, marked = (windows.gaussian(driven(marks)) for marks in (set(), {0, 2}))
    bare = marked.without_nodes
    assert bare.ids.tobytes() == plain.ids.tobytes()
    assert bare.mean.tobytes() == plain.mean.tobytes()
    np.testing.assert_allclose(bare.covariance, plain.covariance, rtol=1e-15, atol=1e-18)


def test_a_node_at_the_windows_end_is_the_end_pose_up_to_the_jitter():
    local = windows.gaussian(driven({3}))
    assert local.nodes[0].tolist() == local.end_pose.tolist()
    same = local.covariance[:3, :3] - local.covariance[:3, 3:6]
    np.testing.assert_allclose(same, np.diag(POSE_JITTER), atol=1e-15)


def test_a_running_gaussian_is_the_windows_without_its_pose_nodes():
    window = driven({0, 2}, sensor=Sensor(range_white=0.5), biases=("bearing", "range_scale"))
    running, bare = windows.gaussian(window, running=True), windows.gaussian(window).without_nodes
    assert not len(running.node_stamps)
    assert running.biases == bare.biases
    assert running.mean.tobytes() == bare.mean.tobytes()
    assert running.sensitivity.tobytes() == bare.sensitivity.tobytes()
    assert running.covariance.tobytes() == bare.covariance.tobytes()
