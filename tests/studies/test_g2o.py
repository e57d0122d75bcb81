"""The batch problem as a g2o file: an independent optimiser finds the same map."""

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from typer.testing import CliRunner

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.cli.main import app
from teamslam.sim.in_memory.team import run_team
from teamslam.team.recording.recorder import Recorder
from tests.sim.logs import scenario, streams, world_log


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
    """Every vertex of the file at the optimum of its edges."""
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
def log(tmp_path_factory) -> Path:
    of = scenario()
    path = tmp_path_factory.mktemp("g2o") / "log.mcap"
    with Recorder(path, "small", {}) as recorder:
        recorder.write(run_team(of, streams(of)))
    return path


def test_another_optimiser_finds_the_map_from_the_file(log: Path, tmp_path: Path) -> None:
    file = tmp_path / "problem.g2o"
    done = CliRunner().invoke(app, ["batch-reference", str(log), "--g2o", str(file)])
    assert done.exit_code == 0, done.output
    from teamslam.team.recording.reader import open_log

    joined = evaluate(open_log(log).samples()).map
    assert joined is not None
    found = solved(file.read_text())
    landmarks = np.array([found[k] for k in range(len(joined.ids))])
    sigma = np.sqrt(np.diag(joined.covariance)).reshape(-1, 2)
    assert np.abs((landmarks - joined.means) / sigma).max() < 1.5
    assert np.abs(landmarks - joined.means).max() > 0.0


def test_a_log_without_a_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with Recorder(path, "small", {}) as recorder:
        recorder.write(world_log(scenario()))
    done = CliRunner().invoke(app, ["batch-reference", str(path), "--g2o", str(tmp_path / "x")])
    assert (done.exit_code, "no final map" in done.output) == (1, True)
