from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.cli.main import _advice, app
from teamslam.sim.datasets.graph import graph_world, read_graph
from teamslam.sim.datasets.kinds import kind_of
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import scenario_beside, streams_of
from teamslam.sim.world.config import GraphWorld
from teamslam.team.estimation.se2 import between, compose
from tests.scenarios import final_only, with_world

ISAM = """# three poses, one landmark
ODOMETRY 0 1 2 0 1.5707963267948966 50 0 0 20 0 100
LANDMARK 1 7 3 1 10 0 5
EDGE2 1 2 1 0 0 50 0 0 20 0 100
LANDMARK 2 7 2 1
EDGE2 2 0 1 1 0 1 0 0 1 0 1
"""
G2O = """VERTEX_SE2 0 5 1 0
FIX 0
VERTEX_SE2 1 7 1 1.5707963267948966
VERTEX_XY 7 6 4
EDGE_SE2 0 1 2 0 1.5707963267948966 4 1 0 9 0 16
EDGE_SE2_XY 1 7 3 1 4 0 1
PARAMS_SE2OFFSET 0 0 0 0
"""
TORO = """VERTEX2 0 0 0 0
VERTEX2 1 2 0 1.5707963267948966
EDGE2 0 1 2 0 1.5707963267948966 4 1 9 16 0 0
LANDMARK 1 7 3 1 4 0 1
"""
PYFG = """VERTEX_SE2 0.0 A0 0 0 0
VERTEX_SE2 0.5 A1 1 0 0
VERTEX_SE2 0.0 B0 0 1 0
VERTEX_SE2 0.5 B1 1 1 0
VERTEX_XY L3 2 2
VERTEX_SE2:PRIOR 0.0 B0 0.1 1 0 0.04 0 0 0.04 0 0.01
EDGE_SE2 0.5 A0 A1 1.02 0 0 0.01 0 0 0.01 0 0.001
EDGE_SE2 0.5 B0 B1 0.97 0 0 0.01 0 0 0.01 0 0.001
EDGE_SE2 0.5 A1 B1 0 1 0 0.01 0 0 0.01 0 0.001
EDGE_SE2_XY 0.5 A1 L3 1 2 0.01 0.001 0.02
EDGE_RANGE 0.5 A1 B1 1.0 0.01
"""


def written(folder: Path, text: str, name: str = "graph.txt") -> Path:
    (folder / name).write_text(text)
    return folder / name


def streams(path: Path, robots: int = 1, **fields: object):
    return graph_world(GraphWorld(path=str(path), **fields), robots)


def test_isams_weights_are_roots_in_the_axes_of_the_first_pose(tmp_path):
    path = written(tmp_path, ISAM)
    world = streams(path)
    (stream,) = world.streams
    assert (kind_of(path), scenario_beside(path)) == ("graph", "graph")
    assert stream.intervals.increments.tolist() == [[2.0, 0.0, np.pi / 2.0], [1.0, 0.0, 0.0]]
    ahead_and_left = np.diag(stream.intervals.covariances[0])
    assert np.allclose(ahead_and_left, [1.0 / 20.0**2, 1.0 / 50.0**2, 1e-4])
    seen = stream.landmark_detections
    assert seen.points.tolist() == [[3.0, 1.0], [2.0, 1.0]]
    assert np.allclose(seen.covariances, [[0.01, 0.0, 0.04], [1.0, 0.0, 1.0]])
    assert seen.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000]
    assert world.landmarks is None
    assert any("1 edge between poses not used" in note for note in world.notes)


@pytest.mark.parametrize("text", [G2O, TORO])
def test_g2o_and_toro_state_the_information(tmp_path, text):
    (stream,) = streams(written(tmp_path, text)).streams
    stated = np.linalg.inv(np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 16.0]]))
    if text is TORO:  # in the axes of the first pose, a quarter turn back
        R = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        stated = R @ stated @ R.T
    assert np.allclose(stream.intervals.covariances[0], stated)
    assert np.allclose(stream.landmark_detections.covariances, [[0.25, 0.0, 1.0]])
    assert stream.start.pose.tolist() == ([5.0, 1.0, 0.0] if text is G2O else [0.0, 0.0, 0.0])


