import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import core
from teamslam.team.config import FrontEnd, Gnss, MotionModel, MotionNoise, Sensor
from teamslam.team.core import POSE_JITTER, OdometryInterval
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.pipeline import HybridSlam
from teamslam.team.estimation.hybrid_slam.pose_grid import PoseGrid
from teamslam.team.estimation.inter_robot import CarriedPoint
from teamslam.team.estimation.map_joining.conditioning import SubmapCorrection
from teamslam.team.estimation.models import Increment, segmenter_of
from tests.estimation.submap_world import seen_from, wrap
from tests.teams import config

SECOND = 1_000_000_000
MOTION = MotionModel(forward=MotionNoise(per_s=0.05), turn=MotionNoise(per_s=0.02))
FRONT = FrontEnd(node_s=2.0, window_s=7.0, sighting_s=1.0, teammate_speed=0.0)


def initial_state(front=FRONT, sensor=None, keyframe_s=0.0, at_ns=0):
    segmenter = segmenter_of(MOTION, sensor or Sensor(), keyframe_s)
    grid = PoseGrid(segmenter, sensor or Sensor(), front)
    segmenter.begin(at_ns)
    grid.begin(at_ns)
    return grid, segmenter


def look(teammate="r2", distance=3.0, bearing=0.5):
    return (teammate,), np.array([distance]), np.array([bearing])


def drive(segmenter, grid, until_s, step_ns=SECOND, forward=0.6, yaw_rate=0.25):
    keyframes, now = [], segmenter.now_ns
    while now < round(until_s * SECOND):
        now += step_ns
        segmenter.drive(now, step_ns, forward, yaw_rate)
        if grid is not None:
            grid.pass_stops()
        keyframes += segmenter.take_keyframes()
    return keyframes


def arc(seconds, forward=0.6, yaw_rate=0.25):
    angle = yaw_rate * seconds
    middle = forward / yaw_rate * (np.exp(1j * angle) - 1.0) / 1j
    return np.array([middle.real, middle.imag, angle])


@settings(deadline=None, max_examples=40)
@given(st.lists(st.integers(0, 7 * SECOND - 1), max_size=5), st.sampled_from([0.0, 0.5]))
def test_no_motion_is_lost_or_counted_twice_at_nodes_and_sightings(stamps, keyframe_s):
    grid, with_nodes = initial_state(keyframe_s=keyframe_s)
    plain = segmenter_of(MOTION, Sensor(), keyframe_s)
    plain.begin(0)
    scan = core.Scan(np.array([1], np.uint32), np.array([2.0]), np.array([0.0]))
    for counter, stamp in enumerate(sorted(stamps)):
        grid.observe(stamp, counter, look())
        for segmenter in (with_nodes, plain):
            segmenter.observe(stamp, scan)
    ends = []
    for segmenter, at in ((with_nodes, grid), (plain, None)):
        keyframes = drive(segmenter, at, 7.0)
        rest = segmenter.cut(7 * SECOND)
        keyframes += segmenter.take_keyframes()
        total = Increment.identity()
        for keyframe in (*keyframes, rest):
            total = total.then(Increment(*keyframe.motion))
        ends.append(total)
        assert sum(len(each.scan) for each in keyframes) > 0 or not stamps
    np.testing.assert_allclose(ends[0].mean, ends[1].mean, atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.floats(1.01, 2.99), st.floats(0.5, 8.0), st.floats(-3.0, 3.0))
