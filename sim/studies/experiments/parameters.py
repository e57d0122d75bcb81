"""Describe runs' parameters by their differences from a built-in scenario."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import msgspec

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments.task import Task

IN_THE_LABEL = frozenset({"name", "team", "seed", "estimator", "fusion", "robots.id"})
"""Parameters in the run's label, or different for every robot."""
COPIES = frozenset({"robots.seed", "robots.estimator", "robots.fusion", "central.fusion"})


def kinds_of(tasks: Sequence[Task]) -> list[tuple[str, int, str]]:
    """Label, number and parameters of runs that differ only in seed."""
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
