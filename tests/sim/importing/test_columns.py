"""Maps of columns: references are no odometry, detections need no identities."""

from pathlib import Path

import numpy as np
import pytest

from teamslam.sim.datasets.kinds import kind_of
from teamslam.sim.datasets.tables import DatasetError
from tests.sim.importing.test_import import read, run

TRACK = "t,x,y,yaw\n0,0,0,0\n1,1,0,0\n2,2,0,0\n"
SEEN = "t,range,bearing\n1,2,0.5\n1,3,-0.5\n2,2,0.25\n"
ODOMETRY = '[odometry]\nfiles = ["odom.csv"]\n[odometry.columns]\n' + (
    't_s = "t"\nx_m = "x"\ny_m = "y"\ntheta_rad = "yaw"\n'
)


def proposal(folder: Path, **files: str) -> str:
    folder.mkdir()
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text)
    return str(run(folder, "-o", folder.parent / "set").exception)


@pytest.mark.parametrize(
    "name",
    ["gt", "truth", "ref", "my_reference", "mocap", "optitrack_1", "vicon", "groundTruth", "r1-gt"],
)
@pytest.mark.parametrize("odometry", ["odom", "zz_encoders"])
def test_a_reference_is_proposed_as_the_truth_and_never_as_odometry(tmp_path, name, odometry):
    said = proposal(tmp_path / "a", **{name: TRACK, odometry: TRACK})
    assert f'[truth]\nfiles = ["{name}.csv"]' in said
    assert f'[odometry]\nfiles = ["{odometry}.csv"]' in said
    alone = proposal(tmp_path / "b", **{name: TRACK, "tags": "t,id,range,bearing\n1,7,2,0\n"})
    assert f'[truth]\nfiles = ["{name}.csv"]' in alone
    assert "[odometry]" not in alone


def test_odometry_is_the_wheels_own_where_there_is_a_choice(tmp_path):
    said = proposal(tmp_path / "a", a_path=TRACK, ekf_odom=TRACK, wheels=TRACK)
    assert '[odometry]\nfiles = ["wheels.csv"]' in said
    assert "# a_path.csv: might be odometry, too" in said
    assert "# ekf_odom.csv: might be odometry, too" in said


@pytest.mark.parametrize("form", ["polar", "points"])
def test_detections_without_identities_are_proposed_and_imported(tmp_path, form):
    r, b = np.array([2.0, 3.0, 2.0]), np.array([0.5, -0.5, 0.25])
    points = "t,x,y,c_xx,c_xy,c_yy\n" + "".join(
        f"{t},{x!r},{y!r},0.01,0.002,0.04\n"
        for t, x, y in zip(
            (1, 1, 2), (r * np.cos(b)).tolist(), (r * np.sin(b)).tolist(), strict=True
        )
    )
    logs = tmp_path / "logs"
    said = proposal(logs, odom=TRACK, cones=SEEN if form == "polar" else points)
    assert '[detections]\nfiles = ["cones.csv"]' in said
    (logs / "classes.csv").write_text("tree\n4\n-1\n4\n")
    columns = tmp_path / "columns.toml"
    columns.write_text(
        said[said.index("[odometry]") if said.index("[odometry]") < said.index("[detections]")
             else said.index("[detections]") : said.index("\nand type")]
        + '\n[labels]\nfiles = ["classes.csv"]\n[labels.columns]\nlandmark = "tree"\n'
    )  # fmt: skip
    result = run(logs, "-o", tmp_path / "set", "--columns", columns)
    assert result.exit_code == 0, result.output
    (stream,) = read(tmp_path / "set").streams
    seen = stream.landmark_detections
    assert seen.hidden.all()
    np.testing.assert_allclose(seen.ranges, r, atol=1e-15)
    np.testing.assert_allclose(seen.bearings, b, atol=1e-15)
    assert (seen.ids[[0, 2]] == 4).all()
    if form == "points":
        assert seen.covariances is not None
        for packed, at, bearing in zip(seen.covariances, r, b, strict=True):
            c, s = np.cos(bearing), np.sin(bearing)
            jacobian = np.array([[c, s], [-s / at, c / at]])
            moved = jacobian @ np.array([[0.01, 0.002], [0.002, 0.04]]) @ jacobian.T
            np.testing.assert_allclose(packed, moved[np.triu_indices(2)], rtol=1e-12)


