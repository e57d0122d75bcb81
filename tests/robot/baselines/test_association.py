"""The baselines without names: EKF-SLAM with nearest neighbour, FastSLAM by likelihood."""

import msgspec
import pytest

from central.desk.evaluation.association import AssociationResult, association_result
from central.desk.evaluation.log import collected
from sim.in_memory.team import run_team
from sim.scenarios.scenario import load, with_options
from sim.scenarios.source import streams_of

STEPS = 60


def scores(estimator: str, error: float) -> AssociationResult:
    """One robot of thesis-b, its sensor's errors `error` times as large."""
    scenario = with_options(
        load("thesis-b"),
        robots=1,
        seed=2,
        estimator=estimator,
        fusion="alone",
        identities="hidden",
    )
    (robot,) = scenario.robots
    sensor = msgspec.structs.replace(
        robot.sensor,
        range_sigma=error * robot.sensor.range_sigma,
        bearing_sigma=error * robot.sensor.bearing_sigma,
    )
    scenario = msgspec.structs.replace(
        scenario,
        world=msgspec.structs.replace(scenario.world, steps=STEPS),
        robots=(msgspec.structs.replace(robot, sensor=sensor),),
    )
    found = association_result(collected(run_team(scenario, streams_of(scenario))))
    assert found is not None
    return found


@pytest.mark.parametrize("estimator", ["ekf-slam", "fastslam1"])
def test_with_a_good_sensor_they_find_the_landmarks_and_with_a_poor_one_not(estimator: str) -> None:
    good, poor = scores(estimator, 1.0), scores(estimator, 20.0)
    assert good.pairs.precision == 1.0
    assert (good.pairs.recall or 0.0) > 0.9
    assert good.landmarks >= 4
    assert (poor.pairs.wrong_percent or 0.0) > 3.0
