from array import array
from dataclasses import replace

import numpy as np
import pytest

from teamslam.central.desk.evaluation.clocks import Timed, mirrored_cause
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.figures import to_json
from teamslam.central.desk.evaluation.states import RobotState
from teamslam.team.config import RobotConfig, Sensor
from teamslam.team.wire import messages as m
from tests.central.desk.test_clocks import published, timed_of
from tests.trials.stress_world import StressWorld

ALONE = StressWorld(robots=1, seconds=150.0)


@pytest.fixture(scope="module", params=[1, 2, 3])
def sound(request, tmp_path_factory):
    world = replace(ALONE, seed=request.param)
    return timed_of(published(world, tmp_path_factory.mktemp("sound")), "r1")


def mirrored(timed: Timed) -> Timed:
    seen = np.array(timed.seen).reshape(-1, 2) * (1.0, -1.0)
    return replace(timed, seen=array("d", seen.ravel().tolist()))


def test_a_robot_alone_with_mirrored_bearings_is_named_and_nothing_else_of_it(tmp_path):
    log = published(replace(ALONE, mirrored=("r1",)), tmp_path)
    (found,) = to_json(evaluate(log))["diagnosis"]
    assert (found["cause"], found["robot"], found["value"]) == ("mirrored", "r1", -1.0)
    assert found["text"].startswith("r1's bearings have the wrong sign: negate")


@pytest.mark.parametrize("mirrored", [("r1",), ("r1", "r2")])
def test_a_map_with_mirrored_robots_fails_and_names_them(mirrored, tmp_path):
    result = evaluate(published(replace(ALONE, robots=2, mirrored=mirrored), tmp_path))
    inside = {robot: RobotState("joined") for robot in ("r1", "r2")}
    failures = replace(result, states=inside).failures
    assert len(failures) == len(mirrored)
    for robot, failure in zip(mirrored, failures, strict=True):
        assert f"not to be used: {robot}'s bearings have the wrong sign: negate" in failure
    outside = inside | {robot: RobotState("withdrawn", "by operator") for robot in mirrored}
    assert replace(result, states=outside).failures == tuple(
        f"{robot} withdrawn: by operator" for robot in mirrored
    )


@pytest.mark.parametrize(
    "sensor", [Sensor(mount=(0.5, 0.2, 0.3)), Sensor(bearing_offset=0.3), Sensor(range_offset=0.3)]
)
def test_a_wrong_calibration_is_not_taken_for_a_reflection(sound, sensor):
    assert mirrored_cause("r1", sound, RobotConfig("r1", sensor=sensor)) is None


def test_a_mirrored_robot_explains_its_other_causes_and_no_other_robots(tmp_path):
    log = published(replace(ALONE, robots=2, mirrored=("r1",)), tmp_path)
    result = evaluate(log)
    causes = [m.Diagnosis(cause="noise_underestimated", robot=each) for each in ("r1", "r2", "")]
    result = replace(result, map=replace(result.map, diagnosis=tuple(causes)))
    assert [(each.cause, each.robot) for each in result.diagnosis] == [
        ("mirrored", "r1"),
        ("noise_underestimated", "r2"),
        ("noise_underestimated", ""),
    ]
