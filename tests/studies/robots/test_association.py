"""Comparison methods without landmark identities: nearest neighbour and likelihood."""

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.association import AssociationResult, association_result
from teamslam.central.desk.evaluation.log import collect_log
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.estimators import nearest_neighbour
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.models import Increment

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
    found = association_result(collect_log(run_team(scenario, streams_of(scenario))))
    assert found is not None
    return found


@pytest.mark.parametrize("estimator", ["ekf-slam", "fastslam1"])
def test_with_a_good_sensor_they_find_the_landmarks_and_with_a_poor_one_not(estimator: str) -> None:
    good, poor = scores(estimator, 1.0), scores(estimator, 20.0)
    assert good.pairs.precision == 1.0
    assert (good.pairs.recall or 0.0) > 0.9
    assert good.landmarks >= 4
    assert (poor.pairs.wrong_percent or 0.0) > 3.0


def test_the_nis_of_nearest_neighbour_is_of_the_landmarks_that_detections_were_taken_for() -> None:
    sensor = load("thesis").robots[0].sensor
    near, far = (10.0, 0.0), (10.0, np.pi / 2.0)
    state = nearest_neighbour.initial_state(np.zeros(3))
    rows = np.arange(2, dtype=np.uint32) + UNNAMED
    for first, second in ((near, far), (far, near)):  # the same two, in the other order
        ranges, bearings = np.array([first[0], second[0]]), np.array([first[1], second[1]])
        scan = (Increment.identity(), sensor, rows, ranges, bearings)
        found = nearest_neighbour.innovation(state, *scan)
        state = nearest_neighbour.filter_step(state, *scan)
    assert (found.dof, found.squared) == (4, pytest.approx(0.0, abs=1e-9))
