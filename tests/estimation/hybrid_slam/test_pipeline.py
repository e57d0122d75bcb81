from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teamslam.team import translate
from teamslam.team.config import FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.core import Keyframe, OdometryInterval, Scan
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.pipeline import HybridSlam, OpenWindow
from teamslam.team.estimation.models import increment_of, predicted
from teamslam.team.estimation.se2 import compose
from teamslam.team.wire import messages as m
from tests.teams import config, published, stream

MEASUREMENTS = published(stream("r1", 12, off_ns=300_000_000))


def fed(slam, measurements):
    closed = []
    for measurement in measurements:
        slam.last_measurement = measurement.number
        if isinstance(measurement, m.Observations):
            slam.observe(measurement.stamp_ns, translate.scan_of(measurement))
        if isinstance(measurement, m.Odometry):
            window = slam.drive(translate.interval_of(measurement, config()))
            closed += [] if window is None else [window]
    return closed


def fresh():
    return HybridSlam(config(), 1)


def same(a, b):
    return (
        (a.sequence, a.first_measurement, a.last_measurement, a.start_ns, a.end_ns)
        == (b.sequence, b.first_measurement, b.last_measurement, b.start_ns, b.end_ns)
        and a.local.ids.tobytes() == b.local.ids.tobytes()
        and a.local.mean.tobytes() == b.local.mean.tobytes()
        and a.local.covariance.tobytes() == b.local.covariance.tobytes()
    )


def test_windows_are_contiguous_in_measurements_and_time():
    slam = fresh()
    closed = fed(slam, MEASUREMENTS)
    ended, uncovered = slam.finish()
    assert uncovered == 0
    assert ended is None, "the last window ended with the last odometry"
    assert [w.sequence for w in closed] == [0, 1, 2, 3]
    assert closed[0].first_measurement == 0
    assert closed[-1].last_measurement == len(MEASUREMENTS) - 1
    for before, after in pairwise(closed):
        assert after.first_measurement == before.last_measurement + 1
        assert after.start_ns == before.end_ns


@settings(deadline=None, max_examples=12)
@given(st.integers(0, 3), st.integers(1, 3))
def test_after_a_resume_the_following_windows_are_the_same_byte_for_byte(taken, looks):
    whole = fed(fresh(), MEASUREMENTS)
    slam = fresh()
    if taken:
        last = whole[taken - 1]
        slam.resume(last.sequence, last.last_measurement, last.end_ns)
    for _ in range(looks):
        slam.running()
    first = whole[taken - 1].last_measurement + 1 if taken else 0
    again = fed(slam, MEASUREMENTS[first:])
    assert len(again) == len(whole) - taken
    assert all(same(a, b) for a, b in zip(again, whole[taken:], strict=True))


def standing(window_m):
    front_end = FrontEnd(particles=8, window_s=10.0, window_m=window_m, standing_s=30.0, node_s=5.0)
    slam = HybridSlam(RobotConfig("r1", motion=NOISY, front_end=front_end), 1)
    closed = []
    for second in range(1, 61):
        looks = ("r2",), np.array([2.0]), np.array([0.1])
        if second % 5 == 0:
            assert slam.sight(second * 10**9 - 1, second, looks) is None
        driven = slam.drive(
            OdometryInterval(second * 10**9, 10**9, 0.1 if second > 45 else 0.0, 0.0)
        )
        closed += [] if driven is None else [driven]
    return closed


NOISY = MotionModel(forward=MotionNoise(per_s=0.01), turn=MotionNoise(per_s=0.01))


def test_the_window_of_a_standing_robot_goes_on_until_it_moves_or_has_lasted_long_enough():
    assert [w.end_ns // 10**9 for w in standing(0.0)] == [10, 20, 30, 40, 50, 60]
    # A stop lasts at most 30 s; it moves at 46 s, and the next ten end by 56 s.
    assert [w.end_ns // 10**9 for w in standing(0.05)] == [30, 46, 56]


def test_a_long_window_has_all_its_nodes_and_loses_no_sighting():
    for window_m in (0.0, 0.05):
        closed = standing(window_m)
        nodes = [t // 10**9 for w in closed for t in w.local.node_stamps.tolist()]
        assert nodes == list(range(5, 5 + 5 * len(nodes), 5))
        assert [s.stamp_ns // 10**9 for w in closed for s in w.sightings] == nodes
        assert nodes[-1] >= 55


MOUNT = (3.78, 0.5, -0.6)
SECOND = 1_000_000_000
PLACES = np.array([[6.0, 3.0], [9.0, -4.0], [2.0, 7.0]])
STEADY = MotionModel(
    forward=MotionNoise(0.02), turn=MotionNoise(0.01), lateral=MotionNoise(0.01)
)  # fmt: skip


def closed(mount=MOUNT, sensor_mount=MOUNT, biases=(), shift: float = 0.0):
    sensor = Sensor(range_sigma=0.01, bearing_sigma=0.002, mount=sensor_mount)
    front = FrontEnd(particles=400, window_s=100.0, biases=biases)
    slam = HybridSlam(RobotConfig("r1", motion=STEADY, sensor=sensor, front_end=front), 1)
    pose = np.zeros(3)
    for k in range(1, 9):
        pose = compose(pose, increment_of(STEADY, 1.0, 1.0, 0.2).mean)
        z = np.array([predicted(compose(pose, np.array(mount)), p) for p in PLACES])
        scan = Scan(np.arange(3, dtype=np.uint32), z[:, 0], z[:, 1] + shift)
        slam.observe(k * SECOND, scan)
        slam.drive(OdometryInterval(k * SECOND, SECOND, 1.0, 0.2))
    return slam.finish()[0].local, pose


def test_the_submap_of_a_mounted_sensor_is_the_bases():
    local, end = closed()
    sigmas = np.sqrt(np.diag(local.covariance))
    truth = np.concatenate((end, PLACES.ravel()))
    assert np.all(np.abs(local.mean - truth) < 3.0 * sigmas + 1e-3)
    assert sigmas.max() < 0.1
    wrong, _ = closed(sensor_mount=(0.0, 0.0, 0.0))
    assert not len(wrong.ids), "without the mount the window rejects them: they contradict its path"


@pytest.mark.parametrize("mount", [MOUNT, (0.0, 0.0, 0.0)])
def test_the_derivative_by_a_bias_is_that_of_the_bases_submap(mount):
    local, _ = closed(mount, mount, ("bearing",))
    up, down = (closed(mount, mount, shift=s)[0].mean for s in (1e-3, -1e-3))
    told, found = local.sensitivity[0], (up - down) / 2e-3
    assert np.abs(told + found).max() < 0.05 * np.abs(found).max(), "it takes the error out"


@pytest.mark.parametrize(
    ("variance", "range_m"), [(-1.0, 2.0), (np.nan, 2.0), (1e-4, np.nan)], ids=str
)
def test_a_keyframe_that_is_no_gaussian_leaves_a_window_without_solution(variance, range_m):
    window = OpenWindow(config(), 1, 0)
    ids, bearings = np.array([3], np.uint32), np.zeros(1)
    still = np.zeros(3), 1e-4 * np.eye(3)
    window.core.advance(Keyframe(1, still, Scan(ids, np.array([2.0]), bearings)))
    assert window.solve(windows.running) is not None
    moved = np.zeros(3), variance * np.eye(3)
    window.core.advance(Keyframe(2, moved, Scan(ids, np.array([range_m]), bearings)))
    assert window.solve(windows.running) is None
    window.confirm()
    assert window.solve(windows.gaussian) is None
