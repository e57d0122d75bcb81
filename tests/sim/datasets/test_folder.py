import dataclasses
from pathlib import Path

import numpy as np
import pytest

from teamslam.sim.datasets.folder import folder
from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.datasets.kinds import kind_of
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.publisher.source import Source
from teamslam.sim.recorded.world import DataSetRun
from teamslam.sim.scenarios.scenario import Scenario, ScenarioError, load, with_options
from teamslam.sim.scenarios.source import (
    open_data_set,
    scenario_beside,
    streams_of,
    with_present_robots,
)
from teamslam.sim.world.config import FolderWorld
from teamslam.sim.world.streams import FIXES as FIXES_KIND, RobotStream, StartPose, WorldStreams
from teamslam.team.config import RobotConfig
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats
from teamslam.team.wire.channels import END
from teamslam.team.wire.codec import decoded
from tests import teams
from tests.commands import run


def data_set(path: Path, **tables: str) -> Path:
    for name, text in tables.items():
        place = path if name == "landmarks" else path / "r1"
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{name}.csv").write_text(text)
    return path


def read(path: Path, *robots: str, **options: object) -> WorldStreams:
    team = [RobotConfig(id=name) for name in robots or ("r1",)]
    return folder(FolderWorld(path=str(path), **options), team)


def only(path: Path, **options: object) -> RobotStream:
    return read(path, **options).streams[0]


def same(a: object, b: object) -> bool:
    """Equal type and bits of every array, apart from notes."""
    if dataclasses.is_dataclass(a):
        fields = [f.name for f in dataclasses.fields(a) if f.name not in ("notes", "source")]
        return type(a) is type(b) and all(same(getattr(a, f), getattr(b, f)) for f in fields)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.tobytes()) == (b.dtype, b.tobytes())
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


SPEED_HEAD, SEEN_HEAD = "t_s,forward_m_s,yaw_rate_rad_s\n", "t_s,landmark,range_m,bearing_rad\n"
SPEEDS = SPEED_HEAD + "0,1,0.1\n1,2,0.2\n3,0,0\n"
FIXES = "t_s,x_m,y_m,c_xx,c_xy,c_yy\n1,1.5,-2,4,0.5,3\n2,0.1,7,,,\n"
SEEN = SEEN_HEAD + "1,7,2.5,0.5\n1,3,1.5,-0.5\n2,7,2.4,0.4\n"


def test_what_is_written_is_read_again_to_the_last_bit(tmp_path):
    names = ("r9", "r2", "r1")
    off = StartPose(np.array([0.1, 1 / 3, -2.0]), np.array([[2, 1, 0], [1, 3, 1], [0, 1, 1.5]]))
    streams = [teams.stream(name, 9, known=False, seen_every=2) for name in names]
    streams[2] = dataclasses.replace(streams[2], start=off)
    world = WorldStreams(
        tuple(dataclasses.replace(each, teammates=names) for each in streams),
        np.array([2, 5], np.uint32),
        np.array([[0.1, 1 / 3], [1e-17, -2.0]]),
        "test",
    )
    write_folder(world, tmp_path)
    again = read(tmp_path, *names)
    assert same(again.streams[1:], world.streams[1:])
    assert "of itself" in str(again.streams[0].notes)  # all of them see r9, as r9 itself does
    assert same((again.landmark_ids, again.landmarks), (world.landmark_ids, world.landmarks))


def test_a_simulated_world_keeps_its_bits_with_its_empty_scans_and_sightings(tmp_path):
    world = streams_of(load("waypoints"))
    assert any(0 in np.diff(each.landmark_detections.offsets) for each in world.streams)
    write_folder(world, tmp_path)
    assert same(read(tmp_path, *(each.robot for each in world.streams)), world)


