"""Find the user's file and column of an error in an imported table."""

from collections.abc import Iterable

from teamslam.sim.datasets.csv_table import CsvTable
from teamslam.sim.datasets.folder_odometry import intervals_of
from teamslam.sim.datasets.folder_tables import (
    POLAR,
    check_polar,
    fixes_of,
    measurements_of,
    start_of,
    truth_of,
)
from teamslam.sim.importing.tables import RobotTables


def check_sources(robots: Iterable[RobotTables]) -> None:
    """Convert the users' tables as a data set's are; raises the DatasetError of the first fault,
    with the user's file, its line and the entry of the map of columns.
    """
    for robot in robots:
        tables = {kind: table for kind, table in robot.sources.items() if len(table)}
        intervals, _ = intervals_of(tables.get("odometry"), 0)
        driven = None
        if len(intervals.end_ns):
            driven = int(intervals.end_ns[0] - intervals.duration_ns[0]), int(intervals.end_ns[-1])
        measurements_of(tables.get("observations"), "measurement", None, driven)
        sighted = tables.get("sightings")
        if sighted is not None:
            mates = list(dict.fromkeys(sighted.columns["teammate"]))
            measurements_of(sighted, "sighting", (robot.robot, mates), driven)
        fixes_of(tables.get("fixes"), driven)
        truth_of(tables.get("truth"), driven)
        if (start := tables.get("start")) is not None:
            start_of(start)
        _check_detections(tables.get("detections"))


def _check_detections(table: CsvTable | None) -> None:
    if table is not None and table.has(*POLAR):
        ranges, bearings = table.numbers(*POLAR).T
        check_polar(table, ranges, bearings)
