import re
from pathlib import Path

import numpy as np
import pytest

from teamslam.sim.datasets.csv_table import CsvTable
from teamslam.sim.datasets.kinds import kind_of
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.importing.proposal import drops_by_robot, propose_map
from tests.sim.importing.test_import import imported, read, refusal, run

TRACK = "t,x,y,yaw\n0,0,0,0\n1,1,0,0\n2,2,0,0\n"
SEEN = "t,range,bearing\n1,2,0.5\n1,3,-0.5\n2,2,0.25\n"
ODOMETRY = '[odometry]\nfiles = ["odom.csv"]\n[odometry.columns]\n' + (
    't_s = "t"\nx_m = "x"\ny_m = "y"\ntheta_rad = "yaw"\n'
)


def proposal(folder: Path, **files: str) -> str:
    return refusal(team_of(folder, **files), "-o", folder.parent / "set")


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
    at = zip((1, 1, 2), (r * np.cos(b)).tolist(), (r * np.sin(b)).tolist(), strict=True)
    rows = [f"{t},{x!r},{y!r},0.01,0.002,0.04\n" for t, x, y in at]
    points = "".join(["t,x,y,c_xx,c_xy,c_yy\n", *rows])
    logs = tmp_path / "logs"
    said = proposal(logs, odom=TRACK, cones=SEEN if form == "polar" else points)
    assert '[detections]\nfiles = ["cones.csv"]' in said
    (logs / "classes.csv").write_text("tree\n4\n-1\n4\n")
    columns = tmp_path / "columns.toml"
    begin = min(said.index("[odometry]"), said.index("[detections]"))
    labels = '\n[labels]\nfiles = ["classes.csv"]\n[labels.columns]\nlandmark = "tree"\n'
    columns.write_text(said[begin : said.index("\nand type")] + labels)
    (stream,) = imported(logs, "-o", tmp_path / "set", "--columns", columns)[0].streams
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
    said = refusal(tmp_path / "logs", "-o", tmp_path / "set", *arguments)
    assert "name the file as [truth] in the map of columns" in said


SPEEDS = "stamp_ms,speed,gyro_dps\n0,1,90\n1000,2,0\n2000,0,0\n"
MARKERS = "stamp_ms,marker,forward_mm,left_mm\n1000,7,2000,0\n"
TAGS = "t,id,range,bearing_deg\n1,7,2,90\n"


def team_files(folder: Path, layout: str) -> Path:
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
    assert first.exit_code == 2
    assert f"next step: check {columns}, which now has this proposal" in first.output
    assert "[robots.bob.odometry]" in columns.read_text()
    imported(*command)
    check_team(tmp_path / "set")
    unknown = columns.read_text().replace("[robots.bob", "[robots.eve")
    columns.write_text(unknown)
    if "/" in layout:
        refused = refusal(logs, "-o", tmp_path / "eve", "--columns", columns)
        assert "[robots.eve]: no files of such a robot" in refused
    columns.write_text(unknown.replace("[robots.eve", "[robots.Bob"))
    refused = refusal(logs, "-o", tmp_path / "bob", "--columns", columns)
    assert "[robots.Bob]: no robot's name" in refused


def test_a_robot_is_added_to_a_data_set(tmp_path):
    logs = team_files(tmp_path / "logs", "{robot}/{name}.csv")
    for robot in ("ann", "bob"):
        columns = tmp_path / f"{robot}.toml"
        run(logs / robot, "-o", tmp_path / "new", "--robot", robot, "--columns", columns)
        arguments = (logs / robot, "-o", tmp_path / "set", "--robot", robot, "--columns", columns)
        _, said = imported(*arguments)
        assert "add a robot" in run(*arguments).output
        if robot == "ann":
            scenario = tmp_path / "set" / "scenario.toml"
            scenario.write_text('base = "recorded"\n[world]\npath = "."\n[[robots]]\nid = "ann"\n')
    check_team(tmp_path / "set")
    assert "scenario.toml: bob is added to its robots" in said
    columns.write_text(columns.read_text().replace("wheels.csv", "none.csv"))
    refusal(logs / "bob", "-o", tmp_path / "set", "--robot", "cat", "--columns", columns)
    assert {each.name for each in tmp_path.iterdir()} == {"ann.toml", "bob.toml", "logs", "set"}
    check_team(tmp_path / "set")


def team_of(folder: Path, **files: str) -> Path:
    folder.mkdir()
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


def test_a_truth_that_is_called_as_a_robot_is_that_robots_alone(tmp_path):
    team = {f"{robot}_{name}": text for robot in ("ann", "bob")
            for name, text in (("odom", TRACK), ("tags", TAGS))}  # fmt: skip
    logs, columns = team_of(tmp_path / "logs", **team, ann_mocap=TRACK), tmp_path / "columns.toml"
    assert run(logs, "-o", tmp_path / "set", "--columns", columns).exit_code == 2
    assert '[robots.ann.truth]\nfiles = ["ann_mocap.csv"]' in columns.read_text()
    assert "[truth]" not in columns.read_text()
    ann, bob = imported(logs, "-o", tmp_path / "set", "--columns", columns)[0].streams
    assert ann.truth is not None
    assert bob.truth is None


