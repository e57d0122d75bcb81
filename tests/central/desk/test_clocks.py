from array import array
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from teamslam.central.desk.evaluation.clocks import (
    BEYOND_DOUBT,
    Timed,
    lateness,
    mirrored_cause,
    separate_times_warning,
)
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.figures import to_json
from teamslam.central.desk.evaluation.log import collect_log
from teamslam.central.desk.evaluation.states import RobotState
from teamslam.central.desk.presence import Presence
from teamslam.central.desk.report.tables import team_rows
from teamslam.sim.cli.launch import _time_warnings
from teamslam.sim.publisher.node import WorldNode
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import scenario_beside, streams_of
from teamslam.team.config import RobotConfig, Sensor
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.digest import announce_configuration
from tests import build
from tests.commands import run
from tests.scenarios import scenario_in
from tests.sim.logs import final_map, samples
from tests.trials.stress_world import StressWorld, write

LATE_S = 0.1


def published(world: StressWorld, place: Path) -> list[Sample]:
    out = published_by(scenario_in(write(world, place)))
    out.append(final_map([1], np.zeros((1, 2)), np.eye(2)))
    return samples([each for each in out if "truth" not in each.key])


def published_by(of: Scenario) -> list[Outgoing]:
    node = WorldNode(streams_of(of), frozenset(), announce_configuration("world", 0, 0, of))
    out = node.begin()
    while not node.ended:
        out += node.publish(0.0)
    return out


def timed_of(log: list[Sample], robot: str) -> Timed:
    (found,) = (each for (name, _), each in collect_log(log).timed.items() if name == robot)
    return found


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    world = StressWorld(robots=2, late={"r2": LATE_S})
    return published(world, tmp_path_factory.mktemp("late"))


def test_a_result_names_the_robot_with_a_late_clock_by_how_much_and_the_remedy(late):
    evaluation = evaluate(late)
    (late_clock,) = to_json(evaluation)["diagnosis"]
    assert (late_clock["cause"], late_clock["robot"]) == ("clock_offset", "r2")
    assert abs(late_clock["value"] - LATE_S) < 3.0 * late_clock["sigma"] < 0.06
    text = late_clock["text"]
    assert text.startswith("r2's camera clock is 0.1")
    assert f"add {late_clock['value']:.3g} to its clock_offset_s, which moves its path" in text
    assert f"subtract {late_clock['value']:.3g} s from the stamps of its detections" in text
    assert evaluation.warnings.count(text) == 1
    assert ("cause of misfit", text) in team_rows(evaluation)


def test_the_offset_is_right_within_its_uncertainty_and_a_configured_one_is_deducted(late):
    timed = timed_of(late, "r2")
    found = lateness(timed, RobotConfig("r2"))
    assert abs(found.offset_s - LATE_S) < 3.0 * found.sigma_s
    assert found.offset_s > BEYOND_DOUBT * found.sigma_s > 0.0
    rest = lateness(timed, RobotConfig("r2", clock_offset_s=LATE_S))
    assert rest.offset_s == pytest.approx(found.offset_s - LATE_S, abs=0.002)
    assert not rest.is_beyond_doubt


def test_a_wrong_mount_is_not_taken_for_a_late_clock(late):
    robot = RobotConfig("r1", sensor=Sensor(mount=(0.3, 0.1, 0.1), range_offset=0.1))
    found = lateness(timed_of(late, "r1"), robot)
    assert abs(found.offset_s) < 3.0 * found.sigma_s


def test_clocks_that_are_right_are_not_mentioned(tmp_path):
    log = published(StressWorld(seed=3, robots=2), tmp_path)
    assert evaluate(log).late == ()
    for robot in ("r1", "r2"):
        found = lateness(timed_of(log, robot), RobotConfig(robot))
        assert found is not None, "the world must be able to tell"
        assert abs(found.offset_s) < 4.0 * found.sigma_s < 4.0 * 0.02


