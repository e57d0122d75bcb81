from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import core
from teamslam.team.config import MotionModel, MotionNoise, Sensor
from teamslam.team.core import OdometryInterval
from teamslam.team.estimation import models
from teamslam.team.estimation.hybrid_slam.window import generator
from teamslam.team.estimation.models import Increment, increment_of, model_of, steered
from teamslam.team.estimation.se2 import between, compose, exponential, inverse, logarithm

quick = settings(deadline=None, max_examples=60)
turns = st.floats(-2.5, 2.5)
distances = st.floats(0.1, 5.0)
NOISES = {
    "forward": MotionNoise(per_s=0.03),
    "turn": MotionNoise(per_s=0.05),
    "final_turn": MotionNoise(per_s=0.02),
    "lateral": MotionNoise(per_s=0.01),
}
SIGMAS = np.array([0.03, 0.05, 0.02, 0.01])
ALPHAS = (0.001, 0.002, 0.003, 0.004, 0.0005, 0.0006)


def driven(kind, distance, turn, final_turn, lateral):
    """End of the motion by small straight steps, without the model."""
    if kind == "turn-then-drive":
        end = np.array([distance * np.cos(turn), distance * np.sin(turn), turn])
    else:
        middles = turn * (np.arange(4000) + 0.5) / 4000
        end = np.array([distance * np.cos(middles).mean(), distance * np.sin(middles).mean(), turn])
    return compose(end, np.array([0.0, lateral, final_turn]))


def jacobian(kind, distance, turn):
    """∂ log(end⁻¹ ∘ end')/∂(distance, turn, final turn, lateral) by central differences."""
    end = driven(kind, distance, turn, 0.0, 0.0)
    J = np.empty((3, 4))
    for column in range(4):
        offset = 1e-4 * (np.arange(4) == column)
        ahead, behind = (
            logarithm(
                compose(
                    inverse(end),
                    driven(kind, distance + s * offset[0], turn + s * offset[1], *(s * offset[2:])),
                )
            )
            for s in (1.0, -1.0)
        )
        J[:, column] = (ahead - behind) / 2e-4
    return J


@pytest.mark.parametrize("kind", ["velocity", "turn-then-drive"])
@quick
@given(distance=distances, turn=turns | st.floats(-2e-3, 2e-3) | st.just(0.0))
def test_the_motions_covariance_is_that_of_central_differences(kind, distance, turn):
    increment = increment_of(MotionModel(kind=kind, **NOISES), 1.0, distance, turn)
    np.testing.assert_allclose(increment.mean, driven(kind, distance, turn, 0.0, 0.0), atol=1e-6)
    J = jacobian(kind, distance, turn)
    np.testing.assert_allclose(increment.covariance, (J * SIGMAS**2) @ J.T, atol=1e-7)


@pytest.mark.parametrize("interval", [1.0, 0.1])
@quick
@given(
    speed=st.floats(-2.0, 2.0),
    yaw_rate=turns | st.floats(-1e-3, 1e-3),
    parts=st.sampled_from([1, 2, 5]),
)
def test_the_alphas_are_those_of_the_source_at_their_interval_and_a_density_beside_it(
    interval, speed, yaw_rate, parts
):
    model = MotionModel(alphas=ALPHAS, alpha_interval_s=interval)
    duration = interval / parts
    increment = increment_of(model, duration, speed, yaw_rate)
    a = np.array(ALPHAS)
    squares = np.array([speed**2, yaw_rate**2])
    of_v, of_w, of_gamma = a.reshape(3, 2) @ squares * interval**2 / parts
    J = jacobian("velocity", speed * duration, yaw_rate * duration)
    variances = np.array([of_v, of_w, of_gamma, 0.0])
    np.testing.assert_allclose(increment.covariance, (J * variances) @ J.T, atol=2e-7)
    if parts > 1 and yaw_rate == 0.0:
        whole = increment_of(model, interval, speed, yaw_rate)
        np.testing.assert_allclose(parts * increment.covariance[0, 0], whole.covariance[0, 0])


