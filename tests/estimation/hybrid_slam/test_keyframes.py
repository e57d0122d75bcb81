import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import core
from teamslam.team.config import MotionModel, MotionNoise, Sensor
from teamslam.team.core import OdometryInterval, Scan, located
from teamslam.team.estimation import se2
from teamslam.team.estimation.models import Increment, increment_of, segmenter_of
from teamslam.team.rejection import BY_CORE, Rejection
from tests.core.test_odometry import shift_of

SECOND = 1_000_000_000
WHITE = MotionModel(
    forward=MotionNoise(per_s=0.05, per_m=0.1),
    turn=MotionNoise(per_s=0.03, per_m=0.02, per_rad=0.1),
    final_turn=MotionNoise(per_s=0.01),
)
NOTHING = Scan(np.empty(0, np.uint32), np.empty(0), np.empty(0))


def scan(*rows):
    ids, ranges, bearings = zip(*rows, strict=True)
    return Scan(np.array(ids, np.uint32), np.array(ranges, float), np.array(bearings, float))


def driven(segmenter, *interval):
    segmenter.drive(*interval)
    return segmenter.take_keyframes()


def total(keyframes, rest):
    motion = Increment.identity()
    for keyframe in keyframes:
        motion = motion.then(Increment(*keyframe.motion))
    return motion.then(Increment(*rest.motion))


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, SECOND), max_size=6), st.floats(-2.0, 2.0), st.floats(-1.5, 1.5))
def test_observations_within_an_interval_split_its_mean_exactly(cuts, forward, yaw_rate):
    split, whole = (segmenter_of(WHITE, Sensor(), 0.0) for _ in range(2))
    for segmenter in (split, whole):
        segmenter.begin(0)
    for cut in sorted(cuts):
        assert split.observe(cut, NOTHING) == 0
    keyframes = driven(split, SECOND, SECOND, forward, yaw_rate)
    whole.drive(SECOND, SECOND, forward, yaw_rate)
    assert [keyframe.stamp_ns for keyframe in keyframes] == sorted(cuts)
    motion, expected = total(keyframes, split.cut(SECOND)), total([], whole.cut(SECOND))
    np.testing.assert_allclose(motion.mean, expected.mean, atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, SECOND), max_size=6), st.floats(-2.0, 2.0))
def test_splitting_a_straight_interval_keeps_the_covariance_of_white_noise_forward(cuts, forward):
    only_forward = MotionModel(forward=MotionNoise(per_s=0.05, per_m=0.1))
    heading = MotionModel(final_turn=MotionNoise(per_s=0.05))
    for motion, row in ((only_forward, 0), (heading, 2)):
        segmenter = segmenter_of(motion, Sensor(), 0.0)
        segmenter.begin(0)
        for cut in sorted(cuts):
            segmenter.observe(cut, NOTHING)
        keyframes = driven(segmenter, SECOND, SECOND, forward, 0.0)
        found = total(keyframes, segmenter.cut(SECOND)).covariance
        density = motion.forward if row == 0 else motion.final_turn
        expected = density.per_s**2 + density.per_m**2 * abs(forward)
        assert found[row, row] == pytest.approx(expected, abs=1e-9)