def test_one_truth_of_two_robots_is_not_proposed_and_refused_unless_its_rows_are_told_apart(
    tmp_path,
):
    team = {f"{robot}_{name}": text for robot in ("ann", "bob")
            for name, text in (("odom", TRACK), ("tags", TAGS))}  # fmt: skip
    head, *rows = TRACK.splitlines()
    both = [f"{head},robot", *(f"{row},{robot}" for robot in ("ann", "bob") for row in rows)]
    logs = team_of(tmp_path / "logs", **team, mocap=TRACK, both="\n".join(both))
    columns = tmp_path / "columns.toml"
    assert run(logs, "-o", tmp_path / "set", "--columns", columns).exit_code == 2
    proposed = columns.read_text()
    assert "mocap.csv: whose truth? It goes into [robots.NAME.truth]" in proposed
    assert "truth]\nfiles" not in proposed
    names = dict(zip(("t_s", "x_m", "y_m", "theta_rad"), head.split(","), strict=True))
    of = "".join(f'{ours} = "{theirs}"\n' for ours, theirs in names.items())
    columns.write_text(f'{proposed}\n[truth]\nfiles = ["mocap.csv"]\n[truth.columns]\n{of}')
    refused = refusal(logs, "-o", tmp_path / "set", "--columns", columns)
    assert "mocap.csv: the truth of both ann and bob" in refused
    assert "[robots.ann.truth]" in refused
    truths = [
        f'[robots.{robot}.truth]\nfiles = ["both.csv"]\ndrop = {{ robot = ["{other}"] }}\n'
        f"[robots.{robot}.truth.columns]\n{of}"
        for robot, other in (("ann", "bob"), ("bob", "ann"))
    ]
    columns.write_text(proposed + "".join(truths))
    world, _ = imported(logs, "-o", tmp_path / "set", "--columns", columns)
    assert all(each.truth is not None for each in world.streams)


def test_tables_with_a_column_of_robots_have_a_map_that_parts_them(tmp_path):
    def both(text: str) -> str:
        head, *rows = text.splitlines()
        rows = [f"{row},{robot}" for row in rows for robot in ("ann", "bob")]
        return "\n".join([f"{head},robot", *rows])

    logs = team_of(tmp_path / "logs", odom=both(TRACK), tags=both(TAGS))
    columns = tmp_path / "columns.toml"
    assert run(logs, "-o", tmp_path / "set", "--columns", columns).exit_code == 2
    assert 'drop = { robot = ["bob"] }' in columns.read_text()
    world, _ = imported(logs, "-o", tmp_path / "set", "--columns", columns)
    assert [each.robot for each in world.streams] == ["ann", "bob"]
    seen = "t,robot,range,bearing\n1,bob,2.0,0.1\n2,cat,2.0,0.1\n"
    alone = team_of(tmp_path / "alone", odom=TRACK, tags=TAGS, sightings=seen)
    columns = tmp_path / "alone.toml"
    assert run(alone, "-o", tmp_path / "one", "--columns", columns).exit_code == 2
    assert "robots." not in columns.read_text(), "teammates, seen by one robot"


def test_a_file_of_two_robots_is_refused_by_its_column_or_its_times_with_the_cure(tmp_path):
    head = TRACK.splitlines()[0]
    steps = [f"{t},{0.1 * t + 5 * k},0,0,{robot}" for t in range(1, 9)
             for k, robot in enumerate(("ann", "bob"))]  # fmt: skip
    text = "\n".join([f"{head},robot", *steps])
    logs, columns = team_of(tmp_path / "logs", odom=text, tags=TAGS), tmp_path / "columns.toml"
    command = (logs, "-o", tmp_path / "set", "--robot", "ann", "--columns", columns)
    assert run(*command).exit_code == 2
    refused = refusal(*command)
    cure = 'drop = { robot = ["bob"] }'
    assert "odom.csv, line 1: column robot has 2 values, ann, bob" in refused
    assert f"write {cure} below `files` of [odometry] of {columns}" in refused
    proposed = columns.read_text()
    columns.write_text(proposed.replace('["odom.csv"]', f'["odom.csv"]\n{cure}'))
    (stream,) = imported(logs, "-o", tmp_path / "set", "--columns", columns)[0].streams
    assert len(stream.intervals.end_ns) == 7
    (logs / "odom.csv").write_text("\n".join(row.rpartition(",")[0] for row in text.splitlines()))
    columns.write_text(proposed)
    said = refusal(logs, "-o", tmp_path / "mixed", "--robot", "ann", "--columns", columns)
    assert "odom.csv, line 3, column t_s: 8 of 16 odometry rows have the time of another" in said
    assert f"in [odometry] of {columns}" in said


