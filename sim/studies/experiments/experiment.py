"""What an experiment is asked, what it answers, and the protocol between the two."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from sim.studies.experiments.task import Task

UTIAS_SOURCE = (
    "the UTIAS Multi-Robot Cooperative Localization and Mapping data set (MRCLAM; Leung, Halpern, "
    "Barfoot, Liu, IJRR 30(8):969-974, 2011), which its authors give to everybody"
)


@dataclass(frozen=True)
class Dataset:
    """A data set that the user gave; sha256 of its file, or of all files of its folder."""

    name: str
    path: Path
    sha256: str


@dataclass(frozen=True)
class Options:
    """What the command line asks for: the seeds, small or full, the data sets."""

    seeds: tuple[int, ...]
    quick: bool = False
    datasets: tuple[Dataset, ...] = ()


@dataclass(frozen=True)
class Results:
    """The results of the runs by the tasks' names; a run that failed is not among them."""

    by_name: Mapping[str, dict[str, Any]]

    def of(self, task: Task) -> dict[str, Any] | None:
        """The result of one task; None if it failed."""
        return self.by_name.get(task.name)

    def of_all(self, tasks: Sequence[Task]) -> list[dict[str, Any]]:
        """The results that there are, in the order of the tasks."""
        return [self.by_name[task.name] for task in tasks if task.name in self.by_name]


@dataclass(frozen=True)
class Table:
    """A table as text; the first column is the row's name. note: what a reader must know."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture: its file's name without suffix, what it shows, and what draws it as a PNG."""

    name: str
    caption: str
    draw: Callable[[Path], None]


@dataclass(frozen=True)
class Goal:
    """What a figure must be; value None: it could not be computed."""

    figure: str
    value: float | None
    least: float
    most: float

    @property
    def passed(self) -> bool | None:
        """Whether it is reached; None where there is no value."""
        if self.value is None:
            return None
        return isfinite(self.value) and self.least <= self.value <= self.most


@dataclass(frozen=True)
class Outcome:
    """What an experiment found.

    figures: for machines, by name. remarks: what differs from the source and why. missing: what
    could not be computed, and what to do about it.
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
    """What a module of an experiment has."""

    def tasks(self, options: Options) -> list[Task]:
        """The runs, each once."""

    def outcome(self, options: Options, results: Results) -> Outcome:
        """What comes of them."""


def combined(title: str, parts: Sequence[Outcome]) -> Outcome:
    """Several outcomes as one, in their order; their figures differ in name."""
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
    """The line for `Outcome.missing` of what needs a UTIAS data set."""
    return (
        f"{what}: give the sets with --dataset MRCLAM_Dataset1.zip --dataset …; they are of "
        f"{UTIAS_SOURCE}"
    )