def test_speeds_hold_until_the_next_row_or_for_a_duration(tmp_path):
    held = only(data_set(tmp_path, odometry=SPEEDS, observations=SEEN)).intervals
    assert held.end_ns.tolist() == [10**9, 3 * 10**9]
    assert held.forward.tolist() == [1.0, 2.0]
    ended = "t_s,duration_s,forward_m_s,yaw_rate_rad_s\n1,0.5,1,0.1\n3,2,2,0.2\n"
    means = only(data_set(tmp_path, odometry=ended)).intervals
    assert means.end_ns.tolist() == [10**9, 3 * 10**9]
    assert means.duration_ns.tolist() == [5 * 10**8, 2 * 10**9]


def test_poses_are_taken_as_the_increments_between_them(tmp_path):
    x, y = 5 + np.cos(3) - np.sin(3), 5 + np.sin(3) + np.cos(3)
    text = f"t_s,x_m,y_m,theta_rad\n0,5,5,3\n2,{x},{y},{3 + np.pi / 2 - 2 * np.pi}\n"
    driven = only(data_set(tmp_path, odometry=text)).intervals
    assert (driven.end_ns.tolist(), driven.duration_ns.tolist()) == ([2 * 10**9], [2 * 10**9])
    assert driven.increments is not None
    np.testing.assert_allclose(driven.increments, [[1.0, 1.0, np.pi / 2]], rtol=1e-14)


INCREMENTS = "t_s,dx_m,dy_m,dtheta_rad,c_xx,c_xy,c_yy,c_xt,c_yt,c_tt\n"


def test_increments_come_with_their_covariances(tmp_path):
    text = INCREMENTS + "1,1,0.5,0.1,4,1,5,2,3,6\n3,2,0,0,1,0,1,0,0,1\n"
    stream = only(data_set(tmp_path, odometry=text))
    driven = stream.intervals
    assert driven.increments.tolist() == [[1, 0.5, 0.1], [2, 0, 0]]
    assert driven.covariances[0].tolist() == [[4, 1, 2], [1, 5, 3], [2, 3, 6]]
    assert driven.duration_ns.tolist() == [2 * 10**9, 2 * 10**9]
    assert stream.notes[0] == "the first increment is taken to last as long as the second"


def test_odd_but_legal_tables_are_read_as_the_plain_ones(tmp_path):
    plain = only(data_set(tmp_path / "plain", odometry=SPEEDS, observations=SEEN))
    odd = tmp_path / "odd" / "r1"
    odd.mkdir(parents=True)
    rows = [line.split(",") for line in SPEEDS.splitlines()]
    quoted = [",".join(f'"{cell}"' for cell in row) + ',""' for row in rows]
    (odd / "odometry.csv").write_bytes(b"\xef\xbb\xbf" + "\r\n".join([*quoted, ",,,"]).encode())
    spaced = "t_s , landmark, range_m,bearing_rad ,c_rr,x_m,\n"
    spaced += " 1,7.0 , 2.5,0.5, , ,\n1,3,1.5, -0.5 ,,,\n2,7.0,2.4,0.4,,,\n"
    (odd / "observations.csv").write_text(spaced)
    (odd / "start.csv").write_text("t_s,x_m,y_m,theta_rad\n0,1,2,3\n")
    found = only(tmp_path / "odd")
    assert found.start.pose.tolist() == [1, 2, 3]
    assert same(dataclasses.replace(found, start=None), plain)


CLAIM = "0.04,0,0.05,0,0.01,0.06"


def test_any_odometry_may_claim_its_covariance(tmp_path):
    columns = ",c_xx,c_xy,c_yy,c_xt,c_yt,c_tt"
    speeds = f"t_s,forward_m_s,yaw_rate_rad_s{columns}\n0,1,0.5,{CLAIM}\n2,0,0,0,0,0,0,0,0\n"
    held = only(data_set(tmp_path / "a", odometry=speeds)).intervals
    poses = f"t_s,x_m,y_m,theta_rad{columns}\n0,0,0,0,0,0,0,0,0,0\n2,{2 * np.sin(1)},"
    poses += f"{2 - 2 * np.cos(1)},1,{CLAIM}\n"
    between = only(data_set(tmp_path / "b", odometry=poses)).intervals
    for found in (held, between):
        assert found.increments is not None
        expected = [[2 * np.sin(1), 2 - 2 * np.cos(1), 1.0]]  # an arc of 2 m and 1 rad
        np.testing.assert_allclose(found.increments, expected, rtol=1e-14)
        assert found.covariances[0, [0, 1, 2], [0, 1, 2]].tolist() == [0.04, 0.05, 0.06]
    with pytest.raises(DatasetError, match="line 2, column c_xx: its covariance is not"):
        only(data_set(tmp_path / "c", odometry=speeds.replace("0.04", "0")))


