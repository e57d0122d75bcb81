import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.datasets import utias as errata
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.datasets.utias import landmark_shift, utias, write_utias
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.publisher.node import WorldNode
from teamslam.sim.scenarios.scenario import Scenario, dumps, load, loads, with_options
from teamslam.sim.scenarios.source import (
    open_data_set,
    scenario_beside,
    streams_of,
    with_present_robots,
)
from teamslam.sim.studies.experiments.accuracy_starts import is_wrong, unknown_starts
from teamslam.sim.studies.experiments.team_runs import Figures, team_figures
from teamslam.sim.world.config import UtiasWorld
from teamslam.sim.world.streams import OBSERVATIONS, ODOMETRY, START, RobotStream, WorldStreams
from teamslam.team.config import RobotConfig
from teamslam.team.wire import messages as m
from tests import build
from tests.commands import run
from tests.scenarios import with_front_ends, with_robots, with_world

REAL = Path(__file__).parents[4] / "shared" / "utias"


def team(count: int) -> list[RobotConfig]:
    return [RobotConfig(id=f"r{i}") for i in range(1, count + 1)]


def read(path: Path, count: int = 3, **options: float | bool) -> WorldStreams:
    return utias(UtiasWorld(path=str(path), **options), team(count))


@pytest.fixture(scope="module")
def simulated():
    return streams_of(load("waypoints"))


@pytest.fixture
def folder(tmp_path, simulated):
    write_utias(simulated, tmp_path / "MRCLAM_Dataset0")
    return tmp_path / "MRCLAM_Dataset0"


def edited(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:2] + change(lines[2:])) + "\n")


def without_empty_messages(stream: RobotStream) -> np.ndarray:
    lengths = np.diff(stream.landmark_detections.offsets)
    keep = np.ones(len(stream), dtype=bool)
    observations = stream.kinds == OBSERVATIONS
    keep[observations] = lengths[stream.rows[observations]] > 0
    return keep


def assert_same_measurements(given: RobotStream, found: RobotStream, shift: int) -> None:
    keep = without_empty_messages(given)
    assert np.array_equal(found.kinds, given.kinds[keep])
    assert np.array_equal(found.stamps_ns, given.stamps_ns[keep])
    assert found.teammates == given.teammates
    for name in ("duration_ns", "forward", "yaw_rate"):
        assert np.allclose(
            getattr(found.intervals, name), getattr(given.intervals, name), atol=1e-9
        )
    for name, added in (("landmark_detections", shift), ("teammate_detections", 0)):
        a, b = getattr(found, name), getattr(given, name)
        assert np.array_equal(a.ids, b.ids + added)
        assert np.allclose(a.ranges, b.ranges, rtol=0, atol=1e-9)
        assert np.allclose(a.bearings, b.bearings, rtol=0, atol=1e-9)
    assert np.allclose(found.truth, given.truth, rtol=0, atol=1e-9)


def test_what_is_written_is_read_again(folder, simulated):
    found = read(folder)
    assert landmark_shift(simulated) == 5, "subjects 1 to 5 are robots"
    assert np.array_equal(found.landmark_ids, simulated.landmark_ids + 5)
    assert np.allclose(found.landmarks, simulated.landmarks, rtol=0, atol=1e-9)
    assert found.source == "UTIAS data set MRCLAM_Dataset0"
    for given, read_again in zip(simulated.streams, found.streams, strict=True):
        assert_same_measurements(given, read_again, 5)
        assert read_again.start.covariance is None
        assert np.allclose(read_again.start.pose, given.start.pose, rtol=0, atol=1e-9)


def test_a_set_of_another_rig_brings_its_own_models(folder):
    assert scenario_beside(folder) == "utias"
    own = folder / "scenario.toml"
    own.write_text('base = "utias"\n[defaults.sensor]\nrange_is_depth = false\n', "utf-8")
    assert scenario_beside(folder) == str(own)
    zipped = Path(shutil.make_archive(str(folder), "zip", folder.parent, folder.name))
    within = scenario_beside(zipped)
    assert within == str(zipped / folder.name / "scenario.toml")
    for each in (own, within):
        loaded = with_options(load(str(each)), dataset=zipped)
        assert loaded.team == folder.name
        assert [robot.sensor.range_is_depth for robot in loaded.robots] == [False] * 5
    streams, scenario, _ = open_data_set(folder)
    assert [robot.sensor.range_is_depth for robot in scenario.robots] == [False] * 3
    assert [stream.robot for stream in streams.streams] == ["r1", "r2", "r3"]