def test_a_sighting_is_carried_along_the_arc_to_its_node(at_s, distance, bearing):
    grid, segmenter = initial_state()
    observer = arc(at_s)
    point = observer[0] + 1j * observer[1] + distance * np.exp(1j * (observer[2] + bearing))
    assert grid.observe(round(at_s * SECOND), 5, look("r2", distance, bearing)) is None
    drive(segmenter, grid, 4.0, 250_000_000)
    (found,) = grid.sightings()
    to = seen_from(arc(2.0), point)
    assert (found.stamp_ns, found.teammate, found.measurements) == (2 * SECOND, "r2", (5,))
    assert found.measurement[0] == pytest.approx(abs(to), abs=1e-6)
    assert wrap(found.measurement[1] - np.angle(to)) == pytest.approx(0.0, abs=1e-6)
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_a_teammate_that_may_move_is_known_less_well_the_farther_its_node_is_in_time():
    moving = msgspec.structs.replace(FRONT, teammate_speed=0.5)
    variances = []
    for at_ns in (2 * SECOND, 2_500_000_000, 3 * SECOND - 1):
        grid, segmenter = initial_state(moving)
        grid.observe(at_ns, 1, look())
        drive(segmenter, grid, 4.0, forward=0.0, yaw_rate=0.0)
        variances.append(grid.sightings()[0].covariance[0, 0])
    assert variances[1] - variances[0] == pytest.approx(0.25**2, abs=0.01)
    assert variances[2] - variances[0] == pytest.approx(0.5**2, abs=0.01)


def test_looks_at_one_teammate_near_one_node_are_one_sighting_of_the_median():
    grid, segmenter = initial_state()
    for counter, (at_s, distance) in enumerate([(1.6, 3.0), (1.9, 3.1), (2.2, 9.0), (2.4, 3.2)]):
        grid.observe(round(at_s * SECOND), counter, look("r3", distance))
    grid.observe(2_300_000_000, 9, look("r2", 5.0))
    drive(segmenter, grid, 4.0, forward=0.0, yaw_rate=0.0)
    first, second = grid.sightings()
    assert (first.teammate, first.measurements, first.measurement[0]) == ("r2", (9,), 5.0)
    assert (second.teammate, second.measurements) == ("r3", (0, 1, 2, 3))
    assert second.measurement[0] == pytest.approx(3.15)


def test_the_sensors_calibration_and_the_markers_offset_are_taken_off():
    sensor = Sensor(range_offset=0.1, range_scale=2.0, marker_range_offset=0.5, max_range=9.0)
    grid, segmenter = initial_state(sensor=sensor)
    looks = (("r2", "r3", "r4"), np.array([4.1, 9.5, 0.9]), np.zeros(3))
    assert grid.observe(2 * SECOND, 1, looks) is None
    drive(segmenter, grid, 4.0, forward=0.0, yaw_rate=0.0)
    (found,) = grid.sightings()
    assert (found.teammate, found.measurement[0]) == ("r2", pytest.approx(1.5))
    assert grid.observe(4 * SECOND, 2, look("r3", 9.5)) == "outside the sensor's limits"


def test_a_slam_closes_its_windows_with_their_nodes_and_sightings():
    front = msgspec.structs.replace(config().front_end, node_s=1.5, sighting_s=0.5)
    slam = HybridSlam(config(front_end=front), 1)
    closed = []
    for k in range(1, 7):
        slam.last_measurement = k
        if k > 1:
            reason = slam.sight(k * SECOND - 500_000_000, k, look())
            assert reason == ("no pose node near it" if k == 4 else None), "its node was the end"
        window = slam.drive(OdometryInterval(k * SECOND, SECOND, 0.5, 0.1))
        closed += [] if window is None else [window]
    assert [w.local.node_stamps.tolist() for w in closed] == [
        [1_500_000_000, 3 * SECOND],
        [4_500_000_000, 6 * SECOND],
    ]
    assert [[(s.stamp_ns, s.measurements) for s in w.sightings] for w in closed] == [
        [(1_500_000_000, (2,)), (3 * SECOND, (3,))],
        [(4_500_000_000, (5,)), (6 * SECOND, (6,))],
    ]


