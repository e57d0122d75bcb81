"""Import CSV files with foreign column names, and trajectories."""

import re
from collections.abc import Collection, Mapping, Sequence
from math import atan2
from pathlib import Path
from types import MappingProxyType

import numpy as np

from teamslam.sim.datasets.csv_table import CsvTable, Origin, read_table
from teamslam.sim.datasets.folder_tables import (
    POINT_COVARIANCE,
    POINTS,
    POLAR,
    POLAR_COVARIANCE,
    POSES,
)
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.importing.proposal import MOST_ROBOTS, drop_line, propose_map, proposed_kinds
from teamslam.sim.importing.tables import (
    MEASURED,
    REQUIRED,
    TABLES,
    Map,
    RobotTables,
    Table,
    map_columns,
    names_robot,
)
from teamslam.sim.world.streams import polar_covariances
from teamslam.team.shapes import Float

QUATERNION = 8  # columns of a TUM trajectory: t x y z qx qy qz qw


def read_files(paths: Sequence[Path], *, tum: bool) -> dict[str, CsvTable]:
    """Read one robot's files by name; with `tum` a file in TUM's format is its odometry."""
    files: dict[str, CsvTable] = {}
    for path in paths:
        poses = _tum_table(path)
        name = path.name if poses is None or not tum else "odometry.csv"
        files[name] = read_table(path, str(path)) if poses is None else poses
    if len(files) < len(paths):
        raise DatasetError(
            "two files have the same name, or two are trajectories of TUM: import them for one "
            "robot each"
        )
    return files


def import_files(
    files: Mapping[str, CsvTable],
    chosen: Map,
    robot: str,
    everyones: Collection[str] = (),
    places: Mapping[str, str] = MappingProxyType({}),
) -> tuple[RobotTables, list[str]]:
    """Import one robot's tables by a map; also returns notes; raises DatasetError.

    everyones: file names of all robots; a table whose files only other robots have is omitted.
    places: place of each kind's table in the map. An unused file that is probably an omitted table
    is an error.
    """
    tables = RobotTables(robot)
    notes: list[str] = []
    used: set[str] = set()
    omitted: set[str] = set()
    for kind, table in chosen.items():
        lacking = [each for each in table.files if not any(n.endswith(each) for n in files)]
        if lacking and all(any(n.endswith(each) for n in everyones) for each in lacking):
            notes.append(f"no {', '.join(lacking)}: no {kind}")
            omitted.add(kind)
            continue
        notes += _take(kind, table, files, tables, used, places.get(kind, ""))
    unused = {name: table for name, table in files.items() if name not in used}
    if "odometry" in chosen:
        _refuse_second_robot(chosen["odometry"].files, used, unused)
    if unused and (omitted & proposed_kinds(unused) or (omitted and not used)):
        raise DatasetError(
            f"{robot}: the map names no {' and no '.join(sorted(omitted))} among its files "
            f"{', '.join(files)}. Add its own tables to the map, beginning with this:\n\n"
            + propose_map({robot: unused}, own=True)
        )
    notes += [f"{name}: not used: the map does not name it" for name in unused]
    return tables, notes


def _refuse_second_robot(
    endings: Sequence[str], used: Collection[str], unused: Collection[str]
) -> None:
    rest = {re.split("[_-]", n, maxsplit=1)[-1] for n in used if n.endswith(tuple(endings))}
    for name in unused:
        prefix, *behind = re.split("[_-]", name, maxsplit=1)
        if behind and behind[0] in rest:
            raise DatasetError(
                f"{name}: odometry of a second robot, {prefix}, which the map does not name. Give "
                f"each robot tables of its own in the map, as [robots.{prefix}.odometry]; or put "
                "the files of each robot into a folder of its name, and import the folder above; "
                "or import the files of one robot, with --robot"
            )


def map_by_names(files: Mapping[str, CsvTable]) -> Map | None:
    """Map of files whose names and columns are all ours, or None."""
    found: Map = {}
    for name, table in files.items():
        kind = Path(name).stem
        ours = kind in TABLES and set(table.columns) <= set(TABLES[kind])
        if not ours or not all(table.has(each) for each in REQUIRED[kind]):
            return None
        found[kind] = Table((name,), {column: column for column in table.columns})
    return found


