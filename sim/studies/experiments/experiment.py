"""An experiment: options, tasks, results, outcome.

A task is a function with JSON parameters, and its program's digest.
"""

import ast
import hashlib
import importlib
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from platform import python_version
from typing import Any, Protocol, runtime_checkable

from teamslam.team import core
from teamslam.team.recording.provenance import version

_PLACE = re.compile(r"^([a-z_][\w.]*):[A-Za-z_]\w*$")
"""A name in a table of `teamslam.team.registry`."""


def _sources_of(module: str, packages: tuple[str, ...]) -> dict[str, bytes]:
    """Text of a module and of all that it imports of these packages.

    Names in tables (`teamslam.team.registry`) count as imports.
    """
    found: dict[str, bytes] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] not in packages:
            continue
        path = _path(name)
        if path is None:
            continue
        found[name] = path.read_bytes()
        waiting.append(name.rpartition(".")[0])
        waiting += _imported(found[name])
    return found


@lru_cache
def _imported(source: bytes) -> tuple[str, ...]:
    """Modules that a source may use: `from a import b` or `a.b:c`."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names += _PLACE.findall(node.value)
    return tuple(names)


@lru_cache
def _path(module: str) -> Path | None:
    if not module:
        return None
    loaded = sys.modules.get(module)
    try:
        spec = find_spec(module) if loaded is None else loaded.__spec__
    except ModuleNotFoundError:
        return None
    if spec is None or not spec.has_location or not str(spec.origin).endswith(".py"):
        return None
    return Path(str(spec.origin))


ROOTS = ("teamslam",)
LIBRARIES = ("numpy", "scipy", "gtsam")  # libraries that results depend on


@dataclass(frozen=True)
class Task:
    """One run. work: `module:function`, from parameters to a JSON object.

    local: arguments without influence on the result. cost: estimated time [s].
    """

    work: str
    parameters: Mapping[str, Any]
    label: str
    cost: float = 1.0
    local: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def name(self) -> str:
        """Digest of function name and parameters."""
        text = json.dumps([self.work, self.parameters], sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def program(self) -> str:
        """Digest of sources and library versions."""
        return program_of(self.work.partition(":")[0])

    def run(self) -> dict[str, Any]:
        """Compute the task in this process."""
        module, _, function = self.work.partition(":")
        work: Callable[..., dict[str, Any]] = getattr(importlib.import_module(module), function)
        return work(**self.parameters, **self.local)


@lru_cache
def program_of(module: str) -> str:
    """Digest of library versions, imported sources, and the native core."""
    digest = hashlib.blake2b(digest_size=8)
    digest.update(f"python {python_version()}\n".encode())
    for library in LIBRARIES:
        digest.update(f"{library} {version(library)}\n".encode())
    for name, source in sorted(_sources_of(module, ROOTS).items()):
        digest.update(f"{name}\n".encode() + source)
    digest.update(core.digest.encode())
    return digest.hexdigest()


UTIAS_SOURCE = (
    "the UTIAS Multi-Robot Cooperative Localization and Mapping data set (MRCLAM; Leung, Halpern, "
    "Barfoot, Liu, IJRR 30(8):969-974, 2011), which its authors give to everybody"
)


@dataclass(frozen=True)
class Dataset:
    """Data set; sha256 of its file, or all files of its folder."""

    name: str
    path: Path
    sha256: str


def seed_count(count: int) -> str:
    """Number with noun: `1 seed`, `3 seeds`."""
    return f"{count} seed{'' if count == 1 else 's'}"


@dataclass(frozen=True)
class Options:
    """Options of the command line."""

    seeds: tuple[int, ...]
    quick: bool = False
    datasets: tuple[Dataset, ...] = ()

    @property
    def seed_count(self) -> str:
        """The number with its noun."""
        return seed_count(len(self.seeds))


@dataclass(frozen=True)
class Results:
    """Results by task name, without failed runs; asked: tasks by name."""

    by_name: Mapping[str, dict[str, Any]]
    asked: dict[str, Task] = field(default_factory=dict)

    def of(self, task: Task) -> dict[str, Any] | None:
        """Result of one task; None if it failed."""
        self.asked[task.name] = task
        return self.by_name.get(task.name)

    def of_all(self, tasks: Sequence[Task]) -> list[dict[str, Any]]:
        """Existing results, in task order."""
        return [result for task in tasks if (result := self.of(task)) is not None]


@dataclass(frozen=True)
class Table:
    """A table as text; the first column names the row."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture: file name without suffix, caption, drawing function."""

    name: str
    caption: str
    draw: Callable[[Path], None]


@dataclass(frozen=True)
class Goal:
    """Bounds of a figure; value None: not computed."""

    figure: str
    value: float | None
    least: float
    most: float

    @property
    def passed(self) -> bool | None:
        """Whether the bounds hold, if there is a value."""
        if self.value is None:
            return None
        return isfinite(self.value) and self.least <= self.value <= self.most


@dataclass(frozen=True)
class Outcome:
    """Result of an experiment.

    remarks: differences from the source. missing: figures that need more data.
    """

    title: str
    figures: Mapping[str, Any]
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    goals: tuple[Goal, ...] = ()
    remarks: tuple[str, ...] = ()
    missing: tuple[str, ...] = field(default=())


@runtime_checkable
class Experiment(Protocol):
    """Interface of an experiment's module."""

    def outcome(self, options: Options, results: Results) -> Outcome:
        """Outcome of the results.

        It asks for the same runs whatever the results are, none at first.
        """


def runs_of(experiment: Experiment, options: Options) -> tuple[Task, ...]:
    """Runs that an outcome asks for."""
    results = Results({})
    experiment.outcome(options, results)
    return tuple(results.asked.values())


def combine_outcomes(title: str, parts: Sequence[Outcome]) -> Outcome:
    """Combine several outcomes with different figures."""
    return Outcome(
        title,
        {name: figure for part in parts for name, figure in part.figures.items()},
        tuple(table for part in parts for table in part.tables),
        tuple(picture for part in parts for picture in part.pictures),
        tuple(goal for part in parts for goal in part.goals),
        tuple(remark for part in parts for remark in part.remarks),
        tuple(text for part in parts for text in part.missing),
    )


def without_datasets(what: str) -> str:
    """Line for `Outcome.missing` about a missing UTIAS data set."""
    return (
        f"{what}: give the sets with --dataset MRCLAM_Dataset1.zip --dataset …; they are of "
        f"{UTIAS_SOURCE}"
    )