def test_what_is_hardly_meant_is_noted(tmp_path):
    data_set(tmp_path, odometry=SPEEDS + "4,1,200\n5,0,0\n", observations=SEEN + "-9,7,1,0\n")
    place = tmp_path / "r2"
    place.mkdir()
    (place / "odometry.csv").write_text(SPEED_HEAD + "900000,1,0\n900001,0,0\n")
    (tmp_path / "r3").mkdir()
    (tmp_path / "r3" / "odom.csv").write_text(SPEEDS)
    (tmp_path / "r1" / "sighting.csv").write_text("t_s,teammate,range_m,bearing_rad\n1,r2,1,0\n")
    (tmp_path / "poles.csv").write_text("landmark,x_m,y_m\n1,2,3\n")
    degrees = SPEED_HEAD + "0,1,11\n1,1,11\n2,0,0\n"
    whirling = data_set(tmp_path / "w", odometry=degrees)
    with pytest.raises(DatasetError, match="to convert from degrees, add a column map"):
        only(whirling)
    world = read(tmp_path, "r1", "r2")
    said = "\n".join([*world.notes, *world.streams[0].notes])
    assert "poles.csv not read: tables are called odometry.csv, observations.csv, sight" in said
    assert "r1: sighting.csv not read" in said
    assert "1 odometry row beyond 300 m/s or 100 rad/s" in said
    assert "more than 2 s before its first odometry" in said
    assert "r3: neither odometry.csv nor observations.csv in it: left out" in said


def test_a_turn_in_degrees_of_a_robot_that_mostly_drives_straight_is_refused(tmp_path):
    """In 100 s it turns for 4 s at 0.5 rad/s. Wrong rows of a jittering clock are no turn."""

    def odometry(scale: float, *others: str) -> str:
        rows = [
            f"{k / 10},1,{0.5 * scale if 300 <= k < 340 else 0.001 * scale}" for k in range(1000)
        ]
        return "\n".join([SPEEDS.splitlines()[0], *rows, *others]) + "\n"

    with pytest.raises(DatasetError) as refused:
        only(data_set(tmp_path / "w", odometry=odometry(180 / np.pi)))
    words = "r1/odometry.csv, line 302, column yaw_rate_rad_s: it turns by 28.6 rad/s and more"
    assert words in str(refused.value)
    assert "to convert from degrees, add a column map" in str(refused.value)
    (tmp_path / "w" / "r1").rename(tmp_path / "w" / "bert")
    with pytest.raises(DatasetError, match="import SET/bert -o NEW --robot bert --columns"):
        read(tmp_path / "w", "bert")
    wrong = "100.001,1,90", "100.002,1,90", "100.003,0,0"
    assert (
        len(only(data_set(tmp_path / "r", odometry=odometry(1, *wrong))).intervals.end_ns) == 1002
    )


@pytest.mark.parametrize("offset", [0.0, np.pi])
def test_true_headings_in_degrees_are_refused_and_unwrapped_radians_are_not(tmp_path, offset):
    """Truth of a robot that drives around a circle three times, forward or backward."""

    def truth(scale: float) -> str:
        turns = np.linspace(0.0, 6.0 * np.pi, 300)
        rows = [f"{a / 10},{np.sin(a)},{-np.cos(a)},{scale * (a + offset)}" for a in turns.tolist()]
        return "\n".join(["t_s,x_m,y_m,theta_rad", *rows]) + "\n"

    assert only(data_set(tmp_path / "r", odometry=SPEEDS, truth=truth(1.0))).truth is not None
    words = "r1/truth.csv, line [0-9]+, column theta_rad: [0-9.]+: the headings follow the path's "
    with pytest.raises(DatasetError, match=words) as refused:
        only(data_set(tmp_path / "d", odometry=SPEEDS, truth=truth(180 / np.pi)))
    assert "to convert from degrees, add a column map" in str(refused.value)