@pytest.mark.parametrize("inside", ["", "MRSLAM_Dataset4/", "a/b/"])
def test_a_zip_is_read_as_its_folder_whatever_the_folder_is_called(folder, tmp_path, inside):
    archive = tmp_path / "set.zip"
    with zipfile.ZipFile(archive, "w") as target:
        for path in folder.iterdir():
            target.write(path, inside + path.name)
    expected, found = read(folder), read(archive)
    for a, b in zip(expected.streams, found.streams, strict=True):
        assert np.array_equal(a.stamps_ns, b.stamps_ns)
        assert np.array_equal(a.landmark_detections.ranges, b.landmark_detections.ranges)


def test_odometry_acts_later_by_its_delay(folder):
    prompt = read(folder).streams[0]
    late = read(folder, odometry_delay_s=0.25).streams[0]
    assert np.array_equal(late.intervals.end_ns, prompt.intervals.end_ns + 250_000_000)
    assert np.array_equal(late.intervals.forward, prompt.intervals.forward)
    seen, before = late.landmark_detections, prompt.landmark_detections
    assert np.array_equal(seen.ranges, before.ranges), "the camera's clock stays"


def test_a_robots_clock_offset_orders_its_measurements_and_leaves_its_stamps(folder):
    world = UtiasWorld(path=str(folder), odometry_delay_s=0.1)
    robots = [msgspec.structs.replace(team(1)[0], clock_offset_s=0.4)]
    (stream,) = utias(world, robots).streams
    (late,) = read(folder, 1, odometry_delay_s=0.5).streams
    assert np.array_equal(stream.stamps_ns, late.stamps_ns)
    node = WorldNode(
        utias(world, robots), frozenset(), build.configuration(node="world", incarnation=0)
    )
    sent = [o.message for o in node.publish(0.0) if isinstance(o.message, m.Odometry)]
    assert sent[0].stamp_ns == late.intervals.end_ns[0] - 400_000_000


@pytest.mark.parametrize("name", ["waypoints", "downs-100"])
def test_a_simulated_set_comes_with_a_scenario_that_runs_its_team(name, tmp_path):
    done = run("simulate", name, "-o", tmp_path / "set")
    assert done.exit_code == 0
    scenario, source = load(tmp_path / "set" / "scenario.toml"), load(name)
    assert f"teamslam launch {tmp_path / 'set' / 'scenario.toml'}" in done.stdout
    assert scenario.robots == source.robots
    assert (scenario.central, scenario.seed) == (source.central, source.seed)
    found, given = streams_of(scenario), streams_of(source)
    for before, after in zip(given.streams, found.streams, strict=True):
        assert np.allclose(before.start.pose, after.start.pose, atol=1e-8)
        assert np.allclose(before.intervals.forward, after.intervals.forward, atol=1e-8)
        assert len(before.landmark_detections.ids) == len(after.landmark_detections.ids)


def test_measurements_that_mean_nothing_are_dropped_and_counted(folder):
    expected = read(folder).streams[0]
    extra = [
        "50.0 999 1.0 0.0",  # no such barcode
        "50.1 1101 1.0 0.0",
        "50.2 101 1.0 0.0",  # the robot itself
        "50.3 106 0.0 0.0",  # no range
        "50.4 106 2.0 0.1",
        "50.4 106 2.5 0.2",  # repeated at the same time
        "5000.0 106 2.0 0.1",  # long after the last odometry
        "5000.0 102 2.0 0.1",
    ]
    edited(folder / "Robot1_Measurement.dat", lambda rows: sorted([*rows, *extra], key=time_of))
    found = read(folder).streams[0]
    assert set(found.notes) == {
        "2 measurements dropped: unknown barcode",
        "1 measurement dropped: range not above 0",
        "1 measurement dropped: a second one of the same subject at the same time",
        "2 measurements dropped: after its last odometry, where its motion is not known",
        "1 measurement dropped: of itself",
    }
    assert len(found) == len(expected) + 1 - np.count_nonzero(~without_empty_messages(expected))
    seen = found.landmark_detections
    assert seen.ranges[seen.rows(int(np.searchsorted(seen.stamps_ns, 50_400_000_000)))] == [2.0]


def time_of(row: str) -> float:
    return float(row.split()[0])


def test_sightings_of_robots_outside_the_team_are_dropped_and_counted(folder):
    whole, part = read(folder, 3).streams[1], read(folder, 2).streams[1]
    met = whole.teammate_detections.ids
    assert part.teammates == ("r1", "r2")
    assert np.count_nonzero(met == 0) == len(part.teammate_detections.ids) > 0
    lost = np.count_nonzero(met == 2)
    assert f"{lost} measurements dropped: of a robot that is not in the team" in part.notes


