from pathlib import Path

import numpy as np
import pytest

from teamslam.sim.calibration.data import messages_of
from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.datasets.kinds import kind_of
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.datasets.unlabelled import unlabelled
from teamslam.sim.scenarios.scenario import folder_scenario, load, with_options
from teamslam.sim.scenarios.source import open_data_set, scenario_beside, streams_of
from teamslam.sim.world.config import UnlabelledWorld
from teamslam.sim.world.streams import FIXES, NO_LABEL, OBSERVATIONS, ODOMETRY
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.wire import messages as m
from tests.commands import run
from tests.scenarios import with_world


def write(folder, **tables):
    folder.mkdir(exist_ok=True)
    for name, (header, rows) in tables.items():
        lines = [header, *(",".join(map(str, row)) for row in rows)]
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def steps(tmp_path):
    odometry = [(i, 0.5, 0.0, 0.1, 1e-4, 0.0, 2e-4, 0.0, 0.0, 3e-4) for i in range(12)]
    seen = [(i, 2.0, 0.5 * j, 0.01, 0.001, 0.02) for i in range(12) for j in range(2)]
    labels = [(3 if j else -1,) for _ in range(12) for j in range(2)]
    return write(
        tmp_path / "steps",
        odometry=("step,dx_m,dy_m,dtheta_rad,c_xx,c_xy,c_yy,c_xt,c_yt,c_tt", odometry),
        detections=("step,x_m,y_m,c_xx,c_xy,c_yy", seen),
        labels=("landmark", labels),
        reference_landmarks=("landmark,x_m,y_m", [(3, 2.5, 0.5)]),
    )


@pytest.fixture
def car(tmp_path):
    odometry = [(f"{0.1 * i:.3f}", 1.0, 0.1) for i in range(1, 41)]
    seen = [(f"{0.05 + 0.5 * i:.3f}", 10.0 + i, 1.5, 0.3) for i in range(7)]
    return write(
        tmp_path / "car",
        odometry=("t_s,rear_wheel_speed_m_s,steering_rad", odometry),
        detections=("t_s,range_m,bearing_rad,diameter_m", seen),
        gps=("t_s,x_m,y_m", [(0.2, 1.0, 2.0), (3.0, 4.0, 5.0)]),
    )


def streams(folder, robots=1, **fields):
    return unlabelled(UnlabelledWorld(path=str(folder), **fields), robots)


def test_calibration_takes_a_set_without_names_and_hears_no_label(steps):
    world, scenario, _ = open_data_set(steps)
    (stream,) = world.streams
    assert scenario.name == "dlr"
    seen = stream.landmark_detections
    assert 3 in seen.ids[seen.rows(0)]
    received = next(each for each in messages_of(stream) if isinstance(each, m.Detections))
    assert translate.scan_of(received).ids.tolist() == [UNNAMED, UNNAMED + 1]


def test_a_set_in_steps_keeps_every_number(steps):
    (stream,) = streams(steps).streams
    assert kind_of(steps) == "unlabelled"
    assert scenario_beside(steps) == "dlr"
    odometry = stream.intervals
    assert odometry.increments[3].tolist() == [0.5, 0.0, 0.1]
    c, s = np.cos(0.1), np.sin(0.1)
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(odometry.covariances[3], turned @ np.diag([1e-4, 2e-4, 3e-4]) @ turned.T)
    scan = stream.landmark_detections.only(5, 6)
    assert scan.hidden.all()
    assert scan.ids.tolist() == [NO_LABEL, 3]
    assert np.allclose(scan.ranges * np.cos(scan.bearings), 2.0)
    assert np.allclose(scan.ranges * np.sin(scan.bearings), [0.0, 0.5])
    assert np.allclose(scan.covariances[0], [0.01, 0.001 / 2.0, 0.02 / 4.0])


def test_a_car_keeps_its_steering_and_gps_and_what_nobody_has_labelled(car):
    found = streams(car)
    (stream,) = found.streams
    assert scenario_beside(car) == "victoria"
    assert found.landmarks is None
    driven = stream.intervals
    assert driven.steered
    first = driven.forward[0], driven.yaw_rate[0], driven.duration_ns[0]
    assert first == (1.0, 0.1, 50_000_000)
    assert set(stream.landmark_detections.ids.tolist()) == {NO_LABEL}
    assert stream.landmark_detections.signatures.tolist() == [0.3] * 7
    assert stream.positions.tolist() == [[1.0, 2.0], [4.0, 5.0]]


@pytest.mark.parametrize("count", [1, 2])
def test_the_gps_gives_fixes_if_asked_for_and_then_no_start_is_known(car, count):
    world = UnlabelledWorld(path=str(car), fixes=True)
    parts = unlabelled(world, count).streams
    assert all(part.start is None for part in parts)
    fixes = np.concatenate([part.fixes for part in parts])
    assert fixes[:, :2].tolist() == [[1.0, 2.0], [4.0, 5.0]]
    assert np.isnan(fixes[:, 2:]).all()
    plain = streams(car, count).streams
    assert [len(part.fixes) for part in plain] == [0] * count
    for part, without in zip(parts, plain, strict=True):
        assert (part.kinds == FIXES).sum() == len(part.fixes)
        assert np.array_equal(
            part.landmark_detections.stamps_ns, without.landmark_detections.stamps_ns
        )
    (car / "gps.csv").unlink()
    with pytest.raises(DatasetError, match=r"no gps\.csv"):
        unlabelled(world, count)


