from pathlib import Path

import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import MapResult
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.wire import messages as m
from tests.scenarios import final_only, scenario_in, with_front_ends
from tests.trials.stress_world import StressWorld, write

TEAM = ("r1", "r2", "r3")
CAUSES = ("clock_offset", "odometry_scale", "bearing_offset", "range_offset")


def mapped(world: StressWorld, place: Path, *, blind: bool = False) -> MapResult:
    scenario = final_only(scenario_in(write(world, place)))
    if blind:
        scenario = with_front_ends(scenario, biases=())
    found = evaluate(run_team(scenario, streams_of(scenario))).map
    assert found.errors is not None
    return found


def shared_errors_of(found: MapResult) -> list[m.Diagnosis]:
    return [each for each in found.diagnosis if each.cause in CAUSES]


FAULTS: dict[str, tuple[StressWorld, str, float, set[str]]] = {
    "clock": (StressWorld(seed=4, late={"r2": 0.1}), "clock_offset", 0.1, {"r2"}),
    "bearing": (
        StressWorld(seed=1, bearing_offset={"r2": 0.05}), "bearing_offset", 0.05, {"r2"},
    ),
    "odometry +5 %": (
        StressWorld(seed=1, odometry_scale=dict.fromkeys(TEAM, 1.05)),
        "odometry_scale", -0.048, {"r1", "r2", "r3"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_robot_with_a_fault_is_named_with_its_value_and_the_map_stays_consistent(fault, tmp_path):
    world, cause, value, robots = FAULTS[fault]
    found = mapped(world, tmp_path / "seen")
    named = [each for each in shared_errors_of(found) if each.cause == cause]
    assert {each.robot for each in named} == robots
    for each in named:
        assert abs(each.value[0] - value) < max(3.5 * each.sigma[0], 0.25 * abs(value))
    assert found.errors.nees_per_dof < 2.0
    if "odometry" in fault:  # a lone robot with bearings that are off is withdrawn otherwise
        blind = mapped(world, tmp_path / "blind", blind=True)
        assert not shared_errors_of(blind)
        assert blind.errors.nees_per_dof > 3.0


def test_a_clock_beyond_the_linear_range_is_named_as_late(tmp_path):
    late = 0.5
    found = mapped(StressWorld(seed=1, late={"r2": late}), tmp_path)
    named = next(each for each in shared_errors_of(found) if each.cause == "clock_offset")
    assert named.robot == "r2"
    assert 0.5 * late < named.value[0] < late + 3.0 * named.sigma[0]
    assert found.errors.nees_per_dof < 6.0


def test_a_robot_with_one_landmark_keeps_its_configuration(tmp_path):
    """Its biases are determined by their prior alone."""
    found = mapped(StressWorld(seed=2, landmarks=1, robots=1, seconds=120.0), tmp_path)
    assert not shared_errors_of(found)
    assert found.errors.nees_per_dof < 5.0