def _take(
    kind: str,
    table: Table,
    files: Mapping[str, CsvTable],
    tables: RobotTables,
    used: set[str],
    place: str,
) -> list[str]:
    side_by_side: list[CsvTable] = []
    for ending in table.files:
        named = [name for name in files if name.endswith(ending)]
        if not named:
            raise DatasetError(
                f"{tables.robot} has no {kind}: expected {ending}; there are {', '.join(files)}"
            )
        if len(named) > 1:
            raise DatasetError(
                f"{kind}: {len(named)} files end in {ending!r}; there are {', '.join(files)}"
            )
        used.add(named[0])
        side_by_side.append(files[named[0]])
    whole = _join_columns(side_by_side)
    notes: list[str] = []
    for column, texts in table.drop.items():
        if column not in whole.columns:
            raise whole.fault(f"no column {column!r}, which `drop` names")
        chosen = [cell not in texts for cell in whole.columns[column]]
        first = chosen.index(False) if False in chosen else None
        if first is not None:
            count = chosen.count(False)
            notes.append(
                f"{count} rows dropped: {column} is {' or '.join(texts)} "
                f"({whole.name}, first at line {whole.lines[first]})"
            )
            whole = whole.rows(chosen)
    _refuse_several_robots(kind, whole, table, place)
    found = map_columns(whole, table.columns)
    if kind == "detections":
        found = _convert_points(found, whole)
    origin = Origin(
        place,
        {
            ours: (theirs, 1.0) if isinstance(theirs, str) else (theirs.column, theirs.scale)
            for ours, theirs in table.columns.items()
        },
        [column for column in _unassigned(whole, table) if column not in table.drop],
    )
    tables.sources[kind] = CsvTable(whole.name, found, whole.lines, origin if place else None)
    tables.columns[kind] = list(found)
    tables.rows[kind] = [*zip(*found.values(), strict=True)]
    return notes


def _unassigned(rows: CsvTable, table: Table) -> list[str]:
    used = {each if isinstance(each, str) else each.column for each in table.columns.values()}
    return [column for column in rows.columns if column not in used]


def _refuse_several_robots(kind: str, rows: CsvTable, table: Table, place: str) -> None:
    if kind not in (*MEASURED, "truth"):
        return
    for column in _unassigned(rows, table):
        names = list(dict.fromkeys(rows.columns[column]))
        if names_robot(column) and 1 < len(names) <= MOST_ROBOTS:
            raise rows.fault(
                f"column {column} has {len(names)} values, {', '.join(names)}, and the rows of one "
                f"robot are imported. To import {names[0]}, write "
                f"{drop_line(column, names[1:])} below `files` of "
                f"{place or 'its table in the map of columns'}; to import all, give each robot "
                "such tables, [robots.NAME.odometry] and so on. If it names no robots, rename it"
            )


def _convert_points(columns: dict[str, list[str]], table: CsvTable) -> dict[str, list[str]]:
    if not all(name in columns for name in POINTS):
        return columns
    x, y = (_numbers(columns.pop(name), name, table) for name in POINTS)
    r, beta = np.hypot(x, y), np.arctan2(y, x)
    columns |= dict(zip(POLAR, (_texts(r), _texts(beta)), strict=True))
    if all(name in columns for name in POINT_COVARIANCE):
        packed = [_numbers(columns.pop(name), name, table) for name in POINT_COVARIANCE]
        if (r == 0.0).any():
            raise table.error(int(np.argmax(r == 0.0)), POINTS[0], "a point at the sensor")
        own = polar_covariances(x, y, r, np.column_stack(packed))
        columns |= dict(zip(POLAR_COVARIANCE, map(_texts, own.T), strict=True))
    return columns


def _numbers(cells: Sequence[str], name: str, table: CsvTable) -> Float[np.ndarray, " rows"]:
    return CsvTable(table.name, {name: list(cells)}, table.lines).numbers(name)[:, 0]


def _texts(numbers: Float[np.ndarray, " rows"]) -> list[str]:
    return list(map(repr, numbers.tolist()))


def _join_columns(tables: Sequence[CsvTable]) -> CsvTable:
    first = tables[0]
    columns = dict(first.columns)
    for other in tables[1:]:
        if len(other) != len(first):
            raise other.fault(f"{len(other)} rows, and {first.name} beside it has {len(first)}")
        columns = other.columns | columns
    return CsvTable(first.name, columns, first.lines)


def trajectory(path: Path) -> list[tuple[str, ...]]:
    """Rows (t, x, y, θ) of a CSV file or in TUM's format."""
    table = _tum_table(path) or read_table(path, str(path), ("t_s", *POSES))
    if not table.has("t_s", *POSES):
        raise table.fault("expected the columns t_s,x_m,y_m,theta_rad, or TUM's format")
    return list(zip(*(table.columns[name] for name in ("t_s", *POSES)), strict=True))


def _tum_table(path: Path) -> CsvTable | None:
    """Poses (t x y z qx qy qz qw) in TUM's format, or None.

    Heading is that of the pose's x axis.
    """
    rows: list[tuple[str, ...]] = []
    lines: list[int] = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            if not rows and (len(words) != QUATERNION or "," in line):
                return None
            try:
                x, y, _, qx, qy, qz, qw = map(float, words[1:])
            except ValueError:
                raise DatasetError(
                    f"{path}, line {number}: expected t x y z qx qy qz qw: `{line.strip()[:60]}`"
                ) from None
            theta = atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
            rows.append((words[0], repr(x), repr(y), repr(theta)))
            lines.append(number)
    if not rows:
        raise DatasetError(f"{path}: no pose in it")
    columns = zip(("t_s", *POSES), map(list, zip(*rows, strict=True)), strict=True)
    return CsvTable(path.name, dict(columns), lines)