def test_true_headings_of_a_robot_that_spins_along_a_straight_path_stay(tmp_path):
    rows = [f"{k / 10},{k / 20},0,{k / 10}" for k in range(300)]
    truth = "\n".join(["t_s,x_m,y_m,theta_rad", *rows]) + "\n"
    assert only(data_set(tmp_path, odometry=SPEEDS, truth=truth)).truth is not None


def test_what_is_dropped_is_counted_with_its_reason_and_line(tmp_path):
    seen = SEEN + "1,7,2.5,0.5\n2,9,0,0.1\n2,9,-1,0.1\n0.5,9,1,0.1\n9,9,1,0.1\n"
    stream = only(data_set(tmp_path, odometry=SPEEDS + "3,1,1\n", observations=seen))
    assert stream.notes == (
        "1 odometry row dropped: another row has the same time (r1/odometry.csv, at line 5)",
        "2 measurements earlier than the row before: sorted by time "
        "(r1/observations.csv, first at line 5)",
        "2 measurements dropped: range not above 0 (r1/observations.csv, first at line 6)",
        "1 measurement dropped: a second one of the same landmark at the same time "
        "(r1/observations.csv, at line 5)",
        "1 measurement dropped: after its last odometry, where its motion is not known "
        "(r1/observations.csv, at line 9)",
        "no truth.csv: its trajectory's error can not be computed",
    )
    assert stream.landmark_detections.ids.tolist() == [9, 7, 3, 7]