@quick
@given(distance=st.floats(-5.0, 5.0), turn=turns | st.floats(-1e-3, 1e-3))
def test_two_wheels_make_one_error_of_way_and_turn_that_is_correlated_where_they_differ(
    distance, turn
):
    base, left, right = 0.4, 0.02, 0.05
    model = MotionModel(
        kind="differential-drive", wheel_base=base, left_wheel=left, right_wheel=right
    )
    increment = increment_of(model, 1.0, distance, turn)
    ways = np.array([distance - base * turn / 2, distance + base * turn / 2])
    of_wheels = np.array([[0.5, 0.5], [-1 / base, 1 / base]])
    control = (of_wheels * np.array([left, right]) ** 2 * np.abs(ways)) @ of_wheels.T
    J = jacobian("velocity", distance, turn)[:, :2]
    np.testing.assert_allclose(increment.covariance, J @ control @ J.T, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(
        increment.mean, driven("velocity", distance, turn, 0.0, 0.0), atol=1e-6
    )


def test_a_density_of_noise_does_not_depend_on_the_rate_of_the_odometry():
    model = MotionModel(kind="velocity", forward=MotionNoise(0.02, 0.03, 0.1), turn=NOISES["turn"])
    whole = increment_of(model, 2.0, 0.4, 0.3)
    parts = Increment.identity()
    for _ in range(200):
        parts = parts.then(increment_of(model, 0.01, 0.4, 0.3))
    np.testing.assert_allclose(parts.mean, whole.mean, atol=1e-12)
    np.testing.assert_allclose(parts.covariance[2, 2], whole.covariance[2, 2], rtol=1e-9)
    # White noise along the way moves the end less than one constant error of the same variance.
    np.testing.assert_allclose(parts.covariance[0, 0], whole.covariance[0, 0], rtol=0.1)


def test_composed_motion_has_the_covariance_of_composed_samples():
    rng = np.random.default_rng(3)
    L = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.01, 0.005, 0.02]])
    a = Increment(np.array([1.0, 0.5, 0.7]), L @ L.T)
    b = Increment(np.array([2.0, -0.3, -1.1]), 0.5 * L @ L.T)
    both = a.then(b)
    ends = np.array(
        [
            logarithm(
                compose(
                    inverse(both.mean),
                    compose(
                        compose(a.mean, exponential(L @ rng.standard_normal(3))),
                        compose(b.mean, exponential(np.sqrt(0.5) * L @ rng.standard_normal(3))),
                    ),
                )
            )
            for _ in range(20000)
        ]
    )
    scale = np.sqrt(np.outer(np.diag(both.covariance), np.diag(both.covariance)))
    assert np.abs((np.cov(ends.T) - both.covariance) / scale).max() < 0.05


@quick
@given(st.lists(st.tuples(distances, turns), min_size=3, max_size=3))
def test_composition_of_increments_is_associative_with_a_neutral_element(motions):
    model = MotionModel(kind="velocity", **NOISES)
    a, b, c = (increment_of(model, 0.3, *motion) for motion in motions)
    left, right = a.then(b).then(c), a.then(b.then(c))
    np.testing.assert_allclose(left.mean, right.mean, atol=1e-12)
    np.testing.assert_allclose(left.covariance, right.covariance, atol=1e-12)
    np.testing.assert_array_equal(left.covariance, left.covariance.T)
    for same in (a.then(Increment.identity()), Increment.identity().then(a)):
        np.testing.assert_allclose(same.mean, a.mean, atol=1e-15)
        np.testing.assert_allclose(same.covariance, a.covariance, atol=1e-15)


def test_a_turn_drags_at_the_speed_and_never_turns_it_round():
    model = MotionModel(forward_scale=1.1, yaw_scale=0.5, turn_drag=0.2)
    for forward, yaw_rate, left in ((1.0, 0.6, 1.04), (-1.0, 0.6, -1.04), (0.1, -3.0, 0.0)):
        arc = logarithm(increment_of(model, 2.0, forward, yaw_rate).mean)
        np.testing.assert_allclose(arc, [2.0 * left, 0.0, yaw_rate], atol=1e-12)


