"""Column maps from a user's columns to ours, and words in names of files, columns and topics."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path

import msgspec

from teamslam.sim.datasets import detections_table, folder
from teamslam.sim.datasets.csv_table import CsvTable
from teamslam.sim.datasets.folder_files import ROBOT_NAME
from teamslam.sim.datasets.folder_tables import POINT_COVARIANCE, POINTS
from teamslam.sim.datasets.tables import DatasetError

TRUTH_WORDS = (
    "truth", "gt", "groundtruth", "true", "ref", "reference", "mocap", "optitrack", "vicon", "vrpn",
    "qualisys",
)  # fmt: skip
"""Words for references, which are no measurements of the robot."""
FUSED_WORDS = (
    "filtered", "fused", "ekf", "ukf", "global", "map", "amcl", "gps", "slam", "localization",
    "kiss", "visual", "vio", "lidar", "icp",
)  # fmt: skip
"""Words for odometry from more than wheels."""


ROBOT_COLUMN = re.compile(
    r"(robot|agent|vehicle|platform|rover|ugv)s?_?(id|name|no|nr|number|index|ns|namespace)?"
)


def names_robot(column: str) -> bool:
    """Whether a column is called as one of robots' names."""
    return ROBOT_COLUMN.fullmatch(re.sub(r"[^a-z0-9]+", "_", column.lower())) is not None


def has_word(name: str, words: tuple[str, ...]) -> bool:
    """Whether a name has such a word between marks or capitals."""
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return not set(re.split(r"[^a-z]+", parts)).isdisjoint(words)


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """User's column: scale · number + offset, or its text."""

    column: str
    scale: float = 1.0
    offset: float = 0.0


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Endings of the names of files joined side by side, and columns.

    drop: by user column, texts of rows that are no measurements.
    """

    files: tuple[str, ...]
    columns: dict[str, str | Column]
    drop: dict[str, tuple[str, ...]] = {}


Map = dict[str, Table]  # tables of one robot by kind


class ColumnMap(msgspec.Struct, frozen=True):
    """Tables of every robot, and of single robots, which replace them."""

    shared: Map
    robots: dict[str, Map]

    def tables_of(self, robot: str) -> Map:
        """Tables of a robot."""
        return self.shared | self.robots.get(robot, {})

    def places_of(self, robot: str, path: Path | None) -> Mapping[str, str]:
        """Place of each kind of table in the map's file."""
        own = self.robots.get(robot, {})
        return {
            kind: f"[robots.{robot}.{kind}] of {path}" if kind in own else f"[{kind}] of {path}"
            for kind in self.tables_of(robot)
        }


TABLES: Mapping[str, Sequence[str]] = {
    **folder.TABLES,
    "detections": (*detections_table.COLUMNS, *POINTS, *POINT_COVARIANCE),
    "labels": detections_table.LABELS,
}
"""Allowed columns of each table: a data set's, and points for detections."""
REQUIRED: Mapping[str, Sequence[str]] = {
    **folder.REQUIRED,
    "detections": ("t_s",),
    "labels": detections_table.LABELS,
}
KINDS = tuple(TABLES)
MEASURED = ("odometry", "observations", "sightings", "detections")


def load_map(path: Path) -> ColumnMap:
    """Read a TOML column map; raises DatasetError."""
    try:
        document = tomllib.loads(path.read_text("utf-8"))
        robots = msgspec.convert(document.pop("robots", {}), dict[str, Map])
        found = ColumnMap(msgspec.convert(document, Map), robots)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can not be read: {error}") from None
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise DatasetError(
            f"{path}: no map of columns: {error}; docs/your_data.md has one"
        ) from None
    for name, tables in [("", found.shared), *found.robots.items()]:
        if name and not re.fullmatch(ROBOT_NAME, name):
            raise DatasetError(
                f"{path}: [robots.{name}]: no robot's name: a small letter, then small letters, "
                "digits and _ (32 at most)"
            )
        _check_tables(tables, f"{path}: {name}: " if name else f"{path}: ")
    return found


def _check_tables(tables: Map, place: str) -> None:
    for kind, table in tables.items():
        if kind not in TABLES:
            raise DatasetError(f"{place}no table {kind}; known: {', '.join(KINDS)}")
        for ours in table.columns:
            if ours not in TABLES[kind]:
                known = ", ".join(TABLES[kind])
                raise DatasetError(f"{place}{kind} has no column {ours}; known: {known}")
        if kind == "observations" and "landmark" not in table.columns:
            raise DatasetError(
                f"{place}observations need the column landmark; measurements without identities "
                "are [detections]"
            )


def map_columns(table: CsvTable, columns: Mapping[str, str | Column]) -> dict[str, list[str]]:
    """Columns under our names, as text."""
    found = {}
    for ours, theirs in columns.items():
        column = Column(theirs) if isinstance(theirs, str) else theirs
        if column.column not in table.columns:
            raise table.fault(f"no column {column.column!r}, which the map has for {ours}")
        cells = table.columns[column.column]
        if column.scale == 1.0 and column.offset == 0.0:
            found[ours] = cells
        elif ours == "t_s":
            scale, offset = Decimal(repr(column.scale)), Decimal(repr(column.offset))
            table.stamps(column.column, scale)
            found[ours] = [f"{Decimal(cell) * scale + offset:f}" for cell in cells]
        else:
            numbers = table.numbers(column.column)[:, 0] * column.scale + column.offset
            found[ours] = [repr(number) for number in numbers.tolist()]
    return found
