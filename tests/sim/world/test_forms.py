import msgspec
import numpy as np
import pytest

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.measuring import (
    measured_steering,
)
from teamslam.sim.world.simulator import simulate
from teamslam.team.config import MotionModel, RobotConfig
from tests.scenarios import with_world

WORLD = SimulatedWorld(steps=30, size_m=20.0, landmark_count=8, turn_rate_rad_s=0.4)


def test_a_car_that_circles_reads_the_angle_and_the_speed_of_its_circle():
    car = MotionModel("ackermann", wheel_base=2.0, wheel_offset=0.5, steering_offset=0.1)
    wheel, angle = measured_steering(car, np.array([2.0, 0.0]), np.array([0.2, 0.0]))
    radius = 10.0
    np.testing.assert_allclose(angle, [np.arctan(2.0 / radius) - 0.1, -0.1])
    np.testing.assert_allclose(wheel, [0.2 * (radius - 0.5), 0.0])


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