def test_the_truth_of_several_robots_has_its_remedy_named(tmp_path):
    for name in ("ann", "bob"):
        (tmp_path / "logs" / name).mkdir(parents=True)
        (tmp_path / "logs" / name / "odom.csv").write_text(TRACK)
    (tmp_path / "columns.toml").write_text(ODOMETRY)
    truth = tmp_path / "gt.csv"
    truth.write_text(TRACK)
    arguments = ("--columns", tmp_path / "columns.toml", "--truth", truth)
    result = run(tmp_path / "logs", "-o", tmp_path / "set", *arguments)
    assert isinstance(result.exception, DatasetError)
    assert "name the file as [truth] in the map of columns" in str(result.exception)


SPEEDS = "stamp_ms,speed,gyro_dps\n0,1,90\n1000,2,0\n2000,0,0\n"
MARKERS = "stamp_ms,marker,forward_mm,left_mm\n1000,7,2000,0\n"
TAGS = "t,id,range,bearing_deg\n1,7,2,90\n"


def team_files(folder: Path, layout: str) -> Path:
    """Files of ann and bob, whose columns differ: by prefix, by suffix, or in folders."""
    for robot, files in {
        "ann": {"odom": TRACK, "tags": TAGS},
        "bob": {"wheels": SPEEDS, "markers": MARKERS},
    }.items():
        for name, text in files.items():
            path = folder / layout.format(robot=robot, name=name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    return folder


def check_team(folder: Path) -> None:
    ann, bob = read(folder).streams
    assert (ann.robot, bob.robot) == ("ann", "bob")
    assert bob.intervals.yaw_rate.tolist() == pytest.approx([np.pi / 2, 0.0])
    assert ann.landmark_detections.bearings.tolist() == pytest.approx([np.pi / 2])
    assert bob.landmark_detections.points == pytest.approx(np.array([[2.0, 0.0]]))


@pytest.mark.parametrize(
    "layout", ["{robot}_{name}.csv", "{name}-{robot}.csv", "{robot}/{name}.csv"]
)
def test_robots_with_other_columns_have_tables_of_their_own_in_one_map(tmp_path, layout):
    logs, columns = team_files(tmp_path / "logs", layout), tmp_path / "columns.toml"
    command = (logs, "-o", tmp_path / "set", "--columns", columns)
    first = run(*command)
    assert isinstance(first.exception, DatasetError)
    assert "no such file, so a proposal is written to it" in str(first.exception)
    assert "[robots.bob.odometry]" in columns.read_text()
    result = run(*command)
    assert result.exit_code == 0, result.output
    check_team(tmp_path / "set")
    unknown = columns.read_text().replace("[robots.bob", "[robots.eve")
    columns.write_text(unknown)
    refused = run(logs, "-o", tmp_path / "eve", "--columns", columns)
    if "/" in layout:
        assert "[robots.eve]: no files of such a robot" in str(refused.exception)
    columns.write_text(unknown.replace("[robots.eve", "[robots.Bob"))
    refused = run(logs, "-o", tmp_path / "bob", "--columns", columns)
    assert "[robots.Bob]: no robot's name" in str(refused.exception)


def test_a_robot_is_added_to_a_data_set(tmp_path):
    logs = team_files(tmp_path / "logs", "{robot}/{name}.csv")
    for robot in ("ann", "bob"):
        columns = tmp_path / f"{robot}.toml"
        run(logs / robot, "-o", tmp_path / "new", "--robot", robot, "--columns", columns)
        arguments = (logs / robot, "-o", tmp_path / "set", "--robot", robot, "--columns", columns)
        result = run(*arguments)
        assert result.exit_code == 0, result.output
        assert "add a robot" in run(*arguments).output
        if robot == "ann":
            scenario = tmp_path / "set" / "scenario.toml"
            scenario.write_text('base = "recorded"\n[world]\npath = "."\n[[robots]]\nid = "ann"\n')
    check_team(tmp_path / "set")
    assert "scenario.toml: bob is added to its robots" in result.output
    columns.write_text(columns.read_text().replace("wheels.csv", "none.csv"))
    failed = run(logs / "bob", "-o", tmp_path / "set", "--robot", "cat", "--columns", columns)
    assert isinstance(failed.exception, DatasetError)
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        "ann.toml", "bob.toml", "logs", "set",
    ]  # fmt: skip
    check_team(tmp_path / "set")


@pytest.mark.parametrize("place", ["", "ann"])
def test_tables_with_names_of_their_own_are_told_to_be_imported(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "wheels.csv").write_text(TRACK)
    with pytest.raises(
        DatasetError, match=r"names of their own .*: `teamslam import .* --columns columns.toml`"
    ):
        kind_of(tmp_path)
