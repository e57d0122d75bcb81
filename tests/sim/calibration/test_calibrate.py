from dataclasses import replace
from pathlib import Path as File
from typing import Any

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import Path, on_circle
from teamslam.sim.calibration.calibrate import Calibration, calibrate_models
from teamslam.sim.calibration.data import Reference
from teamslam.sim.calibration.figures import CalibrationError, Figure, jackknife, with_figures
from teamslam.sim.calibration.join import join_team
from teamslam.sim.calibration.motion import UNITS as MOTION_UNITS
from teamslam.sim.calibration.motion import fit_motion
from teamslam.sim.calibration.scenario import scenario_text
from teamslam.sim.calibration.sensor import UNITS as SENSOR_UNITS
from teamslam.sim.calibration.sensor import fit_sensor
from teamslam.sim.datasets.utias import write_utias
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.world.streams import Intervals, grouped
from tests.commands import output_of, run
from tests.sim.logs import scenario, streams

SECOND = 1_000_000_000
SEEN = {i: np.array([3.0 * np.cos(i), 3.0 * np.sin(i)]) for i in range(1, 7)}
NOTHING = grouped(np.empty(0, np.int64), np.empty(0, np.uint32), np.empty(0), np.empty(0))


def reference(name: str, **fields: Any) -> Reference:
    nothing = {"seen": NOTHING, "sighted": NOTHING, "names": (), "teammates": {}}
    return Reference(**(nothing | {"name": name, "gap_ns": SECOND, "landmarks": SEEN} | fields))


