from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from teamslam.sim.cli.importing import readable
from teamslam.sim.datasets.csv_table import CsvTable
from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.importing.proposal import propose_map
from teamslam.sim.publisher.source import Source
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import scenario_beside, streams_of
from teamslam.sim.world.streams import WorldStreams
from tests import commands, teams
from tests.ros2 import messages as ros
from tests.sim.datasets.test_folder import same

S = 10**9
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
ODOMETRY, TAGS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"


def run(*arguments: object) -> Result:
    return commands.run("import", *arguments)


def read(path: Path) -> WorldStreams:
    return streams_of(with_options(load(scenario_beside(path)), dataset=path))


def imported(*arguments: object) -> tuple[WorldStreams, str]:
    """The data set that `-o` names, and the words of the command."""
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return read(Path(str(arguments[arguments.index("-o") + 1]))), result.output


def refusal(*arguments: object) -> str:
    error = run(*arguments).exception
    assert isinstance(error, DatasetError)  # exit status 2
    return str(error)


def drive(robot: str = "") -> list[ros.Message]:
    at = f"/{robot}" if robot else ""
    poses = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.1), (2.0, 0.25, 0.2)]
    drove: list[ros.Message] = [
        (k * S, f"{at}/odom", ODOMETRY, ros.odometry(k * S, ros.pose(x, y, yaw=t), 1.0, 0.1))
        for k, (x, y, t) in enumerate(poses)
    ]
    seen = [("7", ros.pose(3.0, 4.0)), ("5", ros.pose(1.0, 1.0))]
    drove += [(k * S, f"{at}/tags", TAGS, ros.detections(k * S, "base_link", seen)) for k in (1, 2)]
    true = ros.odometry(S, ros.pose(1.0, 0.0, yaw=0.1))
    return [*drove, (S, f"{at}/ground_truth", ODOMETRY, true)]


@pytest.mark.parametrize("db3", [False, True])
def test_a_bag_becomes_tables(tmp_path, db3):
    bag = ros.write_bag(tmp_path / "bag", drive(), db3=db3)
    world, said = imported(bag, "-o", tmp_path / "set", "--start", "1,2,0.5")
    assert "6 messages" in said
    (stream,) = world.streams
    assert stream.robot == "r1"
    assert stream.start.pose.tolist() == [1.0, 2.0, 0.5]
    assert stream.intervals.end_ns.tolist() == [S, 2 * S]
    seen = stream.landmark_detections
    assert seen.ids.tolist() in ([5, 7, 5, 7], [7, 5, 7, 5])
    assert sorted(seen.ranges.tolist()) == pytest.approx([2**0.5, 2**0.5, 5, 5])
    assert stream.truth is not None
    np.testing.assert_allclose(stream.truth, [[1.0, 0.0, 0.1]], atol=1e-15)


def test_robots_are_the_namespaces_and_see_each_other_by_their_tags(tmp_path):
    bag = ros.write_bag(tmp_path / "bag", [*drive("ann"), *drive("bob")])
    topics = tmp_path / "topics.toml"
    topics.write_text(
        '[robots.ann]\nodometry = "/ann/odom"\nuse = "twist"\ndetections = ["/ann/tags"]\n'
        'teammates = { 5 = "bob" }\n'
        '[robots.bob]\nodometry = "/bob/odom"\ndetections = ["/bob/tags"]\n'
    )
    ann, bob = imported(bag, "-o", tmp_path / "set", "--ros2", topics)[0].streams
    assert (ann.robot, bob.robot) == ("ann", "bob")
    assert ann.intervals.forward.tolist() == [1.0, 1.0]
    met = [Source(ann).message(k) for k in np.flatnonzero(ann.kinds == 2).tolist()]
    assert [each.teammates for each in met] == [("bob",)] * 2
    own, _ = imported(bag, "-o", tmp_path / "own")
    assert [each.robot for each in own.streams] == ["ann", "bob"]


def test_tags_on_tf_are_seen_from_where_the_camera_sits(tmp_path):
    camera = (0, "base_link", "cam_optical", ros.vector(0.3, 0.1, 0.5), OPTICAL)
    tag = (S, "cam_optical", "tag36h11:7", ros.vector(-1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))
    still = [m for m in drive() if m[1] == "/odom"]
    messages = [
        (0, "/tf_static", "tf2_msgs/msg/TFMessage", ros.transforms(camera)),
        *still,
        (S, "/tf", "tf2_msgs/msg/TFMessage", ros.transforms(tag)),
    ]
    imported(ros.write_bag(tmp_path / "bag", messages), "-o", tmp_path / "set")
    text = (tmp_path / "set" / "r1" / "observations.csv").read_text().splitlines()
    assert text[0] == "t_s,landmark,x_m,y_m"
    np.testing.assert_allclose([float(cell) for cell in text[1].split(",")], [1, 7, 2, 1])
    scenario = load(scenario_beside(tmp_path / "set"))
    np.testing.assert_allclose(scenario.robots[0].sensor.mount, [0.3, 0.1, 0.0], atol=1e-12)