@pytest.mark.parametrize(
    ("table", "text", "words"),
    [
        ("odometry", "", "r1/odometry.csv: empty; its first line names the columns"),
        ("odometry", "t_s,speed\n0,1\n", "line 1: unknown column 'speed'; known: t_s"),
        ("odometry", SEEN, "line 1: its columns are those of observations.csv (t_s, landmark,"),
        ("odometry", SPEED_HEAD + "0,1,0\n100,1,0\n200,1,0\n", "column t_s: most rows"),
        ("odometry", "t_s,t_s\n", "line 1: two columns are called 't_s'"),
        ("odometry", "t_s,x_m\n0,1\n", "line 1: no odometry in its columns (x_m alone)"),
        ("odometry", SPEEDS + "4,1\n", "line 5: 2 columns, 3 expected (t_s, forward_m_s"),
        ("odometry", SPEEDS + "4,1,x\n", "line 5, column yaw_rate_rad_s: 'x' is not a number"),
        ("odometry", SPEEDS + "4,nan,0\n", "line 5, column forward_m_s: 'nan' is not finite"),
        ("odometry", SPEEDS + "later,1,0\n", "line 5, column t_s: 'later' is not a time"),
        ("observations", "t_s,range_m\n1,1\n", "line 1: no column landmark; known: t_s"),
        ("observations", "t_s,landmark\n1,1\n", "line 1: no measurement in its columns"),
        ("observations", SEEN + "3,tag7,1,0\n", "line 5, column landmark: 'tag7' is not a whole"),
        ("odometry", INCREMENTS + "1,1,0,0,1,2,1,0,0,1\n", "line 2, column c_xx: its covariance"),
        ("odometry", "t_s,x_m,y_m,theta_rad,c_xx\n0,0,0,0,1\n", "c_xt, c_yt, c_tt missing; give 0"),
        ("observations", SEEN + "3,7,1,170\n", "line 5, column bearing_rad: 170 is more"),
        (
            "observations",
            SEEN.replace("_rad", "_rad,x_m,y_m").replace("5\n", "5,1,1\n"),
            "line 4: 4",
        ),
        ("observations", SEEN_HEAD + "99,7,1,0\n", "are not those of the odometry"),
        ("odometry", "0,1,0\n1,1,0\n", "line 1: '0' is a number, and the first line names the"),
        ("odometry", SPEEDS + "17e18,1,0\n", "to convert from nanoseconds, add a column map"),
        ("start", "x_m,y_m,theta_rad\n0,0,0\n1,1,1\n", "2 rows: one pose is where"),
        ("start", "x_m,y_m,theta_rad\n0,0,90\n", "90 is more than a whole turn; it must be in rad"),
        (
            "observations",
            "t_s,landmark,x_m,y_m,c_xx,c_xy,c_yy\n1,1,1,1,1,0,1\n2,1,1,1,1,,\n",
            "line 3, column c_xy: no number here",
        ),
        ("observations", SEEN + '3,7,"2,5",0\n', "'2,5' is not a number; use a decimal point"),
        ("observations", SEEN + "3,door,1,0\n", "give each landmark a number"),
        ("observations", SEEN + "2024-05-01T12:00:00Z,7,1,0\n", "times are in seconds, since 1970"),
        ("landmarks", "landmark,x_m,y_m\n4,0,0\n4,1,1\n", "landmarks.csv, line 3, column landmark"),
        ("fixes", "t_s,x_m\n1,1\n", "r1/fixes.csv, line 1: no column y_m"),
        ("fixes", "t_s,x_m,y_m\n1,1,x\n", "line 2, column y_m: 'x' is not a number"),
        ("fixes", "t_s,x_m,y_m\n99,1,1\n", "line 2, column t_s: its times, 99.000 to 99.000 s"),
        ("fixes", "t_s,x_m,y_m,c_xx\n1,1,1,1\n", "line 1: a covariance has all of c_xx,c_xy,c_yy:"),
        ("fixes", FIXES + "2,1,1,1,,\n", "line 4, column c_xy: no number here"),
        ("fixes", FIXES + "2,1,1,1,2,1\n", "line 4, column c_xx: its covariance is not positive"),
    ],
)
def test_damage_names_file_line_column_and_remedy(tmp_path, table, text, words):
    tables = {"odometry": SPEEDS, **({} if table == "odometry" else {"observations": SEEN})}
    with pytest.raises(DatasetError) as error:
        only(data_set(tmp_path, **(tables | {table: text})))
    assert words in str(error.value)


def rows_in(unit: int, header: str, row: str, seconds: int) -> str:
    return header + "".join(f"{t * unit},{row}\n" for t in range(seconds))


@pytest.mark.parametrize(
    ("table", "header", "row"),
    [
        ("observations", SEEN_HEAD, "7,2.5,0.5"),
        ("detections", "t_s,range_m,bearing_rad\n", "2.5,0.5"),
        ("fixes", "t_s,x_m,y_m\n", "1,2"),
        ("truth", "t_s,x_m,y_m,theta_rad\n", "1,2,0"),
    ],
)
def test_a_table_in_milliseconds_is_refused_with_both_spans_and_its_unit(
    tmp_path, table, header, row
):
    odometry = rows_in(1, SPEED_HEAD, "1,0", 60)
    milli, whole = (rows_in(unit, header, row, 60) for unit in (1000, 1))
    only(data_set(tmp_path / "s", odometry=odometry, **{table: whole}))
    with pytest.raises(DatasetError) as refused:
        only(data_set(tmp_path / "ms", odometry=odometry, **{table: milli}))
    said = str(refused.value)
    assert said.startswith(f"r1/{table}.csv, ")
    assert "0.000 to 59000.000 s, are not those of the odometry, 0.000 to 59.000 s, 59 of" in said
    assert "1,000 times as long, as times in milliseconds are; to convert from millisec" in said


