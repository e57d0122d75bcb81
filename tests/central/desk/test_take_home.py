import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from teamslam.central.desk import paths
from teamslam.central.desk.evaluation.errors import Path as Poses, pose_errors
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.export.take_home import (
    MAP_COLUMNS,
    TakenHome,
    take_home,
    write_geojson,
    write_map,
    write_paths,
)
from teamslam.central.desk.left_out import is_kept, spans_left_out
from teamslam.central.desk.paths import SmoothedPath, smoothed_paths
from teamslam.central.desk.verification.recorded import Recorded, RecordedWindow
from teamslam.team.datum import Datum
from teamslam.team.geodesy import local_from_geodetic
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample
from tests.central.test_diagnosis import TEAM, scenario
from tests.sim.reruns import team_samples
from tests.trials.stress_world import CarriedOff

DATUM = Datum(48.745, 9.105, 400.0)


def recorded_of(samples: list[Sample]) -> Recorded:
    found = Recorded()
    found.take_all(samples)
    return found


def rows_of(table: Path) -> list[dict[str, str]]:
    with table.open() as lines:
        return list(csv.DictReader(lines))


def test_a_path_has_every_keyframe_and_the_final_maps_ends(log):
    run = evaluate(log)
    for robot, path in smoothed_paths(recorded_of(log)).items():
        ends = run.robots[robot].smoothed_path
        assert path.at_keyframes
        assert len(path.stamps_ns) > 3 * len(ends.stamps_ns)
        assert (np.diff(path.stamps_ns) > 0).all()
        at_ends = np.searchsorted(path.stamps_ns, ends.stamps_ns)
        np.testing.assert_array_equal(path.poses[at_ends], ends.poses)


def test_a_keyframe_at_a_windows_start_is_not_a_second_pose_of_that_stamp(log, monkeypatch):
    """A window that ends with a scan leaves it to the next one, whose first keyframe it is."""

    def windows(*of) -> dict[int, RecordedWindow]:
        found = {}
        for end_ns, (start_ns, path) in computed(*of).items():
            if path is not None:
                stamps_ns = np.concatenate([[start_ns], path.stamps_ns[1:]])
                found[end_ns] = RecordedWindow(start_ns, replace(path, stamps_ns=stamps_ns))
        return found

    computed = paths._windows
    monkeypatch.setattr(paths, "_windows", windows)
    for path in smoothed_paths(recorded_of(log)).values():
        assert path.at_keyframes
        assert (np.diff(path.stamps_ns) > 0).all()


def test_parts_that_meet_have_one_pose_there(log):
    path = smoothed_paths(recorded_of(log))["r1"]
    middle = len(path.stamps_ns) // 2
    parts = [
        SmoothedPath(path.stamps_ns[of], path.poses[of], path.covariances[of], at_keyframes=True)
        for of in (slice(0, middle + 1), slice(middle, None))
    ]
    joined = paths._join_parts(parts)
    np.testing.assert_array_equal(joined.stamps_ns, path.stamps_ns)
    np.testing.assert_array_equal(joined.poses, path.poses)


def test_between_the_ends_the_covariance_is_that_of_the_errors(log):
    run = evaluate(log)
    within = []
    for robot, path in smoothed_paths(recorded_of(log)).items():
        kept = ~np.isin(path.stamps_ns, run.robots[robot].smoothed_path.stamps_ns)
        kept[0] = False  # the initial pose is exactly known
        poses = Poses(path.stamps_ns[kept], path.poses[kept])
        errors = pose_errors(poses, path.covariances[kept], run.robots[robot].truth)
        within.append(errors.nees / 3.0)
    assert 0.3 < float(np.concatenate(within).mean()) < 2.0