def test_of_a_bag_whose_recorder_was_killed_all_that_is_whole_is_taken(tmp_path):
    bag = ros.write_bag(tmp_path / "bag", drive())
    (bag / "metadata.yaml").unlink()
    first, _ = imported(bag, "-o", tmp_path / "without_metadata")
    (file,) = bag.glob("*.mcap")
    whole = file.read_bytes()
    file.write_bytes(whole[: whole.rindex(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00") - 3])
    assert f"teamslam repair {file} -o WHOLE.mcap" in refusal(bag, "-o", tmp_path / "set")
    commands.output_of("repair", file, "-o", tmp_path / "whole.mcap")
    assert same(imported(tmp_path / "whole.mcap", "-o", tmp_path / "set")[0], first)
    file.write_bytes(whole[:20])
    none = commands.run("repair", file, "-o", tmp_path / "none.mcap")
    assert "no whole message in it" in str(none.exception)
    assert not (tmp_path / "none.mcap").exists()


def test_a_bag_that_does_not_say_what_is_what_is_listed_with_what_to_type(tmp_path):
    other = [(at, "/wheels", kind, m) for at, topic, kind, m in drive() if topic == "/odom"]
    bag = ros.write_bag(tmp_path / "bag", [*drive(), *other])
    for arguments in ((bag,), (bag, "-o", tmp_path / "set")):
        result = run(*arguments)
        assert isinstance(result.exception, DatasetError) == ("-o" in arguments)
        said = result.output + str(result.exception)
        assert "the topics are ambiguous" in said
        assert "/tags   vision_msgs/msg/Detection3DArray   2 messages" in said
        assert "[robots.r1]" in said
        assert f"teamslam import {bag} -o FOLDER --ros2 topics.toml" in said
    assert "2 topics may be its odometry" in said


def test_launch_takes_a_bag_and_says_what_is_wrong_with_it(tmp_path):
    (tmp_path / "bag.mcap").write_bytes(b"not a bag")
    result = commands.run("launch", "--dataset", tmp_path / "bag.mcap", "-o", tmp_path / "run")
    assert isinstance(result.exception, DatasetError)
    assert "no ROS 2 bag, or a damaged one" in str(result.exception)


WHEELS = "stamp_ns,speed,yaw_rate_deg_s,note\n0,1,90,a\n1000000001,2,0,b\n2000000000,0,0,c\n"
TREES = "stamp_ns,dist_cm,angle\n1000000001,250,1.0\n1500000000,100,2.0\n"
LABELS = "tree\n7\n-1\n"
MAP = """
[odometry]
files = ["wheels.csv"]
[odometry.columns]
t_s = { column = "stamp_ns", scale = 1e-9 }
forward_m_s = "speed"
yaw_rate_rad_s = { column = "yaw_rate_deg_s", scale = 0.017453292519943295 }
[observations]
files = ["trees.csv", "labels.csv"]
drop = { tree = ["-1"] }
[observations.columns]
t_s = { column = "stamp_ns", scale = 1e-9 }
landmark = "tree"
range_m = { column = "dist_cm", scale = 0.01 }
bearing_rad = { column = "angle", offset = -1.5 }
"""


def files(path: Path) -> list[Path]:
    texts = {"wheels.csv": WHEELS, "trees.csv": TREES, "labels.csv": LABELS}
    for name, text in texts.items():
        (path / name).write_text(text)
    return [path / name for name in texts]


def test_csv_files_with_other_names_come_by_a_map(tmp_path):
    (tmp_path / "columns.toml").write_text(MAP)
    columns = ("--columns", tmp_path / "columns.toml", "--robot", "ann")
    world, said = imported(*files(tmp_path), "-o", tmp_path / "set", *columns)
    assert "1 rows dropped: tree is -1" in said
    assert "trees.csv, first at line 3" in said
    (stream,) = world.streams
    assert stream.robot == "ann"
    assert stream.intervals.end_ns.tolist() == [1000000001, 2 * S]
    assert stream.intervals.yaw_rate.tolist() == pytest.approx([np.pi / 2, 0.0])
    seen = stream.landmark_detections
    assert (seen.ids.tolist(), seen.ranges.tolist(), seen.bearings.tolist()) == ([7], [2.5], [-0.5])


def test_files_of_a_second_robot_are_refused_with_the_remedy(tmp_path):
    text = MAP
    for name, of in {"wheels.csv": WHEELS, "trees.csv": TREES, "labels.csv": LABELS}.items():
        (tmp_path / f"ann_{name}").write_text(of)
        text = text.replace(f'"{name}"', f'"ann_{name}"')
    assert "ann_wheels.csv" in text
    (tmp_path / "columns.toml").write_text(text)
    (tmp_path / "bob_wheels.csv").write_text(WHEELS)
    given = [*sorted(tmp_path.glob("*.csv")), "-o", tmp_path / "set"]
    said = refusal(*given, "--columns", tmp_path / "columns.toml")
    assert said.startswith("bob_wheels.csv: odometry of a second robot, bob")
    assert "folder of its name" in said
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(("unit", "a_second"), [("ns", 10**9), ("us", 10**6), ("ms", 1000)])
def test_unix_times_of_any_unit_and_names_with_a_prefix_are_proposed_and_read_exactly(
    tmp_path, unit, a_second
):
    logs, first = tmp_path / "logs", 1763800000 * a_second
    (logs / "ann").mkdir(parents=True)
    (logs / "ann" / "mocap.csv").write_text("t_s,x_m,y_m,theta_rad\n1763800000,0,0,0\n")
    (logs / "ann" / "wheel_odom.csv").write_text(
        f"stamp_{unit},odom.x,odom.y,odom.yaw_deg\n{first},0,0,0\n{first + 7},1,0,90\n"
    )
    refused = refusal(logs, "-o", tmp_path / "set")
    columns = tmp_path / "columns.toml"
    columns.write_text(refused.partition("with this:\n\n")[2].partition("\nand type")[0])
    assert f"\nand type: teamslam import {logs} -o {tmp_path / 'set'} --columns" in refused
    world, _ = imported(logs, "-o", tmp_path / "set", "--columns", columns)
    (stream,) = world.streams
    assert stream.intervals.end_ns.tolist() == [1763800000 * S + 7 * S // a_second]
    assert stream.truth is not None
    columns.write_text(columns.read_text().replace("scale = 1e-", "scale = 1e+"))
    assert "is out of bounds" in refusal(logs, "-o", tmp_path / "x", "--columns", columns)


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("time,speed,gyro", ['forward_m_s = "speed"', 't_s = { column = "time", scale = 1e-3 }']),
        (
            "ts,groundSpeed (km/h),imu_gyro_z_dps",
            ['t_s = "ts"', '{ column = "groundSpeed (km/h)", scale = 0.2777777777777778 }',
             'yaw_rate_rad_s = { column = "imu_gyro_z_dps", scale = 0.017453292519943295 }'],
        ),
        (
            "seconds,fiducial_id,distance_mm,bearing_degrees",
            ['landmark = "fiducial_id"', '{ column = "distance_mm", scale = 1e-3 }', "0.01745"],
        ),
    ],
)  # fmt: skip
def test_names_as_labs_give_them_are_proposed(header, expected):
    names = header.split(",")
    columns = {name: ["1763800000123" if name == "time" else "2"] for name in names}
    text = propose_map({"r1": {"log.csv": CsvTable("log.csv", columns, [2])}})
    assert "#" not in text
    assert [each for each in expected if each not in text] == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"speed"', '"velocity"', "no column 'velocity', which the map has for forward_m_s"),
        ("forward_m_s", "speed", "odometry has no column speed; known: t_s"),
        ("[odometry", "[wheels", "no table wheels; known: odometry"),
        ('"wheels.csv"', '"w.csv"', "r1 has no odometry: expected w.csv; there are wheels.csv"),
        ("tree = [", "bush = [", "no column 'bush', which `drop` names"),
        ("[odometry]", "[odometry", "no map of columns"),
    ],
)
def test_a_mistake_in_a_map_is_named(tmp_path, old, new, words):
    (tmp_path / "columns.toml").write_text(MAP.replace(old, new))
    given = (*files(tmp_path), "-o", tmp_path / "set", "--columns", tmp_path / "columns.toml")
    assert words in refusal(*given)


