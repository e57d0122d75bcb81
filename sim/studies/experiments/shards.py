"""Shards of a study, and their merge."""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from teamslam.sim.studies.experiments.cases import FOLDER
from teamslam.sim.studies.experiments.task import Task

DESCRIPTION = "shard.json"
"""File in a shard's folder: study, number, and digests of its program."""


class ShardError(ValueError):
    """Shards that are not one study."""


@dataclass(frozen=True)
class Shard:
    """Shard `number` of `of`, from 1."""

    number: int
    of: int


@dataclass(frozen=True, kw_only=True)
class Study:
    """An experiment's name and the options that determine its runs."""

    name: str
    seeds: int | None
    first: int
    quick: bool
    datasets: Sequence[str]


def parsed_shard(text: str) -> Shard:
    """Parse `I/N`; raises ShardError."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise ShardError(f"--shard {text}: give the shard and their number, as 2/8")
    return Shard(int(found[1]), int(found[2]))


def tasks_of(tasks: Mapping[str, Task], shard: Shard) -> dict[str, Task]:
    """Every N-th task by falling cost, for shards of equal time."""
    order = sorted(tasks.values(), key=lambda task: (-task.cost, task.name))
    return {task.name: task for task in order[shard.number - 1 :: shard.of]}


def programs_of(tasks: Sequence[Task]) -> dict[str, str]:
    """Digest of the program of each kind of task."""
    return {task.work: task.program for task in {task.work: task for task in tasks}.values()}


def write_shard(folder: Path, shard: Shard, study: Study, programs: Mapping[str, str]) -> None:
    """Describe the shard in its folder."""
    content = {
        "experiment": study.name,
        "seeds": study.seeds,
        "first": study.first,
        "quick": study.quick,
        "datasets": list(study.datasets),
        "program": dict(sorted(programs.items())),
        "of": shard.of,
        "shard": shard.number,
    }
    (folder / DESCRIPTION).write_text(json.dumps(content, indent=1) + "\n", "utf-8")


def study_of(folders: Sequence[Path]) -> tuple[Study, dict[str, str]]:
    """Study of these shards and its program; raises ShardError unless complete."""
    described = {folder: _description(folder) for folder in folders}
    numbers = {folder: int(each.pop("shard")) for folder, each in described.items()}
    first, common = next(iter(described.items()))
    for folder, each in described.items():
        differing = [name for name, value in each.items() if value != common.get(name)]
        if differing:
            raise ShardError(
                f"{folder} and {first} are not of one study: they differ in {', '.join(differing)}"
            )
    lacking = [str(k) for k in range(1, common["of"] + 1) if k not in numbers.values()]
    if lacking:
        raise ShardError(f"shard {', '.join(lacking)} of {common['of']} is not among the folders")
    study = Study(
        name=common["experiment"],
        seeds=common["seeds"],
        first=common["first"],
        quick=common["quick"],
        datasets=common["datasets"],
    )
    return study, common["program"]


def collect_results(folders: Sequence[Path], output: Path) -> None:
    """Copy the shards' stored results into one folder."""
    for folder in folders:
        if (folder / FOLDER).is_dir():
            shutil.copytree(folder / FOLDER, output / FOLDER, dirs_exist_ok=True)


def _description(folder: Path) -> dict[str, Any]:
    file = folder / DESCRIPTION
    try:
        content: dict[str, Any] = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        raise ShardError(
            f"{folder} is no finished shard: `teamslam experiment NAME --shard I/N -o {folder}` "
            f"writes {DESCRIPTION} at its end"
        ) from None
    return content
