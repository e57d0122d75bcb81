"""`teamslam compare`: runs side by side."""

import json
from pathlib import Path

from typer.testing import CliRunner

from teamslam.sim.cli.main import app
from teamslam.team.recording.recorder import Recorder
from tests.sim.logs import joined_log, scenario


def written(path: Path, deviation: float) -> Path:
    path.parent.mkdir(parents=True)
    with Recorder(path, "small", {}) as recorder:
        recorder.write(joined_log(scenario(robots=2), deviation))
    return path


def test_two_runs_stand_side_by_side(tmp_path: Path) -> None:
    near, far = (tmp_path / name / "log.mcap" for name in ("near", "far"))
    written(near, 0.05)
    written(far, 0.2)
    picture, figures = tmp_path / "both.svg", tmp_path / "both.json"
    done = CliRunner().invoke(
        app, ["compare", str(near.parent), str(far), "-o", str(picture), "--json", str(figures)]
    )
    assert done.exit_code == 0, done.output
    told = json.loads(figures.read_text())
    assert float(told["near"]["landmark RMSE [m]"]) < float(told["far"]["landmark RMSE [m]"])
    assert "near" in done.stdout
    assert "<svg" in picture.read_text()


def test_one_run_and_a_picture_of_no_kind_are_refused(tmp_path: Path) -> None:
    alone = CliRunner().invoke(app, ["compare", "a"])
    assert (alone.exit_code, "two or more" in alone.output) == (2, True)
    wrong = CliRunner().invoke(app, ["compare", "a", "b", "-o", str(tmp_path / "x.jpeg")])
    assert (wrong.exit_code, ".svg" in wrong.output) == (2, True)