def test_pyfg_has_robots_times_priors_and_the_truth(tmp_path):
    world = streams(written(tmp_path, PYFG), robots=2)
    first, second = world.streams
    assert first.start.covariance is None
    assert np.allclose(second.start.covariance, np.diag([0.04, 0.04, 0.01]))
    assert second.start.pose.tolist() == [0.1, 1.0, 0.0]
    assert second.truth.tolist() == [[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]
    assert first.intervals.duration_ns.tolist() == [500_000_000]
    assert first.landmark_detections.covariances.tolist() == [[0.01, 0.001, 0.02]]
    assert (world.landmark_ids.tolist(), world.landmarks.tolist()) == ([3], [[2.0, 2.0]])
    assert any("EDGE_RANGE: 1 line not used" in note for note in world.notes)
    with pytest.raises(DatasetError, match="2 robots are in it, 1 asked for"):
        streams(tmp_path / "graph.txt")


def drive(poses: int = 60, landmarks: int = 12, noise: float = 1.0) -> str:
    rng = np.random.default_rng(3)
    places = rng.uniform(-12.0, 12.0, (landmarks, 2))
    step, pose, lines = np.array([1.0, 0.0, 0.15]), np.zeros(3), []
    for k in range(poses):
        for i, place in enumerate(places):
            seen = between(pose, np.array([*place, 0.0]))[:2]
            if np.hypot(*seen) < 9.0:
                lines.append(f"LANDMARK {k} {i} {seen[0]:.9f} {seen[1]:.9f} 10 0 10")
        noisy = step + noise * rng.normal(0.0, [0.02, 0.02, 0.005])
        lines.append(f"ODOMETRY {k} {k + 1} {' '.join(map(str, noisy))} 50 0 0 50 0 200")
        pose = compose(pose, step)
    return "\n".join(lines)


def test_pieces_know_the_first_start_alone_and_keep_every_measurement(tmp_path):
    path = written(tmp_path, drive())
    (whole,) = streams(path).streams
    parts = streams(path, 3).streams
    assert [part.start is None for part in parts] == [False, True, True]
    assert sum(len(p.landmark_detections.ids) for p in parts) == len(whole.landmark_detections.ids)
    scenario = with_world(
        with_options(load("graph"), dataset=path, robots=3), unknown_starts=("*",)
    )
    assert all(part.start is None for part in streams_of(scenario).streams)
    assert len(streams(path, duration_s=20.0).streams[0].intervals.end_ns) == 20
    with pytest.raises(DatasetError, match="60 odometry edges can not be cut into 61"):
        streams(path, 61)


@pytest.mark.parametrize("robots", [1, 2])
def test_a_team_maps_a_graph(tmp_path, robots):
    path = written(tmp_path, drive())
    written(tmp_path, drive(noise=0.0), "graph_groundtruth.txt")
    scenario = with_options(load("graph"), dataset=path, robots=robots)
    joined = evaluate(run_team(final_only(scenario), streams_of(scenario))).map
    assert len(joined.ids) == len(read_graph(path).landmarks)
    assert joined.errors.rmse_m < 0.2


@pytest.mark.parametrize(
    ("line", "defect"),
    [
        ("EDGE2 1 2 1 0 0 50 0 0 20 0", "10 words after EDGE2, 11 expected"),
        ("EDGE2 1 2 one 0 0 50 0 0 20 0 100", "not a number in it"),
        ("EDGE2 1 2 nan 0 0 50 0 0 20 0 100", "not finite"),
        ("EDGE2 1 x 1 0 0 50 0 0 20 0 100", "'x' is no number of a vertex"),
        ("EDGE2 1 2 1 0 0 50 0 0 0 0 100", "not positive definite"),
        ("EDGE3 1 2 1 0 0 0 0 0", "three dimensions"),
        ("some words", "no keyword 'some'"),
    ],
)
def test_a_malformed_line_is_named_with_its_remedy(tmp_path, line, defect):
    path = written(tmp_path, ISAM.replace("EDGE2 1 2 1 0 0 50 0 0 20 0 100", line))
    done = CliRunner().invoke(app, ["launch", "--dataset", str(path), "-o", str(tmp_path / "run")])
    status, text = _advice(done.exception)
    assert status == 2
    assert "graph.txt, line 4" in text
    assert defect in text


def test_import_writes_tables_of_a_graph(tmp_path):
    path = written(tmp_path, drive())
    out = tmp_path / "set"
    done = CliRunner().invoke(app, ["import", str(path), "-o", str(out)])
    assert done.exit_code == 0, done.output
    scenario = with_options(load(scenario_beside(out)), dataset=out)
    (again,), (whole,) = streams_of(scenario).streams, streams(path).streams
    assert np.array_equal(again.landmark_detections.points, whole.landmark_detections.points)
    assert np.allclose(again.intervals.covariances, whole.intervals.covariances)
