"""One robot's tables before they are written."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from teamslam.sim.datasets.csv_table import POSE_COVARIANCE, CsvTable
from teamslam.sim.datasets.folder_tables import POINT_COVARIANCE, POINTS, POSES, SPEEDS
from teamslam.sim.datasets.folder_writer import Row, seconds, write_table
from teamslam.team.datum import Datum
from teamslam.team.ros2.translator import Measured, Pose, Position, Seen, Speeds


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
            fitted = (_fit_row(row, len(columns)) for row in rows)
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


def _fit_row(row: Row, width: int) -> Row:
    return [*row, *[""] * (width - len(row))]
