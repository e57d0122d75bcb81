"""A result names the robot whose detections are late against its odometry, and no other robot."""

from pathlib import Path

import numpy as np
import pytest

from central.desk.evaluation.clocks import BEYOND_DOUBT, Timed, lateness
from central.desk.evaluation.evaluation import evaluate, to_json
from central.desk.evaluation.log import collect_log
from central.desk.report.tables import team_rows
from sim.publisher.node import WorldNode
from sim.scenarios.scenario import load, with_options
from sim.scenarios.source import streams_of
from team.config import RobotConfig, Sensor
from team.wire.bus import Sample
from team.wire.digest import configured
from tests.sim.logs import final_map, samples
from tests.trials.stress_world import StressWorld, write

LATE_S = 0.1


def published(world: StressWorld, place: Path) -> list[Sample]:
    """The log of a data set's measurements, without the data set's truth, and a final map."""
    of = with_options(load(str(write(world, place) / "scenario.toml")), dataset=place)
    node = WorldNode(streams_of(of), frozenset(), configured("world", 0, 0, of))
    out = node.begin()
    while not node.ended:
        out += node.publish(0.0)
    out.append(final_map([1], np.zeros((1, 2)), np.eye(2)))
    return samples([each for each in out if "truth" not in each.key])


def timed_of(log: list[Sample], robot: str) -> Timed:
    (found,) = (each for (name, _), each in collect_log(log).timed.items() if name == robot)
    return found


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> list[Sample]:
    """A log with detections of r2 that are 0.1 s late."""
    world = StressWorld(robots=2, late={"r2": LATE_S})
    return published(world, tmp_path_factory.mktemp("late"))


def test_a_result_names_the_robot_with_a_late_clock_by_how_much_and_the_remedy(
    late: list[Sample],
) -> None:
    evaluation = evaluate(late)
    (warning,) = evaluation.clocks
    assert warning.startswith("r2: its detections are stamped 0.1")
    assert " s late against its odometry: " in warning
    assert "set clock_offset_s = 0.1" in warning
    assert warning in evaluation.warnings
    assert warning in to_json(evaluation)["warnings"]
    assert ("note", warning) in team_rows(evaluation)


def test_the_offset_is_right_within_its_uncertainty_and_a_configured_one_is_deducted(
    late: list[Sample],
) -> None:
    timed = timed_of(late, "r2")
    found = lateness(timed, RobotConfig("r2"))
    assert found is not None
    assert abs(found.offset_s - LATE_S) < 3.0 * found.sigma_s
    assert found.offset_s > BEYOND_DOUBT * found.sigma_s > 0.0
    rest = lateness(timed, RobotConfig("r2", clock_offset_s=LATE_S))
    assert rest is not None
    assert rest.offset_s == pytest.approx(found.offset_s - LATE_S, abs=0.002)
    assert not rest.is_beyond_doubt


def test_a_wrong_mount_is_not_taken_for_a_late_clock(late: list[Sample]) -> None:
    robot = RobotConfig("r1", sensor=Sensor(mount=(0.3, 0.1, 0.1), range_offset=0.1))
    found = lateness(timed_of(late, "r1"), robot)
    assert found is not None
    assert abs(found.offset_s) < 3.0 * found.sigma_s


def test_clocks_that_are_right_are_not_mentioned(tmp_path: Path) -> None:
    log = published(StressWorld(seed=3, robots=2), tmp_path)
    assert evaluate(log).clocks == ()
    for robot in ("r1", "r2"):
        found = lateness(timed_of(log, robot), RobotConfig(robot))
        assert found is not None, "the world must be able to tell"
        assert abs(found.offset_s) < 4.0 * found.sigma_s < 4.0 * 0.02