@pytest.mark.parametrize("kind", ["observations", "detections"])
def test_a_fault_of_a_mapped_table_has_the_users_file_line_and_entry(tmp_path, kind):
    head, cell = ("id,", "7,") if kind == "observations" else ("", "")
    degrees = [f"{t},{cell}{2 + t},{40 * t - 100}" for t in range(5)]
    logs = team_of(tmp_path / "logs", odom=TRACK, seen="\n".join([f"t,{head}far,angle", *degrees]))
    ours = {"t_s": "t", "range_m": "far", "bearing_rad": "angle"}
    ours |= {"landmark": "id"} if head else {}
    columns = tmp_path / "columns.toml"

    def refused(**exchanged: str) -> str:
        rows = "".join(f'{key} = "{theirs}"\n' for key, theirs in (ours | exchanged).items())
        columns.write_text(f'{ODOMETRY}\n[{kind}]\nfiles = ["seen.csv"]\n[{kind}.columns]\n{rows}')
        return refusal(logs, "-o", tmp_path / "set", "--robot", "ann", "--columns", columns)

    said = refused()
    assert f"{logs / 'seen.csv'}, line 2, column bearing_rad: -100 is more than a whole" in said
    entry = 'bearing_rad = { column = "angle", scale = 0.017453292519943295 }'
    assert f"write {entry} in [{kind}] of {columns}" in said
    said = refused(range_m="angle", bearing_rad="far")
    assert f"{logs / 'seen.csv'}, line 2, column range_m: 3 of 5 ranges are not above 0" in said
    assert f"exchange range_m and bearing_rad in [{kind}] of {columns}" in said


def test_a_robot_whose_odometry_is_missing_has_the_expected_file_named(tmp_path):
    files = {"husky_odom": TRACK, "husky_tags": TAGS, "jackal_tags": TAGS}
    logs, columns = team_of(tmp_path / "logs", **files), tmp_path / "columns.toml"
    said = run(logs, "-o", tmp_path / "set", "--columns", columns).output
    assert "# jackal has no odometry: expected jackal_odom.csv, as husky_odom.csv" in said
    refused = refusal(logs, "-o", tmp_path / "set", "--columns", columns)
    assert "jackal has no odometry: expected jackal_odom.csv; there are jackal_tags.csv" in refused
    (logs / "jackal_odom.csv").write_text(TRACK)
    assert len(imported(logs, "-o", tmp_path / "set", "--columns", columns)[0].streams) == 2


@pytest.mark.parametrize("place", ["", "ann"])
def test_tables_with_names_of_their_own_are_told_to_be_imported(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "wheels.csv").write_text(TRACK)
    with pytest.raises(DatasetError, match=r"names of their own .*: `teamslam import .* --columns"):
        kind_of(tmp_path)


@pytest.mark.parametrize(
    ("column", "alone"), [("phi", "range_m alone"), ("far", "bearing_rad alone")]
)
def test_a_column_that_no_name_assigns_is_named_in_the_proposal_and_in_the_next_error(
    tmp_path, column, alone
):
    logs, columns = tmp_path / "logs", tmp_path / "columns.toml"
    (logs / "r1").mkdir(parents=True)
    (logs / "r1" / "wheels.csv").write_text("time,v,omega,volts\n0,1,0,12\n1,1,0,12\n")
    found = {"phi": "range,phi", "far": "bearing,far"}[column]
    (logs / "r1" / "tags.csv").write_text(f"time,tag,{found}\n0,3,2,0.1\n")
    given = (logs, "-o", tmp_path / "set", "--columns", columns)
    run(*given)
    sections = columns.read_text().split("\n\n")
    assert [each.partition("# not assigned: ")[2].strip() for each in sections] == [column, "volts"]
    refused = refusal(*given)
    assert f"no measurement in its columns ({alone}); give range_m,bearing_rad or" in refused
    named = f"[observations] of {columns}; columns of the file not assigned there: {column}"
    assert refused.endswith(named)


def test_columns_of_another_table_of_the_file_and_dropped_robots_are_assigned():
    header = ["t", "robot", "v", "omega", "gt_x", "gt_y", "gt_yaw", "volts"]
    cells = [["0", "1"], ["r1", "r2"], *[["0", "0"] for _ in header[2:]]]
    log = {"log.csv": CsvTable("log.csv", dict(zip(header, cells, strict=True)), [2, 3])}
    drops = drops_by_robot(log)
    text = propose_map(dict.fromkeys(drops, log), drops=drops)
    assert "[robots.r2.truth]" in text
    assert set(re.findall("# not assigned: .*", text)) == {"# not assigned: volts"}
