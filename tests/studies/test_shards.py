"""Shards of an experiment, computed apart and merged."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from teamslam.sim.cli.main import app
from teamslam.sim.studies.experiments import runner
from teamslam.sim.studies.experiments.catalogue import Entry
from teamslam.sim.studies.experiments.experiment import Options, Outcome, Results, Table
from teamslam.sim.studies.experiments.runner import Plan
from teamslam.sim.studies.experiments.shards import Shard, tasks_of
from teamslam.sim.studies.experiments.task import Task

RUN = CliRunner()


def task(value: float, cost: float = 1.0) -> Task:
    return Task("json:loads", {"s": json.dumps({"rmse": value})}, f"run {value}", cost)


class Values:
    """An experiment whose runs return their parameter."""

    def tasks(self, options: Options) -> list[Task]:
        return [task(seed / 8, 1.0 + seed) for seed in options.seeds]

    def outcome(self, options: Options, results: Results) -> Outcome:
        found = [results.of(each)["rmse"] for each in self.tasks(options) if results.of(each)]
        return Outcome("values", {"values": found}, (Table("t", ("v",), ((str(found),),)),))


@pytest.fixture(autouse=True)
def _values_instead_of_filters(monkeypatch: pytest.MonkeyPatch) -> None:
    def planned(entry: Entry, options: Options) -> Plan:
        experiment = Values()
        return Plan(entry, options, experiment, tuple(experiment.tasks(options)))

    monkeypatch.setattr(runner, "planned", planned)


def written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("xu-4.4*")}


def experiment(*words: object) -> str:
    done = RUN.invoke(app, ["experiment", *map(str, words)])
    assert done.exit_code == 0, done.output
    return done.output


def test_merged_shards_are_the_whole_byte_for_byte(tmp_path: Path) -> None:
    options = ("xu-4.4", "--seeds", 7, "--first", 3, "--jobs", 1)
    experiment(*options, "-o", tmp_path / "whole")
    shards = [tmp_path / f"shard-{k}" for k in (1, 2, 3)]
    for k, folder in enumerate(shards, 1):
        said = experiment(*options, "-o", folder, "--shard", f"{k}/3")
        assert f"{3 if k == 1 else 2} of 7 runs" in said
        assert written(folder) == {}, "a part has no page"
    experiment("merge", *reversed(shards), "-o", tmp_path / "merged", "--jobs", 1)
    whole = written(tmp_path / "whole")
    assert {*whole} == {"xu-4.4.html", "xu-4.4.json"}
    assert written(tmp_path / "merged") == whole
    assert json.loads(whole["xu-4.4.json"])["values"] == [k / 8 for k in range(3, 10)]


def test_shards_that_are_not_all_or_not_of_one_study_are_refused(tmp_path: Path) -> None:
    def shard(k: int, seeds: int) -> Path:
        folder = tmp_path / f"{k}-{seeds}"
        experiment("xu-4.4", "--seeds", seeds, "--jobs", 1, "--shard", f"{k}/2", "-o", folder)
        return folder

    first, other = shard(1, 2), shard(2, 3)
    for folders, said in (
        ([first], "shard 2 of 2 is not among the folders"),
        ([first, other], "they differ in seeds"),
        ([tmp_path], "is no finished shard"),
    ):
        words = [*map(str, folders), "-o", str(tmp_path / "out")]
        refused = RUN.invoke(app, ["experiment", "merge", *words])
        assert refused.exit_code == 2
        assert said in " ".join(refused.output.split())
    file = first / "shard.json"
    file.write_text(file.read_text().replace('"json:loads": "', '"json:loads": "0'))
    second = shard(2, 2)
    file = second / "shard.json"
    file.write_text(file.read_text().replace('"json:loads": "', '"json:loads": "0'))
    words = [str(first), str(second), "-o", str(tmp_path / "out")]
    refused = RUN.invoke(app, ["experiment", "merge", *words])
    assert refused.exit_code == 2
    assert "another version of the program" in refused.output


@pytest.mark.parametrize("text", ["0/3", "4/3", "2", "a/b", "1/0"])
def test_a_shard_is_a_number_of_a_number(text: str) -> None:
    refused = RUN.invoke(app, ["experiment", "xu-4.4", "--shard", text])
    assert refused.exit_code == 2
    assert "as 2/8" in refused.output


def test_every_run_is_in_one_shard_and_long_runs_are_spread() -> None:
    tasks = {each.name: each for each in (task(k, float(k)) for k in range(10))}
    parts = [tasks_of(tasks, Shard(k, 3)) for k in (1, 2, 3)]
    assert sorted(name for part in parts for name in part) == sorted(tasks)
    assert [max(each.cost for each in part.values()) for part in parts] == [9.0, 8.0, 7.0]