def test_folders_of_csv_files_with_other_names_are_robots(tmp_path):
    logs = tmp_path / "logs"
    for name in ("ann", "bob"):
        (logs / name).mkdir(parents=True)
        files(logs / name)
    (logs / "bob" / "meets.csv").write_text("t_s,teammate,range_m,bearing_rad\n1,ann,2,0\n")
    (logs / "poles.csv").write_text("landmark,x_m,y_m\n7,1,2\n")
    assert "Which are what?" in refusal(logs, "-o", tmp_path / "set")
    further = '[sightings]\nfiles = ["meets.csv"]\n[sightings.columns]\n'
    further += "".join(f'{c} = "{c}"\n' for c in ("t_s", "teammate", "range_m", "bearing_rad"))
    further += '[landmarks]\nfiles = ["poles.csv"]\n[landmarks.columns]\n'
    further += "".join(f'{c} = "{c}"\n' for c in ("landmark", "x_m", "y_m"))
    columns = tmp_path / "columns.toml"
    columns.write_text(MAP + further)
    mapped = ("--columns", columns, "--start", "ann:1,2,3")
    world, said = imported(logs, "-o", tmp_path / "set", *mapped)
    assert "ann: no meets.csv: no sightings" in said
    ann, bob = world.streams
    assert [(each.robot, each.start is None) for each in (ann, bob)] == [("ann", 0), ("bob", 1)]
    assert world.landmark_ids.tolist() == [7]
    assert len(bob.teammate_detections.ids) == 1
    named = refusal(logs, "-o", tmp_path / "x", "--columns", columns, "--robot", "cat")
    assert "has a folder for each robot, ann, bob, which names it" in named
    columns.write_text((MAP + further).replace("offset = -1.5", "offset = 90"))
    assert "bearings must be in radians" in refusal(logs, "-o", tmp_path / "x", *mapped)
    assert not (tmp_path / "x").exists()  # the next attempt may have the folder
    columns.write_text(MAP + further)
    one_by_one = refusal(logs / "ann", logs / "bob", "-o", tmp_path / "a", "--columns", columns)
    assert "poles.csv" in one_by_one  # it lies in neither folder
    (logs / "ann").rename(logs / "Ann")
    assert "Ann: no robot's name" in refusal(logs, "-o", tmp_path / "x", *mapped)