def test_a_base_that_creeps_has_a_scale_of_its_own_below_a_speed():
    model = MotionModel(forward_scale=1.1, turn_drag=0.2, slow_below=0.02, slow_scale=2.5)
    for forward, yaw_rate, left in (
        (0.01, 0.0, 0.025),
        (-0.01, 0.0, -0.025),
        (0.01, 0.1, 0.005),
        (0.02, 0.0, 0.022),
        (0.0, 0.1, 0.0),
    ):
        arc = logarithm(increment_of(model, 2.0, forward, yaw_rate).mean)
        np.testing.assert_allclose(arc, [2.0 * left, 0.0, 2.0 * yaw_rate], atol=1e-12)


def test_a_base_that_veers_turns_by_the_way_that_it_drove_on_top_of_what_is_logged():
    model = MotionModel(turn_drag=0.5, veer=-0.1, turn=MotionNoise(per_rad=0.2))
    veered = increment_of(model, 2.0, 1.0, 0.4)
    np.testing.assert_allclose(logarithm(veered.mean), [1.6, 0.0, 0.8 - 0.16], atol=1e-12)
    assert veered.covariance[2, 2] == pytest.approx(0.04 * 0.64)
    back = increment_of(model, 2.0, -1.0, 0.0)
    assert back.mean[2] == pytest.approx(0.2)


@quick
@given(
    st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.1, 3.1), st.floats(1.0, 20.0), turns
)
def test_the_sensors_jacobians_are_those_of_central_differences(x, y, theta, distance, bearing):
    pose = np.array([x, y, theta])
    landmark = core.located(pose, distance, bearing)
    np.testing.assert_allclose(core.predicted(pose, landmark), (distance, bearing), atol=1e-9)
    expected, by_pose, by_landmark = core.predict(pose, landmark[None])
    np.testing.assert_array_equal(expected[0], core.predicted(pose, landmark))
    for column in range(3):
        xi = 1e-6 * (np.arange(3) == column)
        ahead = core.predicted(compose(pose, exponential(xi)), landmark)
        behind = core.predicted(compose(pose, exponential(-xi)), landmark)
        numeric = np.subtract(ahead, behind) / 2e-6
        np.testing.assert_allclose(by_pose[0, :, column], numeric, atol=1e-6)
    for column in range(2):
        shift = 1e-6 * (np.arange(2) == column)
        ahead = core.predicted(pose, landmark + shift)
        behind = core.predicted(pose, landmark - shift)
        numeric = np.subtract(ahead, behind) / 2e-6
        np.testing.assert_allclose(by_landmark[0, :, column], numeric, atol=1e-6)


def test_calibration_takes_back_what_the_sensor_does():
    sensor = Sensor(range_offset=0.05, range_scale=0.97, bearing_offset=0.3)
    distances, bearings = np.array([1.0, 4.0]), np.array([-3.0, 3.1])
    ranges, corrected = models.corrected(sensor, 0.97 * distances + 0.05, bearings + 0.3)
    np.testing.assert_allclose(ranges, distances)
    np.testing.assert_allclose(corrected, bearings)


def test_a_depth_along_the_optical_axis_becomes_the_distance():
    sensor = Sensor(range_offset=0.05, range_scale=1.02, bearing_offset=0.01)
    sensor = msgspec.structs.replace(sensor, range_is_depth=True, optical_axis=0.1)
    distances, raw = np.array([1.0, 4.0, 2.0]), np.array([0.1, -0.5, 0.9])
    depths = 1.02 * distances * np.cos(raw - 0.1) + 0.05
    ranges, bearings = models.corrected(sensor, depths, raw)
    np.testing.assert_allclose(ranges, distances)
    np.testing.assert_allclose(bearings, raw - 0.01)
    beside = 0.1 + np.radians([79.0, 81.0, -81.0, 100.0, 180.0])
    seen = models.scanned(sensor, np.ones(5), beside)[0]
    np.testing.assert_array_equal(seen, [True, False, False, False, False])


def test_each_window_has_random_numbers_of_its_own_that_come_again():
    keys = [(1, "r1", 0, 0), (2, "r1", 0, 0), (1, "r2", 0, 0), (1, "r1", 1, 0), (1, "r1", 0, 1)]
    draws = [generator(*key).standard_normal(4).tobytes() for key in keys]
    assert len(set(draws)) == len(keys)
    assert generator(*keys[3]).standard_normal(4).tobytes() == draws[3]


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
