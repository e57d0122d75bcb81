import msgspec
import numpy as np
import pytest

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.measuring import (
    Visible,
    draw_covariances,
    measured_increments,
    measured_steering,
    seen_from,
    with_errors,
)
from teamslam.sim.world.simulator import simulate
from teamslam.team.config import MotionModel, MotionNoise, RobotConfig, Sensor
from tests.scenarios import with_world

MOTION = MotionModel(
    forward=MotionNoise(0.1), turn=MotionNoise(0.05), lateral=MotionNoise(0.04)
)  # fmt: skip
WORLD = SimulatedWorld(steps=30, size_m=20.0, landmark_count=8, turn_rate_rad_s=0.4)


def rotation(pose: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def test_told_increments_err_by_what_they_claim():
    count = 4000
    rng = np.random.default_rng(1)
    poses = np.tile([[0.0, 0.0, 0.3], [0.8, 0.5, 0.9]], (count, 1))
    steps = np.tile([[0.9, 0.6]], (len(poses) - 1, 1))
    normals = rng.standard_normal((len(steps), 3))
    told, C = measured_increments(MOTION, poses, steps, np.ones(len(steps)), normals, 0.7)
    errors = []
    for k in range(0, len(steps), 2):
        rest = (
            np.linalg.inv(rotation(told[k]))
            @ np.linalg.inv(rotation(poses[k]))
            @ rotation(poses[k + 1])
        )
        errors.append([rest[0, 2], rest[1, 2], np.arctan2(rest[1, 0], rest[0, 0])])
    np.testing.assert_allclose(np.cov(np.array(errors).T), C[0], atol=6e-4)
    assert C[0, 1, 2] == pytest.approx(0.7 * 0.04 * 0.05)


def test_a_car_that_circles_reads_the_angle_and_the_speed_of_its_circle():
    car = MotionModel("ackermann", wheel_base=2.0, wheel_offset=0.5, steering_offset=0.1)
    wheel, angle = measured_steering(car, np.array([2.0, 0.0]), np.array([0.2, 0.0]))
    radius = 10.0
    np.testing.assert_allclose(angle, [np.arctan(2.0 / radius) - 0.1, -0.1])
    np.testing.assert_allclose(wheel, [0.2 * (radius - 0.5), 0.0])


def test_a_mounted_sensor_is_where_its_base_carries_it():
    there = seen_from(np.array([[1.0, 2.0, np.pi / 2]]), (3.0, 0.5, 0.1))
    np.testing.assert_allclose(there, [[0.5, 5.0, np.pi / 2 + 0.1]])


@pytest.mark.parametrize("points", [False, True])
def test_measurements_err_by_the_covariances_that_come_with_them(points):
    rng = np.random.default_rng(2)
    count = 6000
    seen = Visible(*np.zeros((2, count), np.int64), np.full(count, 5.0), np.zeros(count))
    sensor = Sensor(range_sigma=0.2, bearing_sigma=0.03)
    of = draw_covariances(seen, sensor, (0.5, 2.0), rng.random((count, 3)), points=points)
    errors = with_errors(np.zeros((count, 2)), of, rng.standard_normal((count, 2)))
    full = of[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(full), errors)
    assert squared.mean() == pytest.approx(2.0, abs=0.1)
    assert np.abs(of[:, 1]).max() > 0.0


def test_forms_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match="odometry_claims"):
        msgspec.structs.replace(WORLD, odometry_claims=True)
    with pytest.raises(ValueError, match="outliers"):
        msgspec.structs.replace(WORLD, landmark_form="points", outlier_share=0.1)
    steered = msgspec.structs.replace(WORLD, odometry="steering")
    with pytest.raises(ValueError, match="r1 needs motion"):
        simulate(steered, [RobotConfig("r1")], 1)


def streams(form: str, identities: str):
    scenario = load("waypoints")
    return streams_of(
        with_world(
            scenario,
            steps=60,
            landmark_form=form,
            landmark_claims=(0.5, 2.0),
            identities=identities,
        )
    ).streams


@pytest.mark.parametrize("form", ["ranges", "points"])
def test_hidden_detections_have_the_covariances_of_their_range_and_bearing(form):
    known, hidden = streams(form, "known")[0], streams(form, "hidden")[0]
    seen, unnamed = known.landmark_detections, hidden.landmark_detections
    assert len(unnamed.ranges) > 20
    np.testing.assert_allclose(unnamed.ranges, seen.ranges)
    rr, rb, bb = unnamed.covariances.T
    # A point's covariance, turned into the line of sight: along it, and across it by the range.
    if form == "ranges":
        np.testing.assert_array_equal(unnamed.covariances, seen.covariances)
        return
    c, s = np.cos(seen.bearings), np.sin(seen.bearings)
    xx, xy, yy = seen.covariances.T
    np.testing.assert_allclose(rr, c * c * xx + 2 * c * s * xy + s * s * yy, rtol=1e-9)
    across = s * s * xx - 2 * c * s * xy + c * c * yy
    np.testing.assert_allclose(bb, across / seen.ranges**2, rtol=1e-9)
    np.testing.assert_allclose(
        rb * seen.ranges, c * s * (yy - xx) + (c * c - s * s) * xy, atol=1e-9
    )
