"""The interface of an experiment: options, tasks, results, outcome."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from teamslam.sim.studies.experiments.task import Task

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