def test_a_robot_in_milliseconds_is_refused_and_one_that_drives_longer_or_slower_is_not(tmp_path):
    def team(*odometry: str) -> WorldStreams:
        for k, text in enumerate(odometry, 1):
            (tmp_path / f"r{k}").mkdir(exist_ok=True)
            (tmp_path / f"r{k}" / "odometry.csv").write_text(text)
        return read(tmp_path, *(f"r{k}" for k in range(1, len(odometry) + 1)))

    def odometry(count: int, step_ms: int, unit_ms: int = 1000) -> str:
        return SPEED_HEAD + "".join(f"{k * step_ms / unit_ms},1,0\n" for k in range(count))

    usual, milli = odometry(200, 50), odometry(180, 50, 1)
    with pytest.raises(DatasetError) as refused:
        team(usual, usual, milli)
    said = str(refused.value)
    assert "r3 spans 8,950 s, the others 10 s, with as many rows" in said
    assert (
        "are its stamps in milliseconds? Then to convert from milliseconds, add a column map"
        in said
    )
    with pytest.raises(DatasetError, match="r2, r3 span 8,950 s, the others 10 s"):
        team(usual, milli, milli)
    long, slow = odometry(200_000, 50), odometry(2, 50_000)
    assert len(team(usual, usual, long).streams) == 3
    assert len(team(usual, usual, slow).streams) == 3


def test_detections_that_outlast_the_odometry_are_dropped_unless_they_are_nearly_all(tmp_path):
    def read_until(seconds: int, **tables: str) -> RobotStream:
        seen = rows_in(1, SEEN_HEAD, "7,2.5,0.5", seconds)
        odometry = rows_in(1, SPEED_HEAD, "1,0", 10)
        return only(data_set(tmp_path, odometry=odometry, observations=seen, **tables))

    assert len(read_until(90).landmark_detections.ids) == 10
    with pytest.raises(DatasetError, match="191 of 201 rows outside; all tables of a team have"):
        read_until(201)
    truth = rows_in(1, "t_s,x_m,y_m,theta_rad\n", "1,2,0", 201)
    assert len(read_until(90, truth=truth).truth) == 201


def test_fixes_are_read_within_the_odometry_and_keep_their_bits(tmp_path):
    text = FIXES + "-1,9,9,,,\n3,5,6,,,\n7,9,9,,,\n"
    stream = only(data_set(tmp_path / "a", odometry=SPEEDS, fixes=text))
    assert stream.fixes_ns.tolist() == [1 * 10**9, 2 * 10**9, 3 * 10**9]
    assert stream.fixes[:, :2].tolist() == [[1.5, -2.0], [0.1, 7.0], [5.0, 6.0]]
    numbers = np.flatnonzero(stream.kinds == FIXES_KIND).tolist()
    stated = [Source(stream).message(number).covariance for number in numbers]
    assert floats(stated[0], "").tolist() == [4.0, 0.5, 3.0]
    assert stated[1:] == [b"", b""]
    assert [note for note in stream.notes if "fixes.csv" in note and "position" in note] == [
        "1 position earlier than the row before: sorted by time (r1/fixes.csv, at line 4)",
        "1 position dropped: before its first odometry (r1/fixes.csv, at line 4)",
        "1 position dropped: after its last odometry, where its motion is not known "
        "(r1/fixes.csv, at line 6)",
    ]
    write_folder(WorldStreams((stream,), np.empty(0, np.uint32), None, "test"), tmp_path / "b")
    assert same(only(tmp_path / "b"), stream)


def two_robots(path: Path) -> Scenario:
    for name in ("alice", "bob"):
        (path / name).mkdir(parents=True)
        (path / name / "odometry.csv").write_text(SPEEDS)
    return with_options(load("recorded"), dataset=path)


def test_the_robots_are_the_folders_whatever_the_scenario_calls_its_own(tmp_path):
    scenario = two_robots(tmp_path)
    assert scenario.name == scenario.team == tmp_path.name
    assert [robot.id for robot in scenario.robots] == ["alice", "bob"]
    assert scenario.robots[0].motion == load("recorded").robots[0].motion
    assert len(with_options(scenario, robots=1).robots) == 1
    with pytest.raises(ScenarioError, match=f"--robots 3: {tmp_path.name} has 2: alice, bob; give"):
        with_options(scenario, robots=3)
    own = tmp_path / "scenario.toml"
    own.write_text('base = "recorded"\n[world]\npath = "."\n[[robots]]\nid = "bob"\n')
    assert scenario_beside(tmp_path) == str(own)
    assert [robot.id for robot in with_options(load(own), dataset=tmp_path).robots] == ["bob"]
    both = with_options(load(own), dataset=tmp_path, robots=2)
    assert [robot.id for robot in both.robots] == ["bob", "alice"]


