import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.studies.experiments import runner
from teamslam.sim.studies.experiments.cases import Cases, Done
from teamslam.sim.studies.experiments.catalogue import Entry
from teamslam.sim.studies.experiments.experiment import (
    Options,
    Outcome,
    Results,
    Table,
    Task,
    runs_of,
)
from teamslam.sim.studies.experiments.runner import FAILURES, Plan, compute_outcomes
from teamslam.sim.studies.experiments.team_runs import team_run, team_task
from tests.commands import output_of
from tests.scenarios import with_world

WORK = "json:loads"  # a function that a process imports at once


def counted(rmse: float) -> Task:
    return Task(WORK, {"s": json.dumps({"rmse": rmse})}, f"run {rmse}")


def short(steps: int) -> Scenario:
    scenario = load("thesis")
    return with_world(scenario, steps=steps)


@pytest.mark.parametrize("estimator", ["localisation", "ekf-slam"])
def test_a_team_that_fuses_nothing_has_the_figures_of_its_robots(estimator):
    scenario = with_options(short(20), estimator=estimator, fusion="alone")
    figures = team_run(msgspec.to_builtins(scenario), batch=False)
    assert figures["final_map_sha256"] is not None, "it came to its end"
    assert figures["each_once"]
    assert 0.1 < figures["online_pose_nees"] < 5.0
    unmapped = estimator == "localisation"
    assert [figures[name] is None for name in ("rmse", "nees", "in_band")] == [unmapped] * 3


class Mean:
    def __init__(self, *tasks: Task) -> None:
        self._tasks = list(tasks)

    def outcome(self, _: Options, results: Results) -> Outcome:
        return Outcome("means", {"means": [r["rmse"] for r in results.of_all(self._tasks)]})


def plan(*tasks: Task) -> Plan:
    entry, options, mean = Entry("means", "", "Means."), Options((1,)), Mean(*tasks)
    return Plan(entry, options, mean, runs_of(mean, options))


@contextmanager
def silent(tasks: Sequence[Task], kept: int) -> Iterator[Callable[[Done], None]]:
    yield lambda _: None


def test_a_run_in_a_worker_gives_the_bits_of_a_run_here(tmp_path):
    task = team_task(short(24))
    (done,) = Cases(tmp_path).run([task], 1)
    here = team_run(**task.parameters)
    assert done.result["final_map_sha256"] == here["final_map_sha256"]
    assert done.result["rmse"] == here["rmse"]


def test_a_run_that_fails_or_whose_process_dies_loses_only_itself(tmp_path):
    wrong = Task(WORK, {"no_such": 1}, "wrong")
    dead = Task("os:_exit", {"status": 3}, "dead")
    good = [counted(1.0), counted(5.0)]
    (concluded,) = compute_outcomes([plan(wrong, dead, *good)], tmp_path, 1, silent)
    assert concluded.outcome.figures["means"] == [1.0, 5.0]
    assert "TypeError" in concluded.failed["wrong"]
    assert concluded.failed["dead"].startswith("its process died: ")
    assert "EXIT(3)" in concluded.failed["dead"]
    assert "Traceback" in (tmp_path / FAILURES).read_text()


def test_what_was_kept_is_not_computed_again_and_a_failed_run_is(tmp_path):
    compute_outcomes(
        [plan(counted(1.0), Task("os:_exit", {"status": 3}, "dead"))], tmp_path, 1, silent
    )
    asked: list[Task] = []

    @contextmanager
    def watched(tasks: Sequence[Task], kept: int) -> Iterator[Callable[[Done], None]]:
        asked.extend(tasks)
        assert kept == 1
        yield lambda _: None

    again = plan(counted(1.0), counted(2.0), Task("os:_exit", {"status": 3}, "dead"))
    (concluded,) = compute_outcomes([again], tmp_path, 2, watched)
    assert {task.label for task in asked} == {"run 2.0", "dead"}
    assert concluded.outcome.figures["means"] == [1.0, 2.0]


class Choosy:
    def outcome(self, _: Options, results: Results) -> Outcome:
        first = results.of(counted(1.0))
        return Outcome("choosy", {"second": first and results.of(counted(2.0))})


def test_an_outcome_that_asks_for_a_run_only_after_another_is_refused(tmp_path):
    options = Options((1,))
    runs = runs_of(Choosy(), options)
    assert [run.label for run in runs] == ["run 1.0"]
    hasty = Plan(Entry("choosy", "", "Choosy."), options, Choosy(), runs)
    with pytest.raises(AssertionError, match=r"run 2\.0"):
        compute_outcomes([hasty], tmp_path, 1, silent)


def test_a_result_of_another_program_does_not_count(tmp_path, monkeypatch):
    list(Cases(tmp_path / "before").run([counted(1.0)], 1))  # its worker may compute the next one
    assert Cases(tmp_path).found(counted(1.0)) is None
    (done,) = Cases(tmp_path).run([counted(1.0)], 1)
    assert done.result == {"rmse": 1.0}
    assert Cases(tmp_path).found(counted(1.0)) == {"rmse": 1.0}
    assert Cases(tmp_path).found(counted(2.0)) is None
    monkeypatch.setattr(
        "teamslam.sim.studies.experiments.experiment.program_of", lambda _: "0" * 16
    )
    assert Cases(tmp_path).found(counted(1.0)) is None


def task(value: float, cost: float = 1.0) -> Task:
    return Task("json:loads", {"s": json.dumps({"rmse": value})}, f"run {value}", cost)


class Values:
    def outcome(self, options: Options, results: Results) -> Outcome:
        tasks = [task(seed / 8, 1.0 + seed) for seed in options.seeds]
        found = [run["rmse"] for run in results.of_all(tasks)]
        return Outcome("values", {"values": found}, (Table("t", ("v",), ((str(found),),)),))


@pytest.fixture(autouse=True)
def _values_instead_of_filters(monkeypatch):
    def planned(entry: Entry, options: Options) -> Plan:
        return Plan(entry, options, Values(), runs_of(Values(), options))

    monkeypatch.setattr(runner, "plan_runs", planned)


def written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("xu-4.4*")}


def experiment(*words: object) -> str:
    return output_of("experiment", *words)


def test_merged_shards_are_the_whole_byte_for_byte(tmp_path):
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


@pytest.mark.parametrize("text", ["0/3", "4/3", "2", "a/b", "1/0"])
def test_a_shard_is_a_number_of_a_number(text):
    refused = output_of("experiment", "xu-4.4", "--shard", text, status=2)
    assert "as 2/8" in refused
