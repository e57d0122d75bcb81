"""Column maps from a user's columns to ours, and a robot's tables before they are written."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import msgspec

from teamslam.sim.datasets import detections_table, folder
from teamslam.sim.datasets.csv_table import POSE_COVARIANCE, CsvTable
from teamslam.sim.datasets.folder_files import ROBOT_NAME
from teamslam.sim.datasets.folder_tables import POINT_COVARIANCE, POINTS, POSES, SPEEDS
from teamslam.sim.datasets.folder_writer import Row, seconds, write_table
from teamslam.sim.datasets.tables import DatasetError
from teamslam.team.datum import Datum
from teamslam.team.ros2.translator import Measured, Pose, Position, Seen, Speeds

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


@dataclass
class RobotTables:
    """Rows of one robot's tables.

    mount: sensor pose (x, y, yaw) on the base. antenna: place (ahead, left) on the base. sources:
    tables of the user's files, under our column names.
    """

    robot: str
    rows: dict[str, list[Row]] = field(default_factory=dict)
    columns: dict[str, Sequence[str]] = field(default_factory=dict)
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antenna: tuple[float, float] = (0.0, 0.0)
    sources: dict[str, CsvTable] = field(default_factory=dict)

    def add(self, table: str, columns: Sequence[str], row: Row) -> None:
        """Append a row; columns of only some rows are empty in others."""
        known = self.columns.setdefault(table, columns)
        if len(columns) > len(known):
            self.columns[table] = columns
        self.rows.setdefault(table, []).append(row)

    def take(self, measured: Measured) -> None:
        """Append the measurement of one ROS 2 message."""
        time = seconds(measured.stamp_ns)
        match measured:
            case Pose():
                table = "truth" if measured.truth else "odometry"
                self.add(table, ("t_s", *POSES), (time, measured.x, measured.y, measured.theta))
            case Speeds():
                row = (time, measured.forward, measured.yaw_rate)
                self.add("odometry", ("t_s", *SPEEDS), row)
            case Position(covariance=None):
                self.add("fixes", ("t_s", *POINTS), (time, measured.x, measured.y))
            case Position(covariance=(xx, xy, yy)):
                self.add(
                    "fixes",
                    ("t_s", *POINTS, *POINT_COVARIANCE),
                    (time, measured.x, measured.y, xx, xy, yy),
                )
            case Seen(names=()):
                self.add("observations", ("t_s", "landmark", *POINTS), (time, "", "", ""))
            case Seen(covariances=(_, *_)):
                columns = ("t_s", "landmark", *POINTS, *POINT_COVARIANCE)
                rows = zip(measured.names, measured.points, measured.covariances, strict=True)
                for name, point, covariance in rows:
                    self.add("observations", columns, (time, name, *point, *covariance))
            case Seen():
                mates = isinstance(measured.names[0], str)
                table, column = ("sightings", "teammate") if mates else ("observations", "landmark")
                for name, point in zip(measured.names, measured.points, strict=True):
                    self.add(table, ("t_s", column, *POINTS), (time, name, *point))

    def start(self, pose: Sequence[float], sigmas: Sequence[float] = ()) -> None:
        """Set the initial pose; sigmas: (position [m], heading [rad])."""
        row: list[object] = list(pose)
        columns = [*POSES]
        if sigmas:
            position, turned = sigmas[0] ** 2, sigmas[1] ** 2
            row += [position, 0.0, position, 0.0, 0.0, turned]
            columns += POSE_COVARIANCE
        self.columns["start"], self.rows["start"] = columns, [row]

    def write(self, folder: Path) -> None:
        """Write the tables, true landmarks beside the robot's folder."""
        place = folder / self.robot
        place.mkdir(parents=True, exist_ok=True)
        for table, rows in self.rows.items():
            columns = self.columns[table]
            fitted = ([*row, *[""] * (len(columns) - len(row))] for row in rows)
            write_table(
                (folder if table == "landmarks" else place) / f"{table}.csv", columns, fitted
            )


@dataclass
class Report:
    """Result of an import.

    notes: used and omitted files and rows. messages: number read from bags. tables: of each robot,
    for files and bags.
    """

    robots: list[str]
    notes: list[str]
    messages: int = 0
    tables: Sequence[RobotTables] = ()
    datum: Datum | None = None