def test_a_robot_without_a_folder_is_left_out_and_named(tmp_path):
    scenario = two_robots(tmp_path)
    (tmp_path / "bob" / "odometry.csv").unlink()
    kept, said = with_present_robots(scenario)
    assert [robot.id for robot in kept.robots] == ["alice"]
    assert said.startswith("bob: no files in")


def test_robots_left_out_are_noted_on_both_sides(tmp_path):
    two_robots(tmp_path)
    own = tmp_path / "scenario.toml"
    ids = "".join(f'[[robots]]\nid = "{name}"\n' for name in ("alice", "carol"))
    own.write_text(f'base = "recorded"\n[world]\npath = "."\n{ids}')
    streams, _, missing = open_data_set(tmp_path)
    assert missing == f"carol: no files in {tmp_path.name}; the team is alice"
    assert "bob: not in the scenario's team: left out" in streams.notes
    (end,) = DataSetRun(tmp_path).samples([END])
    notes = decoded(end.payload, m.End).notes
    assert notes[: 1 + len(streams.notes)] == (missing, *streams.notes)


def test_a_table_of_another_name_is_named_where_it_may_be_missing(tmp_path):
    path = data_set(tmp_path, odometry=SPEEDS, observation=SEEN)
    (path / "r1" / "FIXES.CSV").write_text(FIXES)
    said = "if FIXES.CSV or observation.csv has them, rename it to observations.csv"
    assert f"no observations: only its odometry is given; {said}" in only(path).notes
    data_set(path, observations=SEEN, odom=SPEEDS)
    (path / "r1" / "odometry.csv").unlink()
    with pytest.raises(DatasetError, match=r"or odom\.csv has them, rename it to odometry"):
        only(path)


def test_launch_says_which_models_it_takes_and_what_is_wrong(tmp_path):
    data_set(tmp_path, odometry=SPEEDS, observations=SEEN + "x,1,1,1\n")
    result = run("launch", "--dataset", tmp_path)
    assert "no scenario given" in result.output
    assert "It assumes odometry that is off by" in result.output
    assert isinstance(result.exception, DatasetError)
    assert "line 5, column t_s: 'x' is not a time" in str(result.exception)


def test_a_folder_around_the_data_set_is_named(tmp_path):
    data_set(tmp_path / "inner", odometry=SPEEDS, observations=SEEN)
    with pytest.raises(DatasetError, match=r"the data set is in its folder .*inner: give that"):
        kind_of(tmp_path)
    (tmp_path / "none").mkdir()
    with pytest.raises(DatasetError, match="none: no data set in it; expected a folder with a sub"):
        kind_of(tmp_path / "none")


@pytest.mark.parametrize("content", [None, b"x,y\n1,2\n", b"PK\3\4 and no more"])
def test_a_file_that_is_no_data_set_is_refused_with_all_formats(tmp_path, content):
    path = tmp_path / "set.zip"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError) as refused:
        kind_of(path)
    expected = ("odometry.csv", "detections.csv", "ROS 2 bag", "g2o", "UTIAS", "docs/your_data.md")
    assert [each for each in expected if each not in str(refused.value)] == []


@pytest.mark.parametrize("table", [None, "t_s,forward_m_s,yaw_rate_rad_s\n1,0,0\n"])
def test_a_robot_without_odometry_is_refused_with_file_and_remedy(tmp_path, table):
    of_it = {} if table is None else {"odometry": table}
    path = data_set(tmp_path / "a", observations=SEEN, **of_it)
    for command in (
        ("launch", "--dataset", path),
        ("rerun", path),
        ("import", path, "-o", tmp_path / "b"),
    ):
        refused = run(*command).exception
        assert isinstance(refused, DatasetError)  # status 2 of the program
        said = str(refused)
        assert "r1/odometry.csv: no odometry interval of r1" in said
        assert "stands still, rows of speed 0" in said
        assert "remove the folder r1" in said
    assert not (tmp_path / "b").exists()
    standing = "t_s,forward_m_s,yaw_rate_rad_s\n0,0,0\n3,0,0\n"
    assert len(only(data_set(path, odometry=standing)).intervals.end_ns) == 1