@pytest.mark.parametrize(
    ("kind", "lost", "note"),
    [
        ("Odometry", ODOMETRY, "no odometry: only its observations are used"),
        ("Measurement", OBSERVATIONS, "no measurements: only its odometry is given"),
    ],
)
def test_a_robot_without_a_table_gives_what_the_other_one_has(folder, kind, lost, note):
    expected = read(folder).streams
    (folder / f"Robot2_{kind}.dat").unlink()
    found = read(folder).streams
    assert lost not in found[1].kinds
    assert {START, ODOMETRY if lost == OBSERVATIONS else OBSERVATIONS} <= set(found[1].kinds)
    assert found[1].kinds[0] == START
    assert note in found[1].notes
    assert len(found[0]) == len(expected[0])


def test_a_team_maps_a_set_without_truth_and_without_one_robots_odometry(folder):
    for name in ("Robot2_Odometry", "Robot1_Groundtruth", "Robot2_Groundtruth"):
        (folder / f"{name}.dat").unlink()
    (folder / "Landmark_Groundtruth.dat").unlink()
    scenario = mapped_by_waypoints(folder)
    found = evaluate(run_team(scenario, streams_of(scenario)))
    assert found.unsound == 0
    assert len(found.map.ids) > 1
    assert found.map.errors is None
    assert np.all(np.linalg.eigvalsh(found.map.covariance) > 0.0)


def test_a_set_without_the_files_of_a_robot_is_run_by_the_others(folder):
    whole = mapped_by_waypoints(folder)
    assert with_present_robots(whole) == (whole, None)
    for path in folder.glob("Robot1_*"):
        path.unlink()
    scenario, said = with_present_robots(with_world(whole, unknown_starts=("*", "!r1")))
    assert said == "r1: no files in MRCLAM_Dataset0; the team is r2"
    found = evaluate(run_team(loads(dumps(scenario)), streams_of(scenario)))
    assert list(found.robots) == ["r2"]
    assert len(found.map.ids) > 0
    assert found.map.frame == "r2/1"
    for path in folder.glob("Robot2_*"):
        path.unlink()
    assert with_present_robots(whole) == (whole, None)


def mapped_by_waypoints(path):
    scenario = with_options(load("utias"), robots=2, dataset=path)
    robots = tuple(
        msgspec.structs.replace(robot, sensor=of.sensor, motion=of.motion)
        for robot, of in zip(scenario.robots, load("waypoints").robots, strict=False)
    )
    scenario = with_front_ends(msgspec.structs.replace(scenario, robots=robots), particles=20)
    return with_world(scenario, odometry_delay_s=0.0, duration_s=25.0)


def landmarks_seen(streams: WorldStreams) -> np.ndarray:
    return np.concatenate([stream.landmark_detections.ids for stream in streams.streams])


def test_an_erratum_is_applied_by_content_named_and_can_be_switched_off(folder, monkeypatch):
    plain = landmarks_seen(read(folder))
    assert read(folder).notes == ()
    rows = [np.loadtxt(folder / f"{name}.dat") for name in ("Barcodes", "Landmark_Groundtruth")]
    (known,) = errata.ERRATA.values()
    monkeypatch.setattr(errata, "ERRATA", {errata.content_digest(*rows): known})
    mended = read(folder)
    swapped = np.where(plain == 11, 17, np.where(plain == 17, 11, plain))
    assert not np.array_equal(plain, swapped)
    assert np.array_equal(landmarks_seen(mended), swapped)
    assert mended.notes == (known.note,)
    off = read(folder, errata=False)
    assert off.notes == ()
    assert np.array_equal(landmarks_seen(off), plain)


def replaced(kind: str, row: int, text: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        edited(folder / f"Robot1_{kind}.dat", lambda rows: [*rows[:row], text, *rows[row + 1 :]])

    return change


def barcodes(*rows: str) -> Callable[[Path], None]:
    return lambda folder: edited(folder / "Barcodes.dat", lambda _: list(rows))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (replaced("Odometry", 4, "4.0  0.1"), "Robot1_Odometry.dat, line 7: 2 columns, 3 expected"),
        (
            replaced("Measurement", 0, "0.5 106 1,5 0.1"),
            ".dat, line 3: range [m]: '1,5' is not a number",
        ),
        (replaced("Measurement", 2, "0.5 106 nan 0.1"), "line 5: range [m]: 'nan' is not finite"),
        (replaced("Odometry", 1, "1e300 0.0 0.1"), "line 4: time [s]: 1e300 is out of bounds"),
        (barcodes("1 5", "2 5"), "Barcodes.dat: one barcode has two subjects"),
        (barcodes("1 5.5"), "Barcodes.dat: expected rows of two whole numbers"),
        (
            lambda folder: edited(
                folder / "Landmark_Groundtruth.dat", lambda rows: [rows[0], *rows]
            ),
            "Landmark_Groundtruth.dat: one landmark has two positions",
        ),
        (lambda folder: (folder / "Barcodes.dat").unlink(), "no Barcodes.dat in it; expected the"),
        (lambda folder: shutil.copytree(folder, folder / "second"), "more than one data set in it"),
        (
            lambda folder: [path.unlink() for path in folder.glob("Robot1_*")],
            "the data set has no measurements of a robot r1; it has r2, r3",
        ),
        (
            lambda folder: [path.unlink() for path in folder.glob("Robot*")],
            "no RobotN_Odometry.dat in it; expected the folder or zip of one UTIAS MRCLAM set",
        ),
        (
            lambda folder: [path.write_text("# nothing\n") for path in folder.glob("Robot1_*")],
            "robot r1: neither odometry nor measurements in its files",
        ),
    ],
)
def test_damage_is_named_with_file_line_and_text(folder, damage, said):
    damage(folder)
    with pytest.raises(DatasetError) as refused:
        read(folder)
    assert said in str(refused.value)