def test_the_tables_come_back_to_the_last_bit(log, tmp_path):
    home = take_home(recorded_of(log))
    fused = evaluate(log).map
    write_map(fused, home, tmp_path)
    rows = rows_of(tmp_path / "map.csv")
    assert tuple(rows[0]) == MAP_COLUMNS
    assert [int(row["id"]) for row in rows] == fused.ids.tolist()
    assert [(float(row["x_m"]), float(row["y_m"])) for row in rows] == [
        tuple(mean) for mean in fused.means.tolist()
    ]
    assert all(int(row["measurements"]) > 0 and row["frame"] == fused.frame for row in rows)
    data = json.loads((tmp_path / "map.json").read_text())
    assert data["final_map_sha256"] == fused.payload_sha256
    assert [each["x_m"] for each in data["landmarks"]] == fused.means[:, 0].tolist()
    for path in write_paths(home.paths, tmp_path / "paths"):
        lines = path.read_text().splitlines()
        assert len(lines) == 1 + len(home.paths[path.stem].stamps_ns)
    read = np.loadtxt(tmp_path / "paths" / "r1.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(read[:, 1:4], home.paths["r1"].poses)
    np.testing.assert_array_equal(read[:, 5], home.paths["r1"].covariances[:, 0, 1])


def test_a_map_beside_a_saved_one_has_each_landmarks_state(log, tmp_path):
    fused = evaluate(log).map
    first, second = fused.ids[:2].tolist()
    changes = (
        m.LandmarkChange(landmark=first, state="gone"),
        m.LandmarkChange(landmark=second, state="moved", dx=1.0),
    )
    write_map(replace(fused, changes=changes), TakenHome(), tmp_path)
    rows = rows_of(tmp_path / "map.csv")
    assert [row["state"] for row in rows[:3]] == ["gone", "moved", ""]
    data = json.loads((tmp_path / "map.json").read_text())
    assert [each["state"] for each in data["landmarks"][:3]] == ["gone", "moved", None]


def test_a_map_with_a_datum_has_degrees_in_its_table_and_as_geojson(log, tmp_path):
    home = take_home(recorded_of(log))
    assert home.datum is None  # the frame of the start poses
    fused = evaluate(log).map
    classes = {int(fused.ids[0]): ("tree", 0.75)}
    write_map(fused, replace(home, datum=DATUM, classes=classes), tmp_path)
    rows = rows_of(tmp_path / "map.csv")
    assert (rows[0]["class"], rows[0]["class_probability"]) == ("tree", "0.75")
    assert rows[1]["class"] == ""
    degrees = [[float(row["latitude_deg"]), float(row["longitude_deg"])] for row in rows]
    back = local_from_geodetic(DATUM, np.array(degrees))
    np.testing.assert_allclose(back, fused.means, atol=1e-5)
    found = json.loads(write_geojson(fused, home.paths, tmp_path, DATUM).read_text())
    points = [each for each in found["features"] if each["geometry"]["type"] == "Point"]
    assert [each["geometry"]["coordinates"][::-1] for each in points] == degrees
    lines = [each for each in found["features"] if each["geometry"]["type"] == "LineString"]
    assert [each["properties"]["robot"] for each in lines] == ["r1", "r2"]
    assert len(lines[0]["geometry"]["coordinates"]) == len(home.paths["r1"].poses)


# Parts of a path that are left out.


S = 1_000_000_000


def jump(at_s: int, place: tuple[float, ...] = ()) -> m.Diagnosis:
    return m.Diagnosis(cause="carried_off", robot="r2", at_ns=at_s * S, place=place)


def test_both_windows_beside_a_jump_are_left_out_with_the_pose_between_them():
    ends = [s * S for s in range(10, 101, 10)]
    stamps = np.arange(0, 101, 5) * S
    spans = spans_left_out([jump(50)], "r2", ends)
    assert (stamps[~is_kept(stamps, spans)] // S).tolist() == [45, 50, 55]
    start = spans_left_out([jump(0)], "r2", ends)
    assert (stamps[~is_kept(stamps, start)] // S).tolist() == [0, 5]
    assert not spans_left_out([jump(50)], "r1", ends)
    assert not spans_left_out([jump(50, (1.0, 2.0))], "r2", ends), "the stream is cut there"


def test_the_path_has_no_poses_where_the_robot_was_carried_off(tmp_path):
    off = CarriedOff("r2", 4.0, 0.6, 45.0)
    samples = team_samples(scenario(replace(TEAM, carried_off=(off,)), tmp_path))
    run = evaluate(samples)
    path = smoothed_paths(recorded_of(samples))["r2"]
    assert path.at_keyframes
    gap = int(np.diff(path.stamps_ns).argmax())
    begin, end = (path.stamps_ns[gap : gap + 2] * 1e-9).tolist()
    assert begin < off.at_s < end
    (note,) = (each for each in run.notes if "left out" in each)
    assert note.startswith(f"r2's path from {begin:.1f} s to {end:.1f} s is left out: ")
    truth = run.robots["r2"].truth
    at = np.searchsorted(truth.stamps_ns, path.stamps_ns).clip(0, len(truth.stamps_ns) - 1)
    away = path.poses[:, :2] - truth.poses[at, :2]
    assert np.hypot(*away.T).max() < 1.0
    assert run.robots["r2"].smoothed.errors[:, :2].max() < 0.5
