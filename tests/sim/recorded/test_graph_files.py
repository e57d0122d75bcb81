import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.datasets.graph import read_graph, read_pyfg
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import folder_scenario
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.recording.reader import open_log
from teamslam.team.recording.recorder import Recorder
from tests.commands import output_of, run
from tests.scenarios import with_front_ends
from tests.sim.logs import scenario, streams


def between(a, b):
    c, s = np.cos(a[2]), np.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return np.array([c * dx + s * dy, c * dy - s * dx, b[2] - a[2]])


def whitened(residual, upper):
    n = len(residual)
    information = np.zeros((n, n))
    information[np.triu_indices(n)] = upper
    information += np.triu(information, 1).T
    return np.linalg.cholesky(information).T @ residual


def solved(text):
    vertices, edges, fixed = {}, [], set()
    for line in text.splitlines():
        kind, *words = line.split()
        if kind.startswith("VERTEX"):
            vertices[int(words[0])] = np.array(words[1:], float)
        elif kind.startswith("EDGE"):
            n = 3 if kind == "EDGE_SE2" else 2
            numbers = np.array(words[2:], float)
            edges.append((int(words[0]), int(words[1]), numbers[:n], numbers[n:]))
        elif kind == "FIX":
            fixed.add(int(words[0]))
    free = [v for v in vertices if v not in fixed]
    at = np.cumsum([0, *(len(vertices[v]) for v in free)])

    def of(x):
        return vertices | {v: x[a:b] for v, a, b in zip(free, at, at[1:], strict=False)}

    def residuals(x):
        state, out = of(x), []
        for i, j, measured, upper in edges:
            a, b = state[i], state[j]
            seen = between(a, b if len(b) == 3 else np.append(b, a[2]))
            if len(b) == 3:
                off = between(measured, seen)
                off[2] = np.arctan2(np.sin(off[2]), np.cos(off[2]))
            else:
                off = seen[:2] - measured
            out.append(whitened(off, upper))
        return np.concatenate(out)

    found = least_squares(residuals, np.concatenate([vertices[v] for v in free]), ftol=1e-6)
    return of(found.x)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    of = scenario()
    path = tmp_path_factory.mktemp("g2o") / "log.mcap"
    with Recorder(path, "small", {}) as recorder:
        recorder.write(run_team(of, streams(of)))
    return path


def exported(log: Path, folder: Path, form: str) -> str:
    output_of("log", "export", log, "-o", folder, "--format", form)
    return (folder / f"graph.{form}").read_text()


def test_another_optimiser_finds_the_map_from_the_file(log, tmp_path):
    joined = evaluate(open_log(log).samples()).map
    found = solved(exported(log, tmp_path / "out", "g2o"))
    landmarks = np.array([found[k] for k in joined.ids.tolist()])
    sigma = np.sqrt(np.diag(joined.covariance)).reshape(-1, 2)
    assert np.abs((landmarks - joined.means) / sigma).max() < 1.5
    assert np.abs(landmarks - joined.means).max() > 0.0


def test_every_format_holds_the_same_edges(log, tmp_path):
    exported(log, tmp_path / "g2o", "g2o")
    exported(log, tmp_path / "pyfg", "pyfg")
    isam = ["log", "export", str(log), "-o", str(tmp_path / "isam"), "--format", "isam"]
    assert run(*isam).exit_code == 0
    g2o = read_graph(tmp_path / "g2o" / "graph.g2o")
    pyfg = read_pyfg(tmp_path / "pyfg" / "graph.pyfg")
    isams = [read_graph(path) for path in sorted((tmp_path / "isam").glob("*.txt"))]
    assert len(g2o.robots) == len(pyfg.robots) == len(isams) == len(scenario().robots)
    points = [edge for graph in isams for edge in graph.point_edges]
    assert len(g2o.point_edges) == len(points) > 0
    for one, other, third in zip(g2o.point_edges, pyfg.point_edges, points, strict=True):
        assert one.landmark == other.landmark == third.landmark
        assert np.allclose(one.point, other.point)
        assert np.allclose(one.covariance, other.covariance)
        assert np.allclose(one.covariance, third.covariance)
    motions = [edge for graph in isams for edge in graph.pose_edges]
    for edges in zip(g2o.pose_edges, pyfg.pose_edges, motions, strict=True):
        for other in edges[1:]:
            assert np.allclose(edges[0].motion, other.motion)
            assert np.allclose(edges[0].covariance, other.covariance)
    truth = evaluate(open_log(log).samples()).map
    shown = dict(zip(truth.ids.tolist(), truth.truth, strict=True))
    assert all(np.allclose(pyfg.landmarks[i], shown[i]) for i in pyfg.landmarks)


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    path = tmp_path_factory.mktemp("data")
    team = with_front_ends(scenario(robots=2), particles=20)
    write_folder(streams_of(team), path)
    (path / "scenario.toml").write_text(folder_scenario(team))
    return path


def test_a_data_set_is_rerun_under_other_conditions(data_set, tmp_path):
    to = tmp_path / "figures.json"
    arguments = ["rerun", str(data_set), "--delay", "2", "--json", str(to)]
    result = output_of(*arguments)
    assert "final map: the same bytes" in result
    assert " unchanged " in result.splitlines()[1]
    assert json.loads(to.read_text())["same_final_map"]
