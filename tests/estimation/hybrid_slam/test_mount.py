"""A sensor away from its base: poses, submaps and derivatives are the base's."""

import msgspec
import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.config import FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.hybrid_slam.fastslam import noise_of
from teamslam.team.estimation.hybrid_slam.pipeline import HybridSlam
from teamslam.team.estimation.models import Increment, increment_of, predicted
from teamslam.team.estimation.mount import of_base, of_sensor
from teamslam.team.estimation.odometry import OdometryInterval
from teamslam.team.estimation.scans import polar_scan
from teamslam.team.estimation.se2 import compose

MOUNT = (3.78, 0.5, -0.6)
SECOND = 1_000_000_000
PLACES = np.array([[6.0, 3.0], [9.0, -4.0], [2.0, 7.0]])
STEADY = MotionModel(
    forward=MotionNoise(0.02), turn=MotionNoise(0.01), lateral=MotionNoise(0.01)
)  # fmt: skip


def closed(mount=MOUNT, sensor_mount=MOUNT, biases=(), shift: float = 0.0):
    """A window over an arc: its submap, and the true end of the base."""
    sensor = Sensor(range_sigma=0.01, bearing_sigma=0.002, mount=sensor_mount)
    front = FrontEnd(particles=400, window_s=100.0, biases=biases)
    slam = HybridSlam(RobotConfig("r1", motion=STEADY, sensor=sensor, front_end=front), 1)
    pose = np.zeros(3)
    for k in range(1, 9):
        pose = compose(pose, increment_of(STEADY, 1.0, 1.0, 0.2).mean)
        z = np.array([predicted(compose(pose, np.array(mount)), p) for p in PLACES])
        scan = polar_scan(np.arange(3, dtype=np.uint32), z[:, 0], z[:, 1] + shift)
        slam.observe(k * SECOND, scan)
        slam.drive(OdometryInterval(k * SECOND, SECOND, 1.0, 0.2))
    return slam.finish()[0].local, pose


def test_the_submap_of_a_mounted_sensor_is_the_bases() -> None:
    local, end = closed()
    sigmas = np.sqrt(np.diag(local.covariance))
    truth = np.concatenate((end, PLACES.ravel()))
    assert np.all(np.abs(local.mean - truth) < 3.0 * sigmas + 1e-3)
    assert sigmas.max() < 0.1
    wrong, _ = closed(sensor_mount=(0.0, 0.0, 0.0))
    assert not len(wrong.ids), "without the mount the window rejects them: they contradict its path"


def test_the_sensors_motion_is_the_bases_seen_from_the_sensor_and_back() -> None:
    step = increment_of(STEADY, 1.0, 1.0, 0.2)
    mount = np.array(MOUNT)
    back = of_base(of_sensor(step, mount), mount)
    np.testing.assert_allclose(back.mean, step.mean, atol=1e-12)
    np.testing.assert_allclose(back.covariance, step.covariance, atol=1e-12)


def test_a_window_of_the_base_has_the_bases_poses_and_landmarks() -> None:
    still, unclaimed = np.zeros((3, 3)), np.empty((1, 0))
    step, mount = increment_of(STEADY, 1.0, 1.0, 0.2).mean, np.array(MOUNT)
    moved = of_sensor(Increment(step, still), mount).mean
    r, b = predicted(compose(mount, moved), PLACES[0])
    window = core.Window(1, noise_of(Sensor()), True, MOUNT)
    seen = np.array([3], np.uint32), np.array([r]), np.array([b]), unclaimed
    window.advance(moved, still, *seen, None, np.zeros((1, 3)))
    poses, _, _, means, _ = window.of_base().particles()
    np.testing.assert_allclose(poses[0], step, atol=1e-12)
    np.testing.assert_allclose(means[0, 0], PLACES[0], atol=1e-12)


@pytest.mark.parametrize("mount", [MOUNT, (0.0, 0.0, 0.0)])
def test_the_derivative_by_a_bias_is_that_of_the_bases_submap(mount) -> None:
    local, _ = closed(mount, mount, ("bearing",))
    up, down = (closed(mount, mount, shift=s)[0].mean for s in (1e-3, -1e-3))
    told, found = local.sensitivity[0], (up - down) / 2e-3
    assert np.abs(told + found).max() < 0.05 * np.abs(found).max(), "it takes the error out"


def test_a_mount_of_nothing_is_no_mount() -> None:
    assert not Sensor().is_mounted
    assert msgspec.structs.replace(Sensor(), mount=(0.0, 0.0, 0.1)).is_mounted