def test_an_observation_waits_for_the_odometry_that_covers_it():
    segmenter = segmenter_of(MotionModel(), Sensor(), 0.0)
    segmenter.begin(0)
    segmenter.observe(3 * SECOND // 2, scan((4, 2.0, 0.0)))
    assert driven(segmenter, SECOND, SECOND, 1.0, 0.0) == []
    assert segmenter.uncovered == 1
    (keyframe,) = driven(segmenter, 2 * SECOND, SECOND, 1.0, 0.0)
    assert (keyframe.stamp_ns, segmenter.uncovered) == (3 * SECOND // 2, 0)
    np.testing.assert_allclose(keyframe.motion[0], [1.5, 0.0, 0.0], atol=1e-12)


def test_an_observation_before_the_odometry_is_taken_where_the_robot_stood():
    segmenter = segmenter_of(MotionModel(), Sensor(), 0.0)
    assert segmenter.observe(-SECOND, scan((4, 2.0, 0.0))) == 0
    segmenter.begin(0)
    (keyframe,) = driven(segmenter, SECOND, SECOND, 1.0, 0.0)
    assert keyframe.stamp_ns == 0
    assert not keyframe.motion[0].any()


def test_an_observation_of_a_time_that_is_past_is_rejected_with_its_reason():
    segmenter = segmenter_of(MotionModel(), Sensor(), 0.0)
    segmenter.begin(0)
    segmenter.drive(SECOND, SECOND, 1.0, 0.0)
    assert BY_CORE[segmenter.observe(SECOND - 1, scan((4, 2.0, 0.0)))] is Rejection.OLDER
    assert segmenter.observe(SECOND, scan((4, 2.0, 0.0))) == 0


def test_a_scan_is_calibrated_and_what_the_sensor_can_not_see_is_left_out():
    sensor = Sensor(min_range=1.0, max_range=9.0, range_offset=0.5, range_scale=2.0)
    segmenter = segmenter_of(MotionModel(), sensor, 0.0)
    segmenter.begin(0)
    outside = segmenter.observe(SECOND, scan((1, 0.9, 0.0), (2, 9.1, 0.0)))
    assert BY_CORE[outside] is Rejection.SENSOR_LIMITS
    segmenter.observe(SECOND, scan((1, 0.9, 0.0), (2, 4.5, 0.25)))
    (keyframe,) = driven(segmenter, SECOND, SECOND, 1.0, 0.0)
    seen = keyframe.scan
    assert (seen.ids.tolist(), seen.ranges.tolist(), seen.bearings.tolist()) == ([2], [2.0], [0.25])


def keyframe(scans, forward=0.0, yaw_rate=0.0):
    segmenter = segmenter_of(MotionModel(), Sensor(), 1.0)
    segmenter.begin(0)
    for stamp_ns, rows in scans:
        segmenter.observe(stamp_ns, rows)
    (keyframe,) = driven(segmenter, SECOND, SECOND, forward, yaw_rate)
    return keyframe.scan


@settings(deadline=None, max_examples=40)
@given(
    st.floats(-2.0, 2.0),
    st.floats(-1.5, 1.5),
    st.lists(st.integers(1, SECOND), min_size=1, max_size=5),
)
def test_a_keyframes_scans_are_moved_by_the_odometry_to_its_end(forward, yaw_rate, stamps):
    """Exact measurements of one point from anywhere on the arc are one measurement from its end."""
    point = 4.0 + 3.0j

    def seen_at(seconds):
        turn = yaw_rate * seconds
        arc = seconds * np.exp(0.5j * turn) * np.sinc(0.5 * turn / np.pi)
        local = (point - forward * arc) * np.exp(-1j * turn)
        return abs(local), np.angle(local)

    found = keyframe(
        [(t, scan((7, *seen_at(t * 1e-9)))) for t in sorted(stamps)], forward, yaw_rate
    )
    np.testing.assert_allclose([found.ranges[0], found.bearings[0]], seen_at(1.0), atol=1e-9)


def test_the_median_of_bearings_beside_the_cut_at_pi_lies_beside_it_too():
    scans = [
        (SECOND // 5 * k, scan((7, 5.0, b)))
        for k, b in enumerate([np.pi - 0.01, -np.pi + 0.03, -np.pi + 0.01], 1)
    ]
    (bearing,) = keyframe(scans).bearings
    assert bearing == pytest.approx(-np.pi + 0.01, abs=1e-9)
    (straight_back,) = keyframe([(1, scan((7, 5.0, np.pi)))]).bearings
    assert straight_back == pytest.approx(np.pi)


def test_a_cut_closes_the_keyframe_and_the_next_window_starts_clean():
    segmenter = segmenter_of(MotionModel(), Sensor(), 5.0)
    segmenter.begin(0)
    segmenter.observe(SECOND // 2, scan((7, 5.0, 0.0)))
    assert driven(segmenter, SECOND, SECOND, 1.0, 0.0) == []
    rest = segmenter.cut(SECOND)
    (keyframe,) = segmenter.take_keyframes()
    assert (keyframe.stamp_ns, keyframe.scan.ids.tolist()) == (SECOND, [7])
    np.testing.assert_allclose(keyframe.scan.ranges, [4.5])
    assert not rest.motion[0].any()
    assert driven(segmenter, 2 * SECOND, SECOND, 1.0, 0.0) == []
    rest = segmenter.cut(2 * SECOND)
    assert segmenter.take_keyframes() == []
    np.testing.assert_allclose(rest.motion[0], [1.0, 0.0, 0.0])


@pytest.mark.parametrize("kind", ["velocity", "turn-then-drive"])
def test_a_run_of_intervals_is_one_after_the_other_to_the_bit(kind):
    motion = msgspec.structs.replace(WHITE, kind=kind, calibrated_speed=(0.2, 0.3))
    segmenter = segmenter_of(motion, Sensor(), 0.0)
    expected, shift = Increment.identity(), np.zeros(3)
    segmenter.begin(0)
    for k in range(1, 30):
        speeds = 0.7 * np.sin(0.3 * k), np.cos(0.7 * k) * (k % 5 > 0)
        segmenter.drive(k * SECOND, SECOND, *map(float, speeds))
        step = increment_of(motion, 1.0, *map(float, speeds))
        own = shift_of(motion, (1.0, *map(float, speeds)))[:3]
        shift = se2.adjoint(se2.inverse(step.mean)) @ shift + own
        expected = expected.then(step)
    rest = segmenter.cut(29 * SECOND)
    mean, covariance = rest.motion
    np.testing.assert_array_equal(mean, expected.mean)
    np.testing.assert_array_equal(covariance, expected.covariance)
    np.testing.assert_allclose(rest.shift, [*shift, 29.0], rtol=1e-12, atol=1e-14)


def test_scans_in_a_run_of_intervals_are_seen_from_where_the_odometry_had_come_to_the_bit():
    segmenter = segmenter_of(WHITE, Sensor(), 100.0)
    segmenter.begin(0)
    durations = np.array([10, 7, 10, 10, 3, 10]) * (SECOND // 10)
    ends = np.cumsum(durations + np.array([5, 0, 0, 8, 0, 0]) * (SECOND // 10))
    columns = ends, durations, np.linspace(0.3, 0.8, 6), np.linspace(-0.4, 0.5, 6)
    run = list(zip(*map(np.ndarray.tolist, columns), strict=True))
    stamps = sorted([1, int(ends[0]), SECOND, SECOND, int(ends[2]) + 5, int(ends[5]) - 1])
    poses, pose = [], np.zeros(3)
    for end, duration, forward, yaw_rate in run:
        here = end - duration
        for until in (*(s for s in stamps[len(poses) :] if s <= end), None):
            part = (end if until is None else max(until, here)) - here
            if part:
                step = increment_of(WHITE, part * 1e-9, forward, yaw_rate)
                pose, here = se2.compose(pose, step.mean), here + part
            if until is not None:
                poses.append(pose)
    for k, stamp in enumerate(stamps):
        assert segmenter.observe(stamp, scan((k, 4.0 + k, 0.2 * k))) == 0
    for each in run:
        assert driven(segmenter, OdometryInterval(*each)) == []
    segmenter.cut(int(ends[-1]))
    found = segmenter.take_keyframes()[0].scan
    assert found.ids.tolist() == list(range(6))
    for k, at in enumerate(poses):
        x, y = located(se2.between(pose, at), 4.0 + k, 0.2 * k)
        assert found.ranges[k] == core.hypot(x, y)
        assert found.bearings[k] == core.atan2(y, x)