@pytest.mark.parametrize(
    ("spans_s", "said"),
    [
        ({"r1": (0, 612), "r2": (500, 700)}, ""),
        ({"r1": (0, 612), "r2": (700, 900), "r3": (600, 800)}, ""),  # by way of r3
        ({"r1": (0, 612), "r2": (10, 20), "r3": (500, 700)}, ""),  # r2's is within r1's
        ({"r1": (0, 612), "r2": (1.7e9, 1.7e9 + 60)},
         "r1 from 0 s to 612 s; r2 from 2023-11-14 22:13:20 UTC to 2023-11-14 22:14:20 UTC"),
        ({"r3": (2_000, 2_600), "r1": (0, 612), "r2": (100, 700)},
         "r1, r2 from 0 s to 700 s; r3 from 2,000 s to 2,600 s"),
    ],
)  # fmt: skip
def test_robots_whose_times_do_not_overlap_are_named_with_their_times(spans_s, said):
    spans = {robot: (int(a * 1e9), int(b * 1e9)) for robot, (a, b) in spans_s.items()}
    warning = separate_times_warning(spans)
    assert (warning is not None) == bool(said)
    assert said in (warning or "")
    if warning is not None:
        assert "map of columns" in warning


def test_import_and_result_name_robots_with_clocks_of_different_epochs(tmp_path):
    rows = "t_s,forward_m_s,yaw_rate_rad_s\n{0},1,0\n{1},1,0\n{2},0,0\n"
    for robot, begin in (("r1", 0), ("r2", 1_700_000_000)):
        (tmp_path / "set" / robot).mkdir(parents=True)
        times = rows.format(begin, begin + 30, begin + 60)
        (tmp_path / "set" / robot / "odometry.csv").write_text(times)
    said = run("import", tmp_path / "set", "-o", tmp_path / "mine")
    expected = "r1 from 0 s to 60 s; r2 from 2023-11-14 22:13:20 UTC to 2023-11-14 22:14:20 UTC"
    assert expected in said.output
    of = with_options(load(str(scenario_beside(tmp_path / "mine"))), dataset=tmp_path / "mine")
    *_, before = _time_warnings(streams_of(of))
    assert expected in before
    (warning,) = evaluate(samples(published_by(of))).warnings
    assert expected in warning


S = 10**9
NOW_S = 1_763_800_000


def presence(*behind: tuple[float, float]) -> Presence:
    found = Presence()
    for node in ("central", "robot/r1", "robot/r2", "robot/r3"):
        found._take_message(build.liveliness(node=node), 0)
    for k, each in enumerate(behind, 1):
        node = f"source/r{k}"
        found._take_message(build.liveliness(node=node), 0)
        for wall_s, late_s in zip((NOW_S, NOW_S + 2), each, strict=True):
            stamp_ns = round((wall_s - late_s) * S)
            status = build.status(stamp_ns=stamp_ns, node=node, state="measuring")
            found._take_message(status, wall_s * S)
    return found


IN_TIME, YEARS = (0.0, 0.0), (5e8, 5e8)


@pytest.mark.parametrize(
    ("clocks", "words"),
    [
        ((IN_TIME, IN_TIME, (7.0, 7.0)), "stamps 7.0 s behind the others: set its machine"),
        ((IN_TIME, IN_TIME, (-7.0, -7.0)), "stamps 7.0 s ahead of the others: set its machine"),
        ((IN_TIME, IN_TIME, (9.0, 7.0)), "it lags and catches up: its program delivers old"),
        ((IN_TIME, IN_TIME, (6.0, 7.0)), "it lags and falls further behind"),
        ((YEARS, YEARS, (5e8 + 20, 5e8 + 20)), "began later or go slower: the map waits for them"),
        ((IN_TIME, IN_TIME, YEARS), "recorded data, which began later or go slower: the map"),
        ((YEARS, YEARS, (5e8 - 20, 5e8 - 20)), "of which the others began later or go slower"),
    ],
)
def test_who_lags_or_replays_is_not_told_to_set_its_clock(clocks, words):
    (advice,) = presence(*clocks).advice()
    assert advice.startswith("source/r3 stamps ")
    assert words in advice
    assert ("set its machine's clock" in advice) == ("set its machine" in words)


# Bearings with the wrong sign.


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
    result = evaluate(published(replace(ALONE, robots=2, mirrored=("r1",)), tmp_path))
    causes = [m.Diagnosis(cause="noise_underestimated", robot=each) for each in ("r1", "r2", "")]
    result = replace(result, map=replace(result.map, diagnosis=tuple(causes)))
    assert [(each.cause, each.robot) for each in result.diagnosis] == [
        ("mirrored", "r1"),
        ("noise_underestimated", "r2"),
        ("noise_underestimated", ""),
    ]
