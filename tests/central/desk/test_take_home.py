"""What a user takes home: paths at keyframe rate with true covariances, the map as tables."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from central.desk.evaluation.errors import Path as Poses
from central.desk.evaluation.errors import pose_errors
from central.desk.evaluation.evaluation import evaluate
from central.desk.export.take_home import MAP_COLUMNS, taken_home, write_map, write_paths
from central.desk.paths import smoothed_paths
from central.desk.verification.recorded import Recorded
from sim.in_memory.team import run_team
from team.wire.bus import Sample
from tests.sim.logs import scenario, streams


@pytest.fixture(scope="module")
def log() -> list[Sample]:
    of = scenario(robots=2)
    return list(run_team(of, streams(of)))


def recorded_of(samples: list[Sample]) -> Recorded:
    found = Recorded()
    for sample in samples:
        found.take(sample)
    return found


def test_a_path_has_every_keyframe_and_the_final_maps_ends(log: list[Sample]) -> None:
    run = evaluate(log)
    for robot, path in smoothed_paths(recorded_of(log)).items():
        ends = run.robots[robot].smoothed_path
        assert path.at_keyframes
        assert len(path.stamps_ns) > 3 * len(ends.stamps_ns)
        assert (np.diff(path.stamps_ns) > 0).all()
        at_ends = np.searchsorted(path.stamps_ns, ends.stamps_ns)
        np.testing.assert_array_equal(path.poses[at_ends], ends.poses)


def test_between_the_ends_the_covariance_is_that_of_the_errors(log: list[Sample]) -> None:
    """Per pose, NEES/3 of two robots; as if the ends alone told where it was, it would be wrong."""
    run = evaluate(log)
    within = []
    for robot, path in smoothed_paths(recorded_of(log)).items():
        kept = ~np.isin(path.stamps_ns, run.robots[robot].smoothed_path.stamps_ns)
        kept[0] = False  # the initial pose is exactly known
        poses = Poses(path.stamps_ns[kept], path.poses[kept])
        errors = pose_errors(poses, path.covariances[kept], run.robots[robot].truth)
        assert errors is not None
        within.append(errors.nees / 3.0)
    assert 0.3 < float(np.concatenate(within).mean()) < 2.0


def test_without_the_measurements_the_ends_are_what_there_is(log: list[Sample]) -> None:
    said = [sample for sample in log if "/odometry" not in sample.key]
    ends = {name: robot.smoothed_path for name, robot in evaluate(log).robots.items()}
    for robot, path in smoothed_paths(recorded_of(said)).items():
        assert not path.at_keyframes
        np.testing.assert_array_equal(path.poses, ends[robot].poses)


def test_the_tables_come_back_to_the_last_bit(log: list[Sample], tmp_path: Path) -> None:
    home = taken_home(recorded_of(log))
    fused = evaluate(log).map
    assert fused is not None
    write_map(fused, home.measurements, tmp_path)
    with (tmp_path / "map.csv").open() as lines:
        rows = list(csv.DictReader(lines))
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
    with (tmp_path / "paths" / "r1.csv").open() as lines:
        read = np.array([[float(v) for v in row] for row in list(csv.reader(lines))[1:]])
    np.testing.assert_array_equal(read[:, 1:4], home.paths["r1"].poses)
    np.testing.assert_array_equal(read[:, 5], home.paths["r1"].covariances[:, 0, 1])
