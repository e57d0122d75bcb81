"""Odometry and scans in the core: motions from several places, and refused inputs."""

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.config import MotionModel, MotionNoise
from teamslam.team.estimation.models import Increment, increment_of, model_of
from teamslam.team.estimation.mount import of_sensor
from teamslam.team.estimation.odometry import OdometryInterval, moved
from teamslam.team.estimation.se2 import adjoint, between, inverse

MOTION = MotionModel(
    forward=MotionNoise(per_s=0.05, per_m=0.02),
    turn=MotionNoise(per_s=0.02, per_rad=0.1),
    lateral=MotionNoise(per_m=0.03),
    calibrated_speed=(0.2, 0.3),
)
MOUNT = (0.4, -0.2, 1.1)
PARTS = [(0.5, 0.7, 0.3), (0.5, -0.4, 0.1), (0.2, 0.25, -0.6), (1.0, 0.9, 0.0)]
ADDED = (0.2, 0.1, 0.05)


def shift_of(motion, *parts):
    """Shift (forward, left, turn) of a run of intervals by an error of the scale of speed, and its
    duration [s].
    """
    odometry = core.Odometry(model_of(motion), None)
    for part in parts:
        odometry.drive(*part, None)
    return odometry.end_keyframe()[1]


def driven(mount=None, added=None) -> core.Odometry:
    """The odometry after all parts, with marks after the second one."""
    odometry = core.Odometry(model_of(MOTION), mount)
    for k, part in enumerate(PARTS):
        odometry.drive(*part, added)
        if k == 1:
            odometry.mark_scan()
            odometry.mark_sighting()
    return odometry


def composed(steps: list[Increment]) -> Increment:
    total = Increment.identity()
    for step in steps:
        total = total.then(step)
    return total


def assert_equal(found: tuple[np.ndarray, np.ndarray], expected: Increment) -> None:
    np.testing.assert_array_equal(found[0], expected.mean)
    np.testing.assert_array_equal(found[1], expected.covariance)


@pytest.mark.parametrize("mount", [None, MOUNT])
@pytest.mark.parametrize("added", [None, ADDED])
def test_motions_are_the_sensors_since_a_keyframe_and_the_bases_since_a_node(mount, added):
    steps = [increment_of(MOTION, *part) for part in PARTS]
    if added is not None:
        spread = np.diag(added)
        steps = [
            Increment(step.mean, step.covariance + duration * spread)
            for step, (duration, _, _) in zip(steps, PARTS, strict=True)
        ]
    of_scanner = steps if mount is None else [of_sensor(s, np.array(mount)) for s in steps]
    odometry = driven(mount, added)
    assert_equal(odometry.since_node(), composed(steps))
    (since_sighting,) = odometry.reach_node()
    assert_equal(since_sighting, composed(steps[2:]))
    (back,) = odometry.end_scans()
    whole, half = composed(of_scanner), composed(of_scanner[:2])
    np.testing.assert_array_equal(back, between(whole.mean, half.mean))
    motion, shift, rest = odometry.end_keyframe()
    assert_equal(motion, whole)
    assert rest is None
    expected = np.zeros(3)
    for step, part in zip(of_scanner, PARTS, strict=True):
        column = shift_of(MOTION, part)[:3]
        if mount is not None:
            column = adjoint(inverse(np.array(mount))) @ column
        expected = adjoint(inverse(step.mean)) @ expected + column
    np.testing.assert_allclose(shift[:3], expected, atol=1e-15)
    assert shift[3] == pytest.approx(sum(duration for duration, _, _ in PARTS))
    assert_equal(odometry.since_node(), Increment.identity())
    assert_equal(odometry.end_keyframe()[0], Increment.identity())
    assert odometry.reach_node() == []


def test_a_motion_that_was_measured_goes_on_by_its_parts():
    odometry = core.Odometry(model_of(MOTION), None)
    whole = OdometryInterval(8, 8, 0.0, 0.0, moved(np.array([0.4, 0.1, 0.3]), 0.01 * np.eye(3)))
    twist, covariance = whole.moved
    for share, rest in ((0.25, 0.75), (0.75, 0.0)):
        odometry.move(twist, covariance, 8e-9, 8e-9 * share, share, rest, None)
    expected = whole.part(MOTION, 2, 6).then(whole.part(MOTION, 6, 0))
    assert_equal(odometry.end_keyframe()[0], expected)


def test_the_motion_since_a_scan_without_identities_begins_there():
    odometry = driven()
    assert_equal(odometry.pass_unnamed_scan(), composed([increment_of(MOTION, *p) for p in PARTS]))
    odometry.drive(*PARTS[0], None)
    first = increment_of(MOTION, *PARTS[0])
    assert_equal(odometry.pass_unnamed_scan(), composed([first]))
    odometry.drive(*PARTS[1], None)
    _, _, rest = odometry.end_keyframe()
    assert rest is not None
    assert_equal(rest, composed([increment_of(MOTION, *PARTS[1])]))
