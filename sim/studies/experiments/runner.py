"""Load stored results of an experiment, compute the others, conclude."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec

from teamslam.sim.datasets.tables import open_data_set
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments.catalogue import Entry
from teamslam.sim.studies.experiments.experiment import (
    Dataset,
    Experiment,
    Options,
    Outcome,
    Results,
    Task,
    runs_of,
)

if TYPE_CHECKING:  # joblib, which is not a part of every install
    from teamslam.sim.studies.experiments.cases import Done

IN_THE_LABEL = frozenset({"name", "team", "seed", "estimator", "fusion", "robots.id"})
"""Parameters in the run's label, or different for every robot."""
COPIES = frozenset({"robots.seed", "robots.estimator", "robots.fusion", "central.fusion"})


def _kinds_of(tasks: Sequence[Task]) -> list[tuple[str, int, str]]:
    """Label, number and parameters of runs that differ in seed only."""
    found: dict[tuple[str, str], int] = {}
    for task in tasks:
        label = task.label.rpartition(", seed ")[0] or task.label
        kind = label, "; ".join(_parameters(task))
        found[kind] = found.get(kind, 0) + 1
    return [(label, count, parameters) for (label, parameters), count in found.items()]


def _parameters(task: Task) -> Iterator[str]:
    yield task.work.rpartition(".")[2]
    for name, value in task.parameters.items():
        if isinstance(value, Mapping) and "robots" in value:
            changes = ", ".join(_differences(value)) or "as it is"
            yield f"{name}: {value['name']}, {changes}"
        else:
            yield f"{name} = {json.dumps(value, ensure_ascii=False)}"


def _differences(scenario: Mapping[str, Any]) -> Iterator[str]:
    before = _built_in(scenario["name"], len(scenario["robots"]))
    for path, value in _flat(scenario, ""):
        if path not in IN_THE_LABEL | COPIES and before.get(path) != value:
            yield f"{path} = {value}"


@cache
def _built_in(name: str, robots: int) -> Mapping[str, str]:
    return dict(_flat(msgspec.to_builtins(with_options(load(name), robots=robots)), ""))


def _flat(value: Any, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for name, each in value.items():
            yield from _flat(each, f"{path}.{name}" if path else name)
    elif path == "robots":
        leaves: dict[str, list[str]] = {}
        for robot in value:
            for name, leaf in _flat(robot, path):
                leaves.setdefault(name, []).append(leaf)
        for name, of_robots in leaves.items():
            yield name, " | ".join(dict.fromkeys(of_robots))
    else:
        yield path, f"{value:.6g}" if isinstance(value, float) else json.dumps(value)


FAILURES = "failures.txt"  # file with the tracebacks of the last command's failed runs


@dataclass(frozen=True)
class Concluded:
    """Outcome, and failed runs with errors. kinds: see `kinds_of`."""

    entry: Entry
    options: Options
    outcome: Outcome
    runs: int
    failed: Mapping[str, str] = field(default_factory=dict)
    kinds: Sequence[tuple[str, int, str]] = ()


@dataclass(frozen=True)
class Plan:
    """An experiment, its options, and its tasks."""

    entry: Entry
    options: Options
    experiment: Experiment
    tasks: tuple[Task, ...]


Progress = Callable[[Sequence[Task], int], AbstractContextManager[Callable[["Done"], None]]]
"""Given the tasks and the number of stored results, returns the function to call per finished
task.
"""


def plan_runs(entry: Entry, options: Options) -> Plan:
    """List the experiment's tasks; raises ScenarioError, DatasetError."""
    name, _, attribute = entry.module.partition(":")
    module = import_module(f"teamslam.sim.studies.experiments.{name}")
    experiment = cast(Experiment, getattr(module, attribute) if attribute else module)
    return Plan(entry, options, experiment, runs_of(experiment, options))


def compute_outcomes(
    plans: Sequence[Plan],
    folder: Path,
    jobs: int,
    progress: Progress,
) -> list[Concluded]:
    """Outcomes of all plans; common tasks run once."""
    tasks = tasks_by_name(plans)
    results, failures = compute_runs(tasks, folder, jobs, progress)
    concluded = [_conclude(plan, results, failures) for plan in plans]
    unplanned = [task.label for name, task in results.asked.items() if name not in tasks]
    assert not unplanned, f"asked for only after other runs: {unplanned}"
    return concluded


def tasks_by_name(plans: Sequence[Plan]) -> dict[str, Task]:
    """Tasks of all plans, common ones once."""
    return {task.name: task for plan in plans for task in plan.tasks}


def compute_runs(
    tasks: Mapping[str, Task],
    folder: Path,
    jobs: int,
    progress: Progress,
) -> tuple[Results, Mapping[str, "Done"]]:
    """Results of these tasks, and the failed ones."""
    folder.mkdir(parents=True, exist_ok=True)
    from teamslam.sim.studies.experiments.cases import Cases

    cases = Cases(folder)
    cached = {name: cases.found(task) for name, task in tasks.items()}
    results = {name: result for name, result in cached.items() if result is not None}
    missing = [task for name, task in tasks.items() if name not in results]
    failures: dict[str, Done] = {}
    with progress(missing, len(results)) as tell:
        for done in cases.run(missing, jobs):
            if done.result is None:
                failures[done.task.name] = done
            else:
                results[done.task.name] = done.result
            tell(done)
    _write_failures(folder / FAILURES, list(failures.values()))
    return Results(results), failures


def _conclude(plan: Plan, results: Results, failures: Mapping[str, "Done"]) -> Concluded:
    failed = {task.label: failures[task.name].error for task in plan.tasks if task.name in failures}
    outcome = plan.experiment.outcome(plan.options, results)
    kinds = _kinds_of(plan.tasks)
    return Concluded(plan.entry, plan.options, outcome, len(plan.tasks), failed, kinds)


def _write_failures(path: Path, failures: Sequence["Done"]) -> None:
    path.unlink(missing_ok=True)
    if failures:
        texts = [f"{done.task.label}\n{done.details or done.error}\n" for done in failures]
        path.write_text("\n".join(texts), encoding="utf-8")


def dataset(path: Path) -> Dataset:
    """Data set with its checksum."""
    with open_data_set(str(path), "Barcodes.dat"):
        pass
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    digest = hashlib.sha256()
    for file in files:
        if file is not path:
            digest.update(f"{file.relative_to(path)}\n".encode())
        with file.open("rb") as opened:
            hashlib.file_digest(opened, lambda: digest)
    return Dataset(path.stem if path.is_file() else path.name, path.resolve(), digest.hexdigest())


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