@pytest.mark.parametrize("count", [2, 4])
def test_pieces_have_each_measurement_once_begin_together_and_know_no_initial_pose(
    steps, car, count
):
    for folder in (steps, car):
        (whole,) = streams(folder).streams
        parts = streams(folder, count).streams
        assert [part.robot for part in parts] == [f"r{i + 1}" for i in range(count)]
        assert all(part.start is None for part in parts)
        assert len({int(part.stamps_ns[0]) for part in parts}) == 1
        for kind in (ODOMETRY, OBSERVATIONS):
            lengths = [int((part.kinds == kind).sum()) for part in parts]
            assert sum(lengths) == (whole.kinds == kind).sum()
        together = [part.landmark_detections.ranges for part in parts]
        assert np.array_equal(np.concatenate(together), whole.landmark_detections.ranges)


@pytest.mark.parametrize(
    ("table", "text", "why"),
    [
        ("labels", "landmark\n1\n", "1 rows, 24 in detections.csv"),
        ("labels", "name\n1\n", "labels.csv, line 1: no column landmark"),
        ("odometry", "step,dx_m,dy_m\n0,1,0\n", "no column dtheta_rad, c_xx, c_xy, c_yy, c_xt"),
        ("odometry", "t,v\n0,1\n", "columns of neither kind; it needs t_s,rear_wheel_speed_m_s,s"),
        (
            "odometry",
            "step,dx_m,dy_m,dtheta_rad,c_xx,c_xy,c_yy,c_xt,c_yt,c_tt\n",
            "no odometry int",
        ),
        ("detections", "t_s,range_m,bearing_rad\n0,1,1\n", "it needs step,x_m,y_m,c_xx,c_xy,c_yy"),
        ("detections", "step,x_m,y_m\n0,1,1\n", "line 1: no column c_xx, c_xy, c_yy"),
        ("detections", "step,x_m,y_m,c_xx,c_xy,c_yy\n1,1,1,1,0,1\n0,1,1,1,0,1\n", "order of time"),
    ],
)
def test_what_is_wrong_with_a_table_is_named(steps, table, text, why):
    (steps / f"{table}.csv").write_text(text)
    if table == "detections":
        (steps / "labels.csv").unlink()
    with pytest.raises(DatasetError, match=why):
        streams(steps)


def launched(*words):
    result = run("launch", *words)
    assert isinstance(result.exception, DatasetError), result.output
    return str(result.exception)


def test_launch_checks_a_log_of_one_robot_before_any_process_starts(steps, car):
    assert "name it with --dataset" in launched("victoria")
    text = (car / "detections.csv").read_text()
    (car / "detections.csv").write_text(text.replace("10.0", "abc"))
    assert "line 2, column range_m: 'abc' is not a number" in launched("--dataset", car)
    (steps / "labels.csv").write_text("landmark\n1\n")
    assert "1 rows, 24 in detections.csv" in launched("dlr", "--dataset", steps)
    (steps / "labels.csv").unlink()
    cut = launched("dlr", "--dataset", steps, "--pieces", 13)
    assert "12 odometry intervals can not be cut into 13 pieces" in cut


def written(place: Path, tagged: float) -> tuple:
    scenario = with_options(load("thesis-b"), robots=2, identities="hidden")
    scenario = with_world(scenario, steps=12, clutter=0.3, missed=0.1, tagged=tagged)
    streams = streams_of(scenario)
    write_folder(streams, place)
    (place / "scenario.toml").write_text(folder_scenario(scenario))
    return streams, load(place / "scenario.toml")


@pytest.mark.parametrize("tagged", [0.0, 0.5])
def test_what_is_written_is_read_as_it_was(tmp_path, tagged):
    streams, scenario = written(tmp_path / "set", tagged)
    again = streams_of(scenario)
    assert scenario.central.association.slack > 0.03, "the thresholds in the sensor's lengths"
    for one, two in zip(streams.streams, again.streams, strict=True):
        told, read = one.landmark_detections, two.landmark_detections
        full = np.flatnonzero(np.diff(told.offsets))
        assert (told.stamps_ns[full] == read.stamps_ns[np.flatnonzero(np.diff(read.offsets))]).all()
        for name in ("ids", "ranges", "bearings"):
            assert np.array_equal(getattr(told, name), getattr(read, name))
        hidden = np.repeat(told.hidden, np.diff(told.offsets))
        assert np.array_equal(hidden, np.repeat(read.hidden, np.diff(read.offsets)))
        assert hidden.any()
        assert (tagged > 0.0) == (not hidden.all())
