from dataclasses import replace
from pathlib import Path as File
from typing import Any

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import TRUTH_GAP_NS, Path, on_circle
from teamslam.sim.calibration.calibrate import Calibration, calibrate_models
from teamslam.sim.calibration.claims import landmark_factor, mount_note, odometry_factor
from teamslam.sim.calibration.data import Reference, references, true_paths
from teamslam.sim.calibration.figures import CalibrationError, Figure, jackknife, with_figures
from teamslam.sim.calibration.join import join_team
from teamslam.sim.calibration.motion import UNITS as MOTION_UNITS, fit_motion
from teamslam.sim.calibration.own import marker_spread, own_constants
from teamslam.sim.calibration.scenario import scenario_text
from teamslam.sim.calibration.sensor import UNITS as SENSOR_UNITS, fit_sensor
from teamslam.sim.datasets.utias import write_utias
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.simulator import simulate
from teamslam.sim.world.streams import Intervals, grouped
from teamslam.team.config import MotionModel, MotionNoise, RobotConfig, Sensor
from tests.commands import output_of, run
from tests.scenarios import with_world
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
    sensor = (Figure("range_scale", 0.9, 0.001, ""), Figure("range_correlation_s", 7.0, 1.0, "s"))
    central = (Figure("covariance_factor", 1.75, 0.1, ""),)
    detections = (Figure("detection_probability", 0.75, 0.01, ""),)
    found = Calibration(motion, sensor, True, ("a note",), central, detections=detections)
    place, before = tmp_path / "mine.toml", load("utias")
    text = scenario_text(found, before, None, ["set.zip"], place)
    place.write_text(text, "utf-8")
    assert "# defaults.motion.turn.per_m: 0.07 ± 0.002 rad/√m" in text
    assert "# defaults.sensor.range_correlation_s: 7 ± 1 s" in text
    written, learnt = load(place), with_figures(before, motion, sensor)
    assert written.central == msgspec.structs.replace(before.central, covariance_factor=1.75)
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
    write_utias(streams(with_world(scenario(robots=2), steps=210)), tmp_path / "set")
    (tmp_path / "set" / "Robot2_Groundtruth.dat").unlink()
    said = output_of("calibrate", tmp_path / "set", status=1)
    assert "set r2: no ground truth: nothing is learnt from it" in said
    assert "these data have 20: give several data sets at once, record 1.7 minutes" in said
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


PLACES = {i: (1.0 + 0.4 * i) * np.array([np.cos(a), np.sin(a)])
          for i, a in enumerate(np.linspace(-0.6, 0.6, 8), 1)}  # fmt: skip
CAMERAS = {"r1": (1.02, 0.05, 0.0), "r2": (1.05, 0.0, 0.01), "r3": (0.99, 0.1, -0.04)}
"""range_scale, range_offset [m], optical_axis [rad]."""
BENT = -0.05  # cubic error of the bearings


def looking(
    robot: str,
    world: int,
    camera: tuple[float, float, float],
    *,
    depth: bool = True,
    marker: float = 0.0,
) -> Reference:
    rng = np.random.default_rng([int(robot[1:]), world])
    scale, offset, axis = camera
    ids = np.repeat(np.array(list(PLACES), np.uint32), 300)
    places = np.repeat(np.array(list(PLACES.values())), 300, axis=0)
    bearings = np.arctan2(places[:, 1], places[:, 0])
    distances = np.hypot(*places.T) * (1.0 + 0.01 * rng.standard_normal(len(ids)))
    distances *= 1.0 + marker * np.random.default_rng(world).standard_normal(len(PLACES))[ids - 1]
    raw = bearings + 0.01
    for _ in range(20):
        raw = bearings + 0.01 + BENT * raw**3
    along = np.cos(raw - axis) if depth else 1.0
    read = on_circle(raw + 0.002 * rng.standard_normal(len(ids)))
    stamps = rng.permutation(len(ids)).astype(np.int64) * 100_000_000
    order = np.argsort(stamps)
    seen = grouped(
        stamps[order], ids[order], (scale * distances * along + offset)[order], read[order]
    )
    last = int(stamps.max())
    intervals = Intervals(np.array([last]), np.array([last]), np.zeros(1), np.zeros(1))
    path = Path(np.array([0, last]), np.zeros((2, 3)))
    label = f"{world} {robot}"
    return reference(
        label, intervals=intervals, seen=seen, path=path, gap_ns=last, landmarks=PLACES
    )


def team(cameras: dict[str, tuple[float, float, float]], *, depth: bool = True) -> list[Reference]:
    return [looking(r, w, camera, depth=depth) for w in (1, 2) for r, camera in cameras.items()]


