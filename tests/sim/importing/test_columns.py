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


def test_columns_of_a_reference_are_no_odometry(tmp_path):
    said = proposal(tmp_path / "a", robot="t,gt_x,gt_y,gt_yaw\n0,0,0,0\n")
    assert "[odometry]" not in said
    assert '[truth]\nfiles = ["robot.csv"]\n[truth.columns]\nt_s = "t"\nx_m = "gt_x"' in said
    both = proposal(tmp_path / "b", robot="t,v,w,gt_x,gt_y,gt_yaw\n0,0,0,0,0,0\n")
    assert 'forward_m_s = "v"\nyaw_rate_rad_s = "w"\n\n[truth]\nfiles = ["robot.csv"]' in both


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


def test_observations_without_identities_are_told_their_table(tmp_path):
    (tmp_path / "odom.csv").write_text(TRACK)
    (tmp_path / "columns.toml").write_text(
        ODOMETRY + '[observations]\nfiles = ["cones.csv"]\n[observations.columns]\nt_s = "t"\n'
    )
    result = run(tmp_path, "-o", tmp_path / "set", "--columns", tmp_path / "columns.toml")
    assert "measurements without identities are [detections]" in str(result.exception)


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


@pytest.mark.parametrize("place", ["", "ann"])
def test_tables_with_names_of_their_own_are_told_to_be_imported(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "wheels.csv").write_text(TRACK)
    with pytest.raises(
        DatasetError, match=r"names of their own .*: `teamslam import .* -o FOLDER`"
    ):
        kind_of(tmp_path)
