from itertools import pairwise

import numpy as np
import pytest

from teamslam.team.config import MotionModel, MotionNoise
from teamslam.team.core import OdometryInterval
from teamslam.team.estimation.models import Increment, increment_of, model_of, steered
from teamslam.team.estimation.se2 import between, exponential, logarithm

SECOND = 1_000_000_000
NOISY = MotionModel(
    forward=MotionNoise(0.02, 0.05, 0.01),
    turn=MotionNoise(0.01, 0.02, 0.03),
    final_turn=MotionNoise(0.01),
    lateral=MotionNoise(0.005, 0.02),
    shares=(0.14, 0.15, 0.01),
)
CLAIM = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.004], [0.002, -0.004, 0.01]])


def interval(increment: list[float], claim: np.ndarray | None = None) -> OdometryInterval:
    return OdometryInterval(SECOND, SECOND, 0.0, 0.0, logarithm(np.array(increment)), claim)


def part(whole: OdometryInterval, motion: MotionModel, duration_ns: int, rest_ns: int) -> Increment:
    return Increment(*whole.part(model_of(motion), duration_ns, rest_ns))


@pytest.mark.parametrize("claim", [None, CLAIM])
@pytest.mark.parametrize("cuts", [(0.5,), (0.1, 0.35, 0.8)])
def test_however_an_increment_is_split_its_parts_compose_to_it(claim, cuts):
    whole = interval([0.8, -0.3, 0.7], claim)
    motion = MotionModel() if claim is None else NOISY
    ends = [0, *(round(cut * SECOND) for cut in cuts), SECOND]
    total = Increment.identity()
    for begin, end in pairwise(ends):
        total = total.then(part(whole, motion, end - begin, SECOND - end))
    np.testing.assert_allclose(total.mean, [0.8, -0.3, 0.7], atol=1e-12)
    np.testing.assert_allclose(total.covariance, np.zeros((3, 3)) if claim is None else claim,
                               atol=1e-12)  # fmt: skip


@pytest.mark.parametrize("way", [1.5, -1.5])
def test_an_increment_without_a_lateral_part_is_the_arc_of_its_speeds(way):
    wheels = MotionModel("differential-drive", wheel_base=0.5, left_wheel=0.1, right_wheel=0.02)
    for motion in (NOISY, wheels):
        arc = increment_of(motion, 1.0, way, 0.4)
        told = part(interval(arc.mean.tolist()), motion, SECOND, 0)
        np.testing.assert_allclose(told.mean, arc.mean, atol=1e-12)
        np.testing.assert_allclose(told.covariance, arc.covariance, atol=1e-12)


def test_the_noise_of_an_increment_is_what_central_differences_of_its_arc_say():
    motion = MotionModel(forward=MotionNoise(0.3), turn=MotionNoise(0.2), lateral=MotionNoise(0.1))
    xi = np.array([0.8, -0.5, 0.9])
    along = np.array([*(xi[:2] / np.hypot(*xi[:2])), 0.0])
    end, h = exponential(xi), 1e-6
    columns = [
        (logarithm(between(end, exponential(xi + h * d)))
         - logarithm(between(end, exponential(xi - h * d)))) / (2 * h)
        for d in (along, np.array([0.0, 0.0, 1.0]))
    ]  # fmt: skip
    J = np.column_stack([*columns, [-along[1], along[0], 0.0]])
    expected = J @ np.diag([0.09, 0.04, 0.01]) @ J.T
    told = part(interval(end.tolist()), motion, SECOND, 0)
    np.testing.assert_allclose(told.covariance, expected, atol=1e-9)


def test_a_car_of_whose_left_wheel_the_speed_is_told_drives_its_circle():
    car = MotionModel("ackermann", wheel_base=2.83, wheel_offset=0.76, steering_offset=0.02)
    forward, yaw_rate = steered(car, 3.0, 0.18)
    radius = 2.83 / np.tan(0.2)
    assert forward / yaw_rate == pytest.approx(radius)
    assert yaw_rate * (radius - 0.76) == pytest.approx(3.0), "the wheel is nearer to the centre"
    assert np.isnan(steered(MotionModel(), 3.0, 0.18)).all()
    assert np.isnan(steered(car, 3.0, 1.4)).all(), "the centre of the turn is under the wheel"


def test_shares_of_the_way_are_held_for_their_time_and_then_grow_as_it_does():
    car = MotionModel("ackermann", wheel_base=2.83, shares=(0.14, 0.15, 0.0), shares_interval_s=0.2)
    held = increment_of(car, 0.2, 5.0, 0.0).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(held)), [0.14, 0.15, 0.0], atol=1e-12)
    twice = increment_of(car, 0.4, 5.0, 0.0).covariance
    np.testing.assert_allclose(twice, 2.0 * held, atol=1e-12)