def test_each_cameras_own_constants_come_out_where_they_differ():
    own = own_constants(team(CAMERAS), depth=True)
    assert list(own.robots) == list(CAMERAS)
    for robot, (scale, offset, axis) in CAMERAS.items():
        found = {figure.name: figure for figure in own.robots[robot]}
        assert found["range_scale"].value == pytest.approx(scale, abs=0.003)
        assert found["range_offset"].value == pytest.approx(offset, abs=0.006)
        assert found["bearing_lens.cubic"].value == pytest.approx(BENT, abs=0.01)
        assert found["optical_axis"].value == pytest.approx(axis, abs=0.003)
    assert {figure.name for figure in own.strays} == {
        "bias_sigma.bearing", "bias_sigma.range_offset", "bias_sigma.range_scale",
        "common_bias_sigma.range_scale",
    }  # fmt: skip
    assert max(f.value for f in own.strays if f.name.endswith("range_scale")) < 0.003


def test_a_camera_that_was_changed_between_worlds_does_not_widen_what_all_have():
    data = team(CAMERAS | {"r4": CAMERAS["r1"]})
    before = {figure.name: figure.value for figure in own_constants(data, depth=True).strays}
    data[-1] = replace(looking("r4", 2, (1.08, 0.0, 0.0)), name="2 r4")
    after = {figure.name: figure.value for figure in own_constants(data, depth=True).strays}
    assert after["bias_sigma.range_scale"] < 3.0 * before["bias_sigma.range_scale"] + 1e-3


def test_how_far_all_range_scales_stray_together_is_learnt_from_world_to_world():
    read = [
        looking(robot, world, (scale + by, *rest))
        for world, by in ((1, 0.02), (2, -0.02))
        for robot, (scale, *rest) in CAMERAS.items()
    ]
    found = {figure.name: figure.value for figure in own_constants(read, depth=True).strays}
    own = found["bias_sigma.range_scale"]
    together = np.sqrt((2.0 * own**2 + 2.0 * 0.02**2) / 3.0 * 1.5)
    assert found["common_bias_sigma.range_scale"] == pytest.approx(together, rel=0.1)


def test_how_far_markers_differ_comes_out_and_is_none_where_they_are_alike():
    """Six worlds of eight landmarks; the fitted constants absorb a part of the spread."""
    marked = [
        looking(r, world, camera, marker=0.02)
        for world in range(1, 7)
        for r, camera in CAMERAS.items()
    ]
    found = marker_spread(marked, depth=True)
    assert found.name == "common_bias_sigma.marker"
    assert found.value == pytest.approx(0.02, abs=3.0 * found.sigma)
    assert 0.0005 < found.sigma < 0.004
    assert marker_spread(team(CAMERAS), depth=True) is None
    assert marker_spread(marked[:1], depth=True) is None


MOUNT = (1.2, -0.4, 0.3)
ROBOTS = [
    RobotConfig(
        f"r{i}",
        motion=MotionModel(
            forward=MotionNoise(0.02), turn=MotionNoise(0.01), lateral=MotionNoise(0.02)
        ),
        sensor=Sensor(range_sigma=0.1, bearing_sigma=0.02, mount=MOUNT),
    )
    for i in range(6)
]
WORLD = SimulatedWorld(
    steps=300, size_m=30.0, landmark_count=12, visible_from_m=1.0, visible_to_m=12.0,
    odometry="increments", odometry_claims=True, odometry_correlation=0.5,
    landmark_claims=(0.5, 2.0), claims_factor=4.0,
)  # fmt: skip


def seen(assumed: tuple[float, float, float] = MOUNT, **changes: object) -> list[Reference]:
    world = simulate(msgspec.structs.replace(WORLD, **changes), ROBOTS, 3)
    assert world.landmarks is not None
    places = dict(zip(world.landmark_ids.tolist(), world.landmarks, strict=True))
    sensor = msgspec.structs.replace(ROBOTS[0].sensor, mount=assumed)
    models = msgspec.structs.replace(ROBOTS[0], sensor=sensor)
    paths = true_paths(world.streams)
    return references(world, paths, places, TRUTH_GAP_NS, "set", frozenset(), models)


@pytest.mark.parametrize("told", ["ranges", "points"])
def test_the_factors_of_what_is_claimed_are_learnt(told):
    data = seen(landmark_form=told)
    assert odometry_factor(data)["covariance_factor"] == pytest.approx(4.0, rel=0.25)
    found = landmark_factor(data, ROBOTS[0].sensor)["covariance_factor"]
    assert found == pytest.approx(4.0, rel=0.1)


def test_a_mount_that_is_not_the_scenarios_is_told_and_where_it_is():
    assert mount_note(seen(), ROBOTS[0].sensor) == ()
    wrong = msgspec.structs.replace(ROBOTS[0].sensor, mount=(0.0, 0.0, 0.3))
    (note,) = mount_note(seen(wrong.mount), wrong)
    told = note.partition("sensor.mount = [")[2].partition("]")[0]
    np.testing.assert_allclose([float(x) for x in told.split(",")], MOUNT, atol=0.03)


def test_a_place_that_the_view_does_not_determine_is_refused_by_name():
    data = seen()
    for k, each in enumerate(data):
        object.__setattr__(each, "seen", each.seen.only(0, 3 + k))
    (note,) = mount_note(data, ROBOTS[0].sensor)
    assert note.startswith("mount: the sensor's place on the base is not learnt")
