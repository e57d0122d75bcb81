"""Odometry and scans in the core: motions from several places, and refused inputs."""

import math

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.config import UNNAMED, MotionModel, MotionNoise, Sensor
from teamslam.team.core import OdometryInterval, Scan
from teamslam.team.estimation.models import Increment, increment_of, model_of, segmenter_of
from teamslam.team.estimation.se2 import adjoint, inverse, logarithm

MOTION = MotionModel(
    forward=MotionNoise(per_s=0.05, per_m=0.02),
    turn=MotionNoise(per_s=0.02, per_rad=0.1),
    lateral=MotionNoise(per_m=0.03),
    calibrated_speed=(0.2, 0.3),
)
MOUNT = (0.4, -0.2, 1.1)
PARTS = [(0.5, 0.7, 0.3), (0.5, -0.4, 0.1), (0.25, 0.25, -0.6), (1.0, 0.9, 0.0)]
SECOND = 10**9
UNNAMED_SCAN = Scan(np.array([UNNAMED], np.uint32), np.array([2.0]), np.zeros(1))


def shift_of(motion, *parts):
    """Shift (forward, left, turn) of a run of intervals by an error of the scale of speed, and its
    duration [s].
    """
    segmenter = segmenter_of(motion, Sensor(), 0.0)
    drive(segmenter, parts)
    return np.array(segmenter.cut(0).shift)


def drive(segmenter, parts, now_ns=0):
    for duration_s, forward, yaw_rate in parts:
        now_ns += round(duration_s * SECOND)
        segmenter.drive(now_ns, round(duration_s * SECOND), forward, yaw_rate)
    return now_ns


def composed(steps: list[Increment]) -> Increment:
    total = Increment.identity()
    for step in steps:
        total = total.then(step)
    return total


def assert_equal(found: tuple[np.ndarray, np.ndarray], expected: Increment) -> None:
    np.testing.assert_array_equal(found[0], expected.mean)
    np.testing.assert_array_equal(found[1], expected.covariance)


def of_sensor(step: Increment, mount: np.ndarray) -> Increment:
    return Increment(*core.motion_of_sensor(step.mean, step.covariance, mount))


@pytest.mark.parametrize("mount", [None, MOUNT])
def test_motions_are_the_sensors_since_a_keyframe_and_the_bases_since_a_node(mount):
    steps = [increment_of(MOTION, *part) for part in PARTS]
    of_scanner = steps if mount is None else [of_sensor(s, np.array(mount)) for s in steps]
    segmenter = segmenter_of(MOTION, Sensor() if mount is None else Sensor(mount=mount), 0.0)
    half_ns = drive(segmenter, PARTS[:2])
    segmenter.mark_sighting()
    drive(segmenter, PARTS[2:], half_ns)
    assert_equal(segmenter.since_node(), composed(steps))
    (since_sighting,) = segmenter.reach_node()
    assert_equal(since_sighting, composed(steps[2:]))
    (keyframe,) = segmenter.take_keyframes()
    assert keyframe.is_node
    assert_equal(keyframe.motion, composed(of_scanner))
    assert keyframe.rest is None
    expected = np.zeros(3)
    for step, part in zip(of_scanner, PARTS, strict=True):
        column = shift_of(MOTION, part)[:3]
        if mount is not None:
            column = adjoint(inverse(np.array(mount))) @ column
        expected = adjoint(inverse(step.mean)) @ expected + column
    np.testing.assert_allclose(keyframe.shift[:3], expected, atol=1e-15)
    assert keyframe.shift[3] == pytest.approx(sum(duration for duration, _, _ in PARTS))
    assert_equal(segmenter.since_node(), Increment.identity())
    assert_equal(segmenter.cut(0).motion, Increment.identity())
    assert segmenter.reach_node() == []


def test_an_unmeasured_motion_has_the_last_speeds_and_a_spread_as_large_as_itself():
    segmenter = segmenter_of(MOTION, Sensor(), 0.0)
    segmenter.drive(SECOND, SECOND, 2.0, 0.1)
    segmenter.cut(SECOND)
    outcome = segmenter.drive(3 * SECOND, 2 * SECOND, 1e6, 0.0)
    assert outcome == 4, "beyond the bounds"
    mean, covariance = segmenter.cut(3 * SECOND).motion
    measured = increment_of(MOTION, 2.0, 2.0, 0.1)
    np.testing.assert_array_equal(mean, measured.mean)
    spread = np.diag(covariance - measured.covariance)
    np.testing.assert_allclose(spread, [4.0**2, 0.01 * 4.0**2, 1.0], rtol=1e-12)
    segmenter.integrate(OdometryInterval(103 * SECOND, 100 * SECOND, 0.0, 0.0), False)
    _, covariance = segmenter.cut(103 * SECOND).motion
    turned = covariance - increment_of(MOTION, 100.0, 2.0, 0.1).covariance
    assert turned[2, 2] == pytest.approx(math.pi**2)


def test_a_motion_that_was_measured_goes_on_by_its_parts():
    segmenter = segmenter_of(MOTION, Sensor(), 0.0)
    whole = OdometryInterval(8, 8, 0.0, 0.0, logarithm(np.array([0.4, 0.1, 0.3])), 0.01 * np.eye(3))
    segmenter.observe(2, UNNAMED_SCAN)
    segmenter.integrate(whole, True)
    (keyframe,) = segmenter.take_keyframes()
    first, second = (whole.part(model_of(MOTION), *part) for part in ((2, 6), (6, 0)))
    assert_equal(keyframe.motion, Increment(*first))
    assert_equal(segmenter.cut(8).motion, Increment(*second))


def test_the_motion_since_a_scan_without_identities_begins_there():
    segmenter = segmenter_of(MOTION, Sensor(), 100.0)
    half_ns = drive(segmenter, PARTS[:2])
    segmenter.observe(half_ns, UNNAMED_SCAN)
    next_ns = drive(segmenter, PARTS[2:3], half_ns)
    segmenter.observe(next_ns, UNNAMED_SCAN)
    end_ns = drive(segmenter, PARTS[3:], next_ns)
    segmenter.cut(end_ns)
    (keyframe,) = segmenter.take_keyframes()
    steps = [increment_of(MOTION, *part) for part in PARTS]
    first, second = keyframe.looks
    assert (first.at_ns, second.at_ns) == (half_ns, next_ns)
    assert_equal(first.motion, composed(steps[:2]))
    assert_equal(second.motion, composed(steps[2:3]))
    assert_equal(keyframe.rest, composed(steps[3:]))
    assert_equal(keyframe.motion, composed(steps))


def test_what_is_no_stream_is_refused():
    segmenter = segmenter_of(MOTION, Sensor(), 0.0)
    with pytest.raises(ValueError, match="has not begun"):
        segmenter.go_on()
    with pytest.raises(ValueError, match="negative"):
        OdometryInterval(0, -1, 0.0, 0.0)
    with pytest.raises(ValueError, match="within"):
        segmenter.drive(2**63 - 1, 1, 0.0, 0.0)
    with pytest.raises(ValueError, match="as many landmarks"):
        Scan.polar(b"1234", b"", b"")
    with pytest.raises(ValueError, match="whole numbers"):
        Scan.points(b"1234", bytes(15))
    assert isinstance(core.Segmenter.DUE, int)