def test_a_zip_with_a_damaged_member_is_refused(folder, tmp_path):
    path = tmp_path / "set.zip"
    with zipfile.ZipFile(path, "w") as target:
        for each in folder.iterdir():
            target.write(each, each.name)
    content = path.read_bytes()
    at = content.index(b"written by teamslam")
    path.write_bytes(content[:at] + b"W" + content[at + 1 :])
    with pytest.raises(DatasetError, match="not a zip, or a damaged one"):
        read(path)


def real(number: int, **options: bool) -> WorldStreams:
    path = REAL / f"MRCLAM_Dataset{number}.zip"
    if not path.exists():
        pytest.skip(f"the data set {path.name} is not here: it is not shipped")
    scenario = with_options(load("utias"), dataset=path)
    world = UtiasWorld(
        **{name: getattr(scenario.world, name) for name in scenario.world.__struct_fields__}
        | options
    )
    return utias(world, scenario.robots)


def range_errors(world: WorldStreams, landmark: int) -> np.ndarray:
    errors = []
    at = world.landmarks[world.landmark_ids == landmark][0]
    for stream in world.streams:
        seen = stream.landmark_detections
        stamps = np.repeat(seen.stamps_ns, np.diff(seen.offsets))
        x, y = (np.interp(stamps, stream.truth_ns, stream.truth[:, i]) for i in (0, 1))
        chosen = seen.ids == landmark
        errors.append((seen.ranges - np.hypot(at[0] - x, at[1] - y))[chosen])
    return np.concatenate(errors)


@pytest.mark.parametrize(
    ("number", "odometry_rows", "measurements"), [(2, 597_764, 46_499), (6, 301_431, 19_377)]
)
def test_of_a_real_set_every_row_is_a_measurement_or_in_a_note(number, odometry_rows, measurements):
    world = real(number)
    counts = [int(note.split()[0]) for s in world.streams for note in s.notes if "drop" in note]
    given = sum(
        len(stream.landmark_detections.ids) + len(stream.teammate_detections.ids)
        for stream in world.streams
    )
    intervals = sum(len(stream.intervals.end_ns) for stream in world.streams)
    last_rows = len(world.streams)  # a robot's last row has no end
    assert intervals + last_rows + given + sum(counts) == odometry_rows + measurements
    for landmark in world.landmark_ids.tolist():
        assert abs(np.median(range_errors(world, landmark))) < 0.25
    for stream in world.streams:
        assert np.hypot(*(stream.start.pose[:2] - stream.truth[0, :2])) < 0.05


def test_in_the_real_set_1_landmarks_11_and_17_are_put_right():
    mended, raw = real(1), real(1, errata=False)
    assert "landmarks 11 and 17" in mended.notes[0]
    assert raw.notes == ()
    for landmark in (11, 17):
        assert np.percentile(np.abs(range_errors(mended, landmark)), 90) < 0.5
        assert np.percentile(np.abs(range_errors(raw, landmark)), 50) > 0.5


SET_6 = Path(__file__).parents[4] / "shared" / "utias" / "MRCLAM_Dataset6.zip"


def slice_of_set_6() -> Scenario:
    scenario = with_options(load("utias"), dataset=SET_6)
    return with_robots(with_world(scenario, duration_s=100.0), pose_s=60.0)


def figures(scenario: Scenario) -> Figures:
    return team_figures(evaluate(run_team(scenario, streams_of(scenario))))


@pytest.mark.skipif(not SET_6.exists(), reason="the data set is not here: it is not shipped")
def test_one_declared_start_gives_the_map_that_five_give_and_joins_nobody_wrongly():
    declared = figures(slice_of_set_6())
    found = figures(unknown_starts(slice_of_set_6()))
    assert found["not_joined"] == []
    assert not any(is_wrong(each["first_pose_chi2"]) for each in found["robots"].values())
    assert found["landmarks"] == declared["landmarks"]
    assert found["rmse_aligned"] == pytest.approx(declared["rmse_aligned"], rel=0.1)