def test_measurements_that_arrive_out_of_order_are_used_at_their_times():
    found = []
    for order in ((1_800_000_000, 2_500_000_000), (2_500_000_000, 1_800_000_000)):
        grid, segmenter = initial_state()
        for stamp_ns in order:
            grid.observe(stamp_ns, stamp_ns // 10**8, look())
        drive(segmenter, grid, 6.0)
        found.append(grid.sightings())
    (one,), (other,) = found
    assert one.measurements == other.measurements == (18, 25)
    assert one.measurement == pytest.approx(other.measurement, abs=1e-12)


STEP = Increment(np.array([0.5, 0.0, 0.2]), np.diag([0.03, 0.01, 0.02]) ** 2)
NOTHING = (np.empty(0, np.uint32), np.empty(0), np.empty(0))
SENSOR = Sensor()
LANDMARKS = {4: (2.0, 1.0), 9: (1.0, -2.0)}


def seen():
    ids = np.array(sorted(LANDMARKS), np.uint32)
    points = np.array([complex(*LANDMARKS[int(i)]) for i in ids])
    return ids, np.abs(points), np.angle(points)


def driven(marks, particles=200, sensor=SENSOR, biases=()):
    random = core.Random(b"a key of 16 byte")
    window = windows.open_window(FrontEnd(particles=particles, biases=biases), sensor)
    for k in range(4):
        windows.advance(window, STEP, *(seen() if k == 0 else NOTHING), random)
        if k in marks:
            window.core.mark(1000 * k)
    return window


def off(poses, mean):
    """Log(mean⁻¹ ∘ pose) of each pose, rotated by the mean's heading."""
    turn = wrap(poses[:, 2] - mean[2])
    apart = (poses[:, :2] - mean[:2]) @ np.array([1.0, 1j])
    apart *= 0.5 * turn / np.tan(0.5 * turn) - 0.5j * turn
    return np.column_stack([apart.real, apart.imag, turn])


def test_the_covariance_of_nodes_and_end_is_that_of_the_particles_paths():
    window = driven({1, 2})
    local = windows.gaussian(window)
    weights = np.exp(window.particles.log_weights)
    poses = window.particles.poses, window.paths[1], window.paths[2]
    means = local.end_pose, *local.nodes
    deviations = np.hstack([off(*each) for each in zip(poses, means, strict=True)])
    expected = (weights[:, None] * deviations).T @ deviations
    effective = 1.0 / np.sum(weights**2)
    expected *= effective / (effective - 5.0)  # bias of a sample covariance's inverse
    expected += np.diag(np.tile(POSE_JITTER, 3))
    np.testing.assert_allclose(local.covariance[:9, :9], expected, atol=1e-12)


def test_a_running_gaussian_is_the_windows_without_its_pose_nodes():
    window = driven({0, 2}, sensor=Sensor(range_white=0.5), biases=("bearing", "range_scale"))
    running, bare = windows.running(window), windows.gaussian(window).without_nodes
    assert running.map.mean.tobytes() == bare.mean.tobytes()
    assert running.map.covariance.tobytes() == bare.covariance.tobytes()
    shared = SubmapCorrection(1.3, (("bearing", 0.02, 0.01), ("range_scale", 0.1, 0.0)))
    corrected, expected = running.corrected(*shared), shared.taken(bare)
    assert corrected.mean.tobytes() == expected.mean.tobytes()
    assert corrected.covariance.tobytes() == expected.covariance.tobytes()


@pytest.mark.parametrize("delay_s", [0.4, -0.4])
@pytest.mark.parametrize("fixed_s", [1.7, 2.3])
def test_a_delayed_fix_is_of_the_antenna_where_it_was_by_the_delay_before_its_stamp(
    delay_s, fixed_s
):
    antenna = np.array([0.8, -0.5])
    segmenter = segmenter_of(MOTION, Sensor(), 0.0)
    gnss = Gnss(antenna=tuple(antenna), delay_s=delay_s)
    grid = PoseGrid(segmenter, Sensor(), FRONT, gnss, MOTION)
    segmenter.begin(0)
    grid.begin(0)
    position = CarriedPoint(np.array([10.0, 20.0]), np.eye(2))
    assert grid.fix(round(fixed_s * SECOND), 3, position) is None
    drive(segmenter, grid, 5.0, 100_000_000)
    (found,) = grid.sightings()
    (x, y, turn), (x0, y0, turn0) = arc(fixed_s - delay_s), arc(2.0)
    true = x + 1j * y + complex(*antenna) * np.exp(1j * turn)
    expected = (true - (x0 + 1j * y0)) * np.exp(-1j * turn0)
    assert found.stamp_ns == 2 * SECOND
    np.testing.assert_allclose(found.point, [expected.real, expected.imag], atol=1e-9)