def test_truth_comes_from_a_trajectory_of_tum(tmp_path):
    bag = ros.write_bag(tmp_path / "bag", [m for m in drive() if "truth" not in m[1]])
    tum = tmp_path / "truth.txt"
    tum.write_text("# t x y z qx qy qz qw\n0.5 1 2 0 0 0 0 1\n1.5 2 2 0 0 0 1 0\n")
    (stream,) = imported(bag, "-o", tmp_path / "set", "--truth", tum)[0].streams
    assert stream.truth.tolist() == [[1, 2, 0], [2, 2, np.pi]]
    tum.write_text("0.5 1 2 0 0 0 0 1\n1.5 2 2 0 0 0 x 0\n")
    said = refusal(bag, "-o", tmp_path / "bad", "--truth", tum)
    assert "truth.txt, line 2: expected t x y z qx qy qz qw" in said


def test_wrong_use_is_said(tmp_path):
    write_folder(teams.world_of(teams.stream("r1", 3)), tmp_path / "set")
    bag = ros.write_bag(tmp_path / "bag", drive())
    for arguments, words in (
        ((bag, "-o", tmp_path / "set"), "is not empty: give a new folder"),
        ((bag, "-o", tmp_path / "a", "--robot", "R1"), "--robot R1: a small letter"),
        ((bag, "-o", tmp_path / "a", "--start", "1,2"), "--start 1,2: give x,y,theta"),
        ((bag, "-o", tmp_path / "a", "--start", "1,2,90"), "theta is in radians, in one turn"),
        ((bag, "-o", tmp_path / "a", "--start", "r9:1,2,3"), "--start: which robot's?"),
        ((tmp_path / "none", "-o", tmp_path / "a"), "none: no such file or folder"),
        ((bag, "-o", tmp_path / "a", "--ros2", tmp_path), ": can not be read"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2 or isinstance(result.exception, DatasetError)
        assert words in result.output + str(result.exception)


@pytest.mark.parametrize("db3", [False, True])
def test_commands_on_data_sets_read_a_bag_as_what_it_is_imported_into(tmp_path, db3):
    bag = ros.write_bag(tmp_path / "bag", drive(), db3=db3)
    for path in (bag, next(bag.glob("*.db3" if db3 else "*.mcap"))):
        with readable(path) as folder:
            (stream,) = read(folder).streams
            assert stream.intervals.end_ns.tolist() == [S, 2 * S]
        assert not folder.exists()
    (tmp_path / "own.mcap").write_bytes(b"\x89MCAP0\r\n teamslam")
    for path in (tmp_path / "own.mcap", tmp_path, tmp_path / "none.mcap"):
        with readable(path) as same:
            assert same == path
