from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from teamslam.sim.calibration import calibrate
from teamslam.sim.calibration.calibrate import Calibration, against_truth, calibrate_models
from teamslam.sim.calibration.clocks import Clock, clocks_of, on_one_clock
from teamslam.sim.calibration.figures import Figure
from teamslam.sim.calibration.scenario import scenario_text
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from tests.scenarios import scenario_in
from tests.trials.stress_world import StressWorld, write

OFFSET_S = 0.5
SMALL = StressWorld(robots=2, landmarks=12, half_m=12.0, seconds=240.0)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    late = StressWorld(**{**vars(SMALL), "late": {"r2": OFFSET_S}})
    root = tmp_path_factory.mktemp("sets")
    return write(SMALL, root / "right"), write(late, root / "late")


def test_a_late_clock_is_found_without_a_mount_and_is_written_into_the_scenario(
    places, monkeypatch
):
    """The scenario has a part of the offset already; the rest adds to it."""
    monkeypatch.setattr(calibrate, "join_team", lambda *_: SimpleNamespace(fold=None))
    monkeypatch.setattr(calibrate, "central_figures", lambda *_: ())
    late = scenario_in(places[1])
    begun = msgspec.structs.replace(late.robots[1], clock_offset_s=0.1)
    scenario = msgspec.structs.replace(late, robots=(late.robots[0], begun))
    found = calibrate_models([("late", streams_of(scenario))], scenario, lambda _: None)
    assert found.clocks["r1"].value == 0.0
    figure = found.clocks["r2"]
    assert abs(figure.value - OFFSET_S) < max(3.0 * figure.sigma, 0.01)
    assert 0.0 < figure.sigma < 0.05
    assert not [note for note in found.notes if "sensor.mount" in note]
    assert [note for note in found.notes if note.startswith("r2: its detections are stamped")]
    learnt = places[1] / "learnt.toml"
    own = str(places[1] / "scenario.toml")
    learnt.write_text(scenario_text(found, late, own, ["late"], learnt))
    after = with_options(load(str(learnt)), dataset=places[1])
    assert [robot.clock_offset_s for robot in after.robots] == [
        0.0,
        pytest.approx(figure.value, rel=1e-4),
    ]
    assert "clock_offset_s" in scenario_text(found, late, None, ["late"], learnt)


def test_clocks_that_are_right_are_left_alone(places):
    right = scenario_in(places[0])
    data = against_truth([("right", streams_of(right))], right)[0]
    clocks = clocks_of(data, right.robots[0].sensor)
    assert list(clocks) == ["r1", "r2"]
    assert not any(clock.is_off for clock in clocks.values())


def test_a_robot_whose_clock_was_not_learnt_stays_in_the_team(tmp_path):
    """A scenario that names one robot names all of the team."""
    own = tmp_path / "scenario.toml"
    for robot in ("r1", "r2", "r3"):
        (tmp_path / robot).mkdir()
        (tmp_path / robot / "odometry.csv").touch()
    own.write_text('base = "recorded"\n[world]\nkind = "folder"\npath = "."\n')
    late = Figure("clock_offset_s", 0.5, 0.01, "s")
    found = Calibration((), (), True, (), clocks={"r2": late}, team=("r1", "r2", "r3"))
    learnt = tmp_path / "learnt.toml"
    learnt.write_text(scenario_text(found, load(str(own)), str(own), ["set"], learnt))
    clocks = {robot.id: robot.clock_offset_s for robot in load(str(learnt)).robots}
    assert clocks == {"r1": 0.0, "r2": 0.5, "r3": 0.0}


def test_a_late_robot_is_compared_with_its_teammates_at_one_time(places):
    """Detections and odometry are moved to the clock of the true paths."""
    streams = streams_of(scenario_in(places[0]))
    late = Clock(*(Figure(name, s, 0.01, "s") for name, s in (("a", 0.3), ("b", -0.2), ("c", 0.5))))
    before, after = (world.streams[1] for world in (streams, on_one_clock(streams, {"r2": late})))
    assert after.truth_ns is before.truth_ns
    moved = after.landmark_detections.stamps_ns - before.landmark_detections.stamps_ns
    assert np.unique(moved).tolist() == [-300_000_000]
    moved = after.intervals.end_ns - before.intervals.end_ns
    assert np.unique(moved).tolist() == [200_000_000]