def test_import_of_a_folder_without_measurements_makes_none(tmp_path):
    data_set(tmp_path / "a", landmarks="landmark,x_m,y_m\n1,2,3\n")
    done = run("import", tmp_path / "a", "-o", tmp_path / "b")
    assert isinstance(done.exception, DatasetError)
    assert "neither odometry nor observations" in str(done.exception)
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize("wrong", [(12, "0,0,0"), (12, "90,3,1"), (1, "0,-60,0")])
def test_odometry_that_is_reset_or_has_a_wrong_row_goes_on_as_before(tmp_path, wrong):
    """Ten poses a second, half a metre a second ahead; from one on they begin at another pose."""
    first, pose = wrong
    rows = ["t_s,x_m,y_m,theta_rad"]
    x, y, theta = (float(part) for part in pose.split(","))
    for k in range(30):
        if k < first or pose != "0,0,0":
            rows.append(f"{k / 10:.1f},{k / 20:.6f},0,0")
        else:
            rows.append(f"{k / 10:.1f},{(k - first) / 20:.6f},0,0")
    if pose != "0,0,0":
        rows[first + 1] = f"{first / 10:.1f},{x},{y},{theta}"
    stream = only(data_set(tmp_path, odometry="\n".join(rows) + "\n"))
    assert stream.intervals.increments is not None
    expected = np.tile([0.05, 0.0, 0.0], (29, 1))
    if first == 1:
        expected[:2] = 0.0  # its earlier motion is unknown
    np.testing.assert_allclose(stream.intervals.increments, expected, atol=1e-9)
    assert "at which its pose jumps, by" in " ".join(stream.notes)


def test_landmarks_whose_names_end_in_numbers_have_these(tmp_path):
    named = SEEN_HEAD + "1,tag36h11:5,2,0\n1,tag36h11:12,3,0.5\n2,,,\n"
    stream = only(data_set(tmp_path / "a", odometry=SPEEDS, observations=named))
    assert sorted(stream.landmark_detections.ids.tolist()) == [5, 12]
    for row, words in (
        ("1,tag25h9:5,2,0\n", "line 5, column landmark: 'tag25h9:5' and 'tag36h11:5' begin"),
        ("1,door,2,0\n", "'tag36h11:5' is not a whole number, nor are all rows texts that end"),
    ):
        with pytest.raises(DatasetError, match=words):
            only(data_set(tmp_path / row[2:6], odometry=SPEEDS, observations=named + row))


@pytest.mark.parametrize(
    "odometry",
    [
        "t_s;forward_m_s;yaw_rate_rad_s\n0;1;0,1\n1;2;0,2\n3;0;0\n",
        "t_s\tforward_m_s\tyaw_rate_rad_s\n0\t1\t0.1\n1\t2\t0.2\n3\t0\t0\n",
        '"yaw_rate_rad_s", "T_S", "Forward_m_s"\r\n"0.1", "0", "1"\r\n0.2,1,2\r\n0,3,0\r\n',
        ",t_s,forward_m_s,yaw_rate_rad_s\n0,0,1,0.1\n1,1,2,0.2\n2,3,0,0\n",
    ],
    ids=["decimal commas", "tabs", "quotes, order and capitals", "an index"],
)
def test_tables_as_other_programs_write_them_are_the_same(tmp_path, odometry):
    plain = only(data_set(tmp_path / "a", odometry=SPEEDS, observations=SEEN))
    other = only(data_set(tmp_path / "b", odometry=odometry, observations=SEEN))
    assert same(plain, other)
