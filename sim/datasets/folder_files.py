"""Locate robots' tables in a folder or zip."""

import re
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from teamslam.sim.datasets.tables import DatasetError, File, open_place
from teamslam.team.keys.roster import ROBOT

ROBOT_NAME = ROBOT.pattern
STREAM_FILES = ("odometry.csv", "observations.csv")  # files that mark a robot's folder
DETECTIONS = "detections.csv"  # a robot's detections without identities
ONE_ROBOT = "r1"  # name of a robot with tables in the data set's own folder
SCENARIO = "scenario.toml"
EXPECTED = (
    "expected a folder with a sub-folder for each robot, named as in r1, with odometry.csv and "
    "observations.csv (docs/your_data.md)"
)


class _NoTablesError(DatasetError):
    """No robot's table."""


@contextmanager
def open_folder(path: str) -> Iterator[tuple[File, Mapping[str, File]]]:
    """Open the folder, and each robot's by name; raises DatasetError."""
    with open_place(path, EXPECTED, _NoTablesError) as root:
        inner = root if isinstance(root, Path) else _root(root)
        yield inner, _robots_in(inner, path)


def _root(archive: zipfile.Path) -> zipfile.Path:
    entries = list(archive.iterdir())
    return entries[0] if len(entries) == 1 and entries[0].is_dir() else archive


def scenario_in(path: str | Path) -> File | None:
    """Scenario in a folder or zip."""
    place: File = Path(path)
    if not place.is_dir():
        place = _root(zipfile.Path(path))
    own = place / SCENARIO
    return own if own.is_file() else None


def has_tables(path: str | Path) -> bool:
    """Whether robots' tables are at an existing path; raises DatasetError."""
    try:
        with open_folder(str(path)):
            return True
    except (_NoTablesError, OSError):
        return False


def has_detections(path: str) -> bool:
    """Whether a robot has detections without identities; False for an unreadable folder."""
    if not path:
        return False
    with suppress(DatasetError, OSError), open_folder(path) as (_, robots):
        return any((place / DETECTIONS).is_file() for place in robots.values())
    return False


def robots_of(path: str) -> tuple[str, ...]:
    """Robots of a folder, r2 before r10; raises DatasetError."""
    with open_folder(path) as (_, robots):
        return tuple(robots)


def _robots_in(root: File, path: str) -> Mapping[str, File]:
    if any((root / name).is_file() for name in STREAM_FILES):
        return {ONE_ROBOT: root}
    entries: dict[str, File] = {entry.name: entry for entry in root.iterdir()}
    found = {
        name: entry
        for name, entry in entries.items()
        if entry.is_dir() and any((entry / each).is_file() for each in STREAM_FILES)
    }
    if not found:
        raise _NoTablesError(f"{path}: no robot in it; {EXPECTED}")
    for name in found:
        if not re.fullmatch(ROBOT_NAME, name):
            raise DatasetError(
                f"{path}: the folder {name!r} can not be a robot's name: a small letter, then "
                "small letters, digits and _ (32 at most); rename it"
            )
    return {name: found[name] for name in sorted(found, key=_natural)}


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def name_table(place: File, file: File, robot: str) -> str:
    """Name of a table for errors."""
    return f"{robot}/{file.name}" if place.name == robot else file.name


def stray_tables(place: File, tables: Collection[str]) -> list[str]:
    """Names of CSV files in a folder that are no table of these kinds."""
    known = {f"{each}.csv" for each in (*tables, "detections", "labels")}
    names = (each.name for each in place.iterdir())
    return sorted(each for each in names if each.lower().endswith(".csv") and each not in known)


def unused_files(root: File, folders: Mapping[str, File], tables: Collection[str]) -> list[str]:
    """Describe CSV files and folders that are not read."""
    notes = []
    for place in dict.fromkeys([root, *folders.values()]):
        strays = stray_tables(place, tables)
        if strays:
            inside = f"{place.name}: " if place != root else ""
            notes.append(
                f"{inside}{', '.join(strays)} not read: tables are called "
                f"{', '.join(f'{each}.csv' for each in tables)}"
            )
    if root in folders.values():
        return notes
    entries: list[File] = sorted(root.iterdir(), key=lambda each: each.name)
    lacking = [
        entry
        for entry in entries
        if entry.is_dir()
        and entry.name not in folders
        and any(each.name.endswith(".csv") for each in entry.iterdir())
    ]
    return notes + [
        f"{entry.name}: neither {' nor '.join(STREAM_FILES)} in it: left out" for entry in lacking
    ]