def driven(
    seed: int, seconds: int = 900, speeds: tuple[float, ...] = (0.0, 0.05, 0.08, -0.06)
) -> Reference:
    """A base that drives 1.05 v less 0.1 m of each radian, turns 0.9 ω − 0.03 rad/m; 10 Hz.

    Below 0.02 m/s it drives 2.4 v.
    """
    rng = np.random.default_rng(seed)
    legs = seconds // 3
    v = np.repeat(rng.choice(speeds, legs), 30)
    w = np.repeat(rng.choice([0.0, 0.0, 0.15, -0.15, 0.4, -0.4], legs), 30)
    dt, n = 0.1, len(v)
    scale = np.where(np.abs(v) < 0.02, 2.4, 1.05)
    speed = np.sign(v) * np.maximum(scale * np.abs(v) - 0.1 * np.abs(0.9 * w), 0.0)
    ahead = speed * dt + 0.03 * np.sqrt(np.abs(speed) * dt) * rng.standard_normal(n)
    turn = 0.9 * w * dt - 0.03 * ahead + 0.08 * np.sqrt(np.abs(w) * dt) * rng.standard_normal(n)
    heading = np.append(0.0, np.cumsum(turn))
    middle = heading[:-1] + 0.5 * turn
    x, y = (np.append(0.0, np.cumsum(ahead * f(middle))) for f in (np.cos, np.sin))
    stamps = np.arange(n + 1, dtype=np.int64) * (SECOND // 10)
    path = Path(stamps, np.stack([x, y, on_circle(heading)], axis=1))
    intervals = Intervals(stamps[1:], np.diff(stamps), v, w)
    return reference(f"r{seed}", intervals=intervals, path=path)


def seeing(seed: int) -> Reference:
    """Standing at the middle, 4 Hz: ranges 0.95 d + 0.1, of σ 0.05 d, a fifth white, 5 s the rest.

    Bearings are 0.02 rad too large, of σ 0.01, all white, 3 % of them anywhere.
    """
    rng = np.random.default_rng(seed)
    n, dt = 1200, 0.25
    keep = np.exp(-dt / 5.0)
    rows = []
    for i, place in SEEN.items():
        slow = np.empty(n)
        slow[0] = rng.standard_normal()
        for k in range(1, n):
            slow[k] = keep * slow[k - 1] + np.sqrt(1.0 - keep**2) * rng.standard_normal()
        error = np.sqrt(0.8) * slow + np.sqrt(0.2) * rng.standard_normal(n)
        distance = np.hypot(*(place * (0.5 + 0.25 * i)))
        ranges = 0.95 * distance * (1.0 + 0.05 * error) + 0.1
        bearings = np.arctan2(place[1], place[0]) + 0.02 + 0.01 * rng.standard_normal(n)
        wild = rng.random(n) < 0.03
        bearings[wild] = rng.uniform(-3.0, 3.0, np.count_nonzero(wild))
        rows.append(
            np.stack([np.arange(n) * dt, np.full(n, i), ranges, on_circle(bearings)], axis=1)
        )
    all_rows = np.concatenate(rows)
    all_rows = all_rows[np.argsort(all_rows[:, 0], kind="stable")]
    stamps = np.rint(all_rows[:, 0] * 1e9).astype(np.int64)
    seen = grouped(stamps, all_rows[:, 1].astype(np.uint32), all_rows[:, 2], all_rows[:, 3])
    ends = np.array([0, int(stamps[-1])], dtype=np.int64)
    intervals = Intervals(ends[1:], np.diff(ends), np.zeros(1), np.zeros(1))
    landmarks = {i: place * (0.5 + 0.25 * i) for i, place in SEEN.items()}
    return reference(
        f"r{seed}",
        intervals=intervals,
        seen=seen,
        path=Path(ends, np.zeros((2, 3))),
        gap_ns=int(ends[1]),
        landmarks=landmarks,
    )


def by_name(figures: tuple[Figure, ...]) -> dict[str, Figure]:
    return {figure.name: figure for figure in figures}


@pytest.fixture(scope="module")
def bases():
    return [driven(seed) for seed in range(1, 6)]


def test_the_odometrys_figures_come_out_of_measurements_within_their_uncertainty(bases):
    found = by_name(jackknife(lambda part: fit_motion(part, None), bases, MOTION_UNITS))
    true = {"forward_scale": 1.05, "turn_drag": 0.1, "yaw_scale": 0.9, "veer": -0.03}
    for name, value in true.items():
        figure = found[name]
        assert abs(figure.value - value) < 4.0 * figure.sigma + 1e-3, figure
        assert figure.sigma < 0.02, figure
    assert found["forward.per_m"].value == pytest.approx(0.03, rel=0.15)
    assert found["turn.per_rad"].value == pytest.approx(0.08, rel=0.15)


def test_the_sensors_figures_come_out_of_measurements_within_their_uncertainty():
    data = [seeing(seed) for seed in range(1, 6)]
    found = by_name(jackknife(fit_sensor, data, SENSOR_UNITS))
    true = {"range_scale": 0.95, "range_offset": 0.1, "bearing_offset": 0.02}
    for name, value in true.items():
        assert abs(found[name].value - value) < 4.0 * found[name].sigma + 1e-4, found[name]
    assert found["range_sigma_per_m"].value == pytest.approx(0.05, rel=0.1)
    assert found["range_white"].value == pytest.approx(0.2, abs=0.06)
    assert found["range_correlation_s"].value == pytest.approx(5.0, rel=0.25)
    assert found["bearing_sigma"].value == pytest.approx(0.01, rel=0.05)
    assert found["bearing_white"].value > 0.9
    assert found["bearing_outliers"].value == pytest.approx(0.03, abs=0.01)


def test_too_little_motion_or_too_few_measurements_are_said(bases):
    with pytest.raises(CalibrationError, match="needs 30 stretches of 10 s"):
        fit_motion([bases[0].between(0, 60 * SECOND)], None)
    with pytest.raises(CalibrationError, match="measurements of landmarks"):
        fit_sensor(bases)


def test_a_team_without_submaps_is_an_error_with_a_text():
    team = scenario(robots=2)
    world = streams(team)
    standing = [
        replace(s, intervals=s.intervals.where(np.zeros(len(s.intervals.end_ns), np.bool_)))
        for s in world.streams
    ]
    with pytest.raises(CalibrationError, match="no robot has odometry and measurements"):
        join_team(replace(world, streams=tuple(standing)), team)


def test_a_calibration_is_a_scenario_that_loads_with_the_learnt_models(tmp_path):
    motion = (Figure("forward_scale", 1.1, 0.01, ""), Figure("turn.per_m", 0.07, 0.002, "rad/√m"))
    sensor = (
        Figure("range_scale", 0.9, 0.001, ""),
        Figure("range_correlation_s", 7.0, 1.0, "s"),
        Figure("bearing_outliers", 0.017, 0, ""),
    )
    central = (Figure("covariance_factor", 1.75, 0.1, ""),)
    detections = (
        Figure("detection_probability", 0.75, 0.01, ""),
        Figure("clutter_share", 0, 0, ""),
    )
    found = Calibration(motion, sensor, True, ("a note",), central, detections=detections)
    place = tmp_path / "mine.toml"
    text = scenario_text(found, load("utias"), None, ["set.zip"], place)
    place.write_text(text, "utf-8")
    for said in (
        "# defaults.motion.turn.per_m: 0.07 ± 0.002 rad/√m",
        "# defaults.sensor.range_correlation_s: 7 ± 1 s",
        "# defaults.sensor.bearing_outliers: 0.017 ±",
        "# defaults.front_end.association.clutter_share: 0 ±",
    ):
        assert said in text
    written, before = load(place), load("utias")
    assert written.central == msgspec.structs.replace(before.central, covariance_factor=1.75)
    learnt = with_figures(before, motion, sensor)
    for mine, theirs in zip(written.robots, learnt.robots, strict=True):
        assert (mine.motion.forward_scale, mine.motion.turn.per_m) == (1.1, 0.07)
        for name in ("range_scale", "range_correlation_s"):
            assert getattr(mine.sensor, name) == getattr(theirs.sensor, name)
        assert mine.sensor == written.robots[0].sensor, "nothing is known of one robot by itself"
        assert mine.front_end.association.detection_probability == 0.75


OWN = """
name = "mine"
exchange = "continuous"
[world]
kind = "utias"
path = "set"
[defaults.motion]
kind = "turn-then-drive"
[[robots]]
id = "r1"
[robots.sensor]
range_scale = 1.2
field_of_view = 4.0
[[robots]]
id = "r2"
[robots.motion]
forward_scale = 2.0
[robots.front_end]
window_s = 7.0
"""


def test_what_is_learnt_goes_into_the_users_scenario_and_all_else_stays(tmp_path):
    own, elsewhere = tmp_path / "set" / "own.toml", tmp_path / "learnt.toml"
    own.parent.mkdir()
    own.write_text(OWN.replace('"set"', '"."'), "utf-8")
    of_sensor = (Figure("range_scale", 0.98765432, 0.001, ""), Figure("bearing_outliers", 0, 0, ""))
    of_robots = {"r2": (Figure("range_offset", 0.1, 0.01, "m"),)}
    found = Calibration(
        (Figure("forward_scale", 1.1, 0.01, ""),), of_sensor, True, (), (), of_robots
    )
    elsewhere.write_text(scenario_text(found, load(own), str(own), ["set"], elsewhere), "utf-8")
    before, learnt = load(own), load(elsewhere)
    assert File(learnt.world.path).resolve() == File(before.world.path).resolve()
    assert learnt.exchange == "continuous"
    assert [robot.motion.kind for robot in learnt.robots] == ["turn-then-drive"] * 2
    assert [robot.motion.forward_scale for robot in learnt.robots] == [1.1, 1.1]
    assert [robot.sensor.range_scale for robot in learnt.robots] == [0.98765, 0.98765]
    assert [robot.sensor.range_offset for robot in learnt.robots] == [0.0, 0.1]
    assert learnt.robots[0].sensor.field_of_view == 4.0
    assert learnt.robots[1].front_end.window_s == 7.0
    assert "# defaults.sensor.bearing_outliers: 0 ± 0" in elsewhere.read_text("utf-8")


def test_robots_that_teach_nothing_are_named_and_too_short_a_time_of_the_others_is_said(tmp_path):
    write_utias(streams(scenario(robots=2)), tmp_path / "set")
    (tmp_path / "set" / "Robot2_Groundtruth.dat").unlink()
    said = output_of("calibrate", tmp_path / "set", status=1)
    assert "set r2: no ground truth: nothing is learnt from it" in said
    assert "these data have 2: give several data sets at once, record 4.7 minutes" in said
    assert "where the path is known throughout" in said


def test_a_log_that_is_too_short_and_a_wrong_name_end_with_their_reason(tmp_path):
    team = scenario()
    with pytest.raises(CalibrationError, match="needs 30 stretches of 10 s"):
        calibrate_models([("a log", streams(team))], team, lambda text: None)
    result = output_of("calibrate", "a.zip", "-o", tmp_path / "a.json", status=2)
    assert "ends in .toml" in result


def test_an_output_in_a_folder_that_can_not_be_made_is_refused_before_the_data_is_read(tmp_path):
    (tmp_path / "file").touch()
    for folder, reads in (("file", False), ("new/folder", True)):
        output = str(tmp_path / folder / "mine.toml")
        result = run("calibrate", tmp_path / "none", "-o", output)
        assert result.exit_code != 0
        assert ("reading" in result.output) == reads
