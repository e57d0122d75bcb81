from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import RobotStream
from teamslam.team import translate
from teamslam.team.config import FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.core import Keyframe, OdometryInterval, Scan, predicted
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.pipeline import HybridSlam, OpenWindow
from teamslam.team.estimation.models import increment_of
from teamslam.team.estimation.se2 import compose
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import messages as m
from tests.scenarios import final_only, with_front_ends, with_world
from tests.teams import config, driven, published, stream

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


def robot() -> RobotConfig:
    plain = config()
    front_end = msgspec.structs.replace(plain.front_end, window_s=5.0)
    return msgspec.structs.replace(plain, front_end=front_end)


def spoilt(given: RobotStream) -> RobotStream:
    seen = given.landmark_detections
    rows = np.arange(len(seen.ids)) % 5 == 2
    ranges = np.where(rows, 2.0 + seen.ranges, seen.ranges)
    bearings = np.where(rows, 0.8 - seen.bearings, seen.bearings)
    return replace(given, landmark_detections=replace(seen, ranges=ranges, bearings=bearings))


def submaps(of: RobotConfig, measurements: list[m.Measurement]) -> list[m.Submap]:
    sent = driven(RobotNode(of), measurements)
    return [each.message for each in sent if isinstance(each.message, m.Submap)]


def test_a_submap_is_as_if_the_outliers_had_never_been_measured():
    clean = stream("r1", 20)
    seen = clean.landmark_detections
    rows = np.arange(len(seen.ids)) % 5 == 2
    kept = np.concatenate(([0], np.cumsum(~rows)))
    less = replace(
        clean,
        landmark_detections=replace(
            seen, offsets=kept[seen.offsets], ids=seen.ids[~rows], ranges=seen.ranges[~rows],
            bearings=seen.bearings[~rows],
        ),
    )  # fmt: skip
    found, expected = (submaps(robot(), published(each)) for each in (spoilt(clean), less))
    pairs = [each for each in zip(found, expected, strict=True) if each[0].ids == each[1].ids]
    assert len(pairs) >= len(found) - 1, "in one window landmarks with one measurement are left out"
    for one, other in pairs:
        assert (one.mean, one.covariance) == (other.mean, other.covariance)
    assert sum(s.gated for s in found) >= np.count_nonzero(rows)


def test_of_clean_measurements_none_is_gated_and_each_window_is_computed_once(monkeypatch):
    confirm, particles = OpenWindow.confirm, config().front_end.particles

    def counted(window: OpenWindow) -> None:
        confirm(window)
        with_more = len(window.particles.particles.poses) > particles
        assert window.core.restarts == with_more, "computed again, and not with more particles"

    monkeypatch.setattr(OpenWindow, "confirm", counted)
    assert sum(s.gated for s in submaps(config(), published(stream("r1", 20)))) == 0


def world_with(kind: str, steps: int = 200) -> Scenario:
    scenario = load("thesis-b")
    scenario = with_world(scenario, steps=steps, outlier_share=0.3, outlier_kind=kind)
    return with_front_ends(scenario, particles=60)


def aligned_rmse(scenario: Scenario) -> float:
    found = evaluate(list(run_team(final_only(scenario), streams_of(scenario)))).map
    assert found.errors.aligned_rmse_m is not None
    return found.errors.aligned_rmse_m


@pytest.fixture(scope="module")
def clean_rmse():
    return aligned_rmse(world_with("drop"))


@pytest.mark.parametrize("kind", ["measurement", "identity"])
def test_with_outliers_the_map_is_nearly_that_of_the_good_measurements(kind, clean_rmse):
    assert aligned_rmse(world_with(kind)) < 1.3 * clean_rmse
