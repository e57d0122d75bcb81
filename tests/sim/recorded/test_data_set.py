"""Commands that take a log take a data set, whose run they compute in memory."""

import json
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from teamslam.sim.cli.main import app
from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.recorded.data_set import log_or_run
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.scenarios.toml import folder_scenario
from teamslam.team.wire import channels as ch
from tests.sim.logs import scenario


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    team = scenario(robots=2)
    robots = tuple(
        msgspec.structs.replace(
            robot, front_end=msgspec.structs.replace(robot.front_end, particles=20)
        )
        for robot in team.robots
    )
    team = msgspec.structs.replace(team, robots=robots)
    write_folder(streams_of(team), path)
    (path / "scenario.toml").write_text(folder_scenario(team))
    return path


def test_the_run_of_a_data_set_reads_as_a_log_of_it(data_set: Path) -> None:
    run = log_or_run(data_set)
    team = scenario(robots=2)
    assert {sample.key for sample in run.samples([ch.FINAL_MAP])} == {ch.FINAL_MAP.key()}
    assert (
        final_map(list(run.samples())).ids == final_map(list(run_team(team, streams_of(team)))).ids
    )


def test_a_data_set_is_rerun_under_other_conditions(data_set: Path, tmp_path: Path) -> None:
    to = tmp_path / "figures.json"
    arguments = ["rerun", str(data_set), "--delay", "2", "--json", str(to)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "final map: the same bytes" in result.output
    assert json.loads(to.read_text())["same_final_map"]


def test_a_data_set_without_changes_is_computed_once_and_told_with_its_notes(
    data_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "teamslam.sim.recorded.changed_run.changed_run", None
    )  # a second run would call it
    (data_set / "r2" / "truth.csv").unlink()
    result = CliRunner().invoke(app, ["rerun", str(data_set)])
    assert result.exit_code == 0, result.output
    assert "computed" in result.output
    assert "recorded" not in result.output
    assert "note: r2: no truth.csv" in result.output
