"""A data set of CSV tables in a folder or zip (docs/your_data.md)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median_low

import numpy as np

from teamslam.sim.datasets import folder_tables as rows
from teamslam.sim.datasets.csv_table import (
    POSE_COVARIANCE,
    CsvTable,
    UnknownColumnError,
    read_table,
)
from teamslam.sim.datasets.detections_table import detections_of, merge_detections
from teamslam.sim.datasets.folder_files import (
    DETECTIONS,
    name_table,
    open_folder,
    stray_tables,
    unused_files,
)
from teamslam.sim.datasets.folder_odometry import intervals_of
from teamslam.sim.datasets.tables import DatasetError, File
from teamslam.sim.world.config import FolderWorld
from teamslam.sim.world.streams import Detections, RobotStream, WorldStreams
from teamslam.team.config import RobotConfig
from teamslam.team.shapes import Int64

SAME_PACE = 0.1  # greatest relative difference of usual odometry intervals in one unit
TABLES = {
    "odometry": (
        "t_s", "duration_s", *rows.SPEEDS, *rows.POSES, *rows.INCREMENTS, *rows.STEERED,
        *POSE_COVARIANCE,
    ),
    "observations": (
        "t_s", "landmark", *rows.POLAR, *rows.POINTS, *rows.POLAR_COVARIANCE,
        *rows.POINT_COVARIANCE,
    ),
    "sightings": ("t_s", "teammate", *rows.POLAR, *rows.POINTS),
    "fixes": ("t_s", *rows.POINTS, *rows.POINT_COVARIANCE),
    "start": ("t_s", *rows.POSES, *POSE_COVARIANCE),
    "truth": ("t_s", *rows.POSES),
    "landmarks": ("landmark", *rows.POINTS),
}  # fmt: skip
REQUIRED = {
    "odometry": ("t_s",),
    "observations": ("t_s", "landmark"),
    "sightings": ("t_s", "teammate"),
    "fixes": ("t_s", *rows.POINTS),
    "start": rows.POSES,
    "truth": ("t_s", *rows.POSES),
    "landmarks": ("landmark", *rows.POINTS),
}


def folder(
    world: FolderWorld, robots: Sequence[RobotConfig], classes: Sequence[str] = ()
) -> WorldStreams:
    """Read these robots' measurements; raises DatasetError.

    classes: of detections. Odometry stamps are shifted by clock_offset_s, which the robot corrects.
    """
    clocks = {robot.id: round(robot.clock_offset_s * 1e9) for robot in robots}
    with open_folder(world.path) as (root, folders):
        missing = [name for name in clocks if name not in folders]
        if missing:
            raise DatasetError(
                f"{world.path}: no robot {', '.join(missing)} in it, but {', '.join(folders)}: "
                "give --robots, or a scenario with its names"
            )
        streams = [_stream(name, folders[name], clocks, classes) for name in clocks]
        surveyed = _table(root, "landmarks", "")
        unused = unused_files(root, folders, TABLES)
    _check_units(streams)
    if world.duration_s is not None:
        end_ns = min(each.start_ns for each in streams) + round(world.duration_s * 1e9)
        streams = [each.until(end_ns) for each in streams]
    ids, positions = (
        (np.empty(0, np.uint32), None) if surveyed is None else rows.landmarks_of(surveyed)
    )
    notes = [] if len(ids) else ["no landmarks.csv: the map's error can not be computed"]
    cars = {robot.id for robot in robots if robot.motion.kind == "ackermann"}
    steered = [s.robot for s in streams if s.intervals.steered and s.robot not in cars]
    if steered:
        notes.append(
            f"{', '.join(steered)}: wheel speed and steering can not be used: give "
            'kind = "ackermann" and wheel_base in [defaults.motion] of scenario.toml'
        )
    others = [name for name in folders if name not in clocks]
    if others:
        notes.append(f"{', '.join(others)}: not in the scenario's team: left out")
    notes += unused
    return WorldStreams(
        streams=tuple(streams),
        landmark_ids=ids,
        landmarks=positions if len(ids) else None,
        source=f"data set {Path(world.path).resolve().name}",
        notes=tuple(notes),
    )


def _stream(
    robot: str, place: File, clocks: Mapping[str, int], classes: Sequence[str]
) -> RobotStream:
    kinds = ("odometry", "observations", "sightings", "fixes", "truth", "start")
    tables = {kind: _table(place, kind, robot) for kind in kinds}
    unnamed = detections_of(place, robot, classes)
    stray = stray_tables(place, TABLES)
    return stream_of(robot, tables, tuple(clocks), clocks[robot], unnamed, stray)


def _check_units(streams: Sequence[RobotStream]) -> None:
    """Refuse robots whose stamps are in another unit than those of the others.

    Both their span and their usual odometry interval differ by the ratio of two units. Honest
    robots may drive for different times or have odometry at different rates, but not both alike.
    """
    spans, paces = {}, {}
    for each in streams:
        driven = each.intervals
        begin_ns = driven.end_ns[0] - driven.duration_ns[0]
        spans[each.robot] = 1e-9 * float(driven.end_ns[-1] - begin_ns)
        paces[each.robot] = float(np.median(driven.duration_ns))
    found = {}
    for robot in spans:
        others = [other for other in spans if other != robot]
        if not others:
            return
        usual_s, pace = (median_low(of[other] for other in others) for of in (spans, paces))
        unit = rows.unit_of(spans[robot] / usual_s) if usual_s > 0.0 else None
        if unit is not None and abs(paces[robot] / (pace * unit[2]) - 1.0) < SAME_PACE:
            found[robot] = unit, usual_s
    if found:
        (name, scale, _), usual_s = next(iter(found.values()))
        one = next(iter(found))
        span, its = ("spans", "its") if len(found) == 1 else ("span", "their")
        table = CsvTable(f"{one}/odometry.csv", {}, [])
        raise DatasetError(
            f"{', '.join(found)} {span} {spans[one]:,.0f} s, the others {usual_s:,.0f} s, with as "
            f"many rows: are {its} stamps in {name}? Then {table.conversion('t_s', name, scale)}"
        )


def stream_of(
    robot: str,
    tables: Mapping[str, CsvTable | None],
    team: tuple[str, ...],
    offset_ns: int = 0,
    unnamed: Detections | None = None,
    stray: Sequence[str] = (),
) -> RobotStream:
    """Measurements of a robot's tables by kind.

    offset_ns: of the odometry's clock. stray: files beside the tables that are not read.
    """
    observed, sighted = tables.get("observations"), tables.get("sightings")
    if all(each is None for each in (tables.get("odometry"), observed, sighted, unnamed)):
        raise DatasetError(f"robot {robot}: neither odometry nor observations in its tables")
    intervals, notes = intervals_of(tables.get("odometry"), offset_ns)
    if not len(intervals.end_ns):
        raise DatasetError(
            f"{robot}/odometry.csv: no odometry interval of {robot}, and without one it can not be "
            "in the map: add the table (for a robot that stands still, rows of speed 0 at its "
            f"first and last time), or remove the folder {robot}{_renaming(stray, 'odometry')}"
        )
    driven = int(intervals.end_ns[0] - intervals.duration_ns[0]), int(intervals.end_ns[-1])
    seen, empty_ns, more = rows.measurements_of(observed, "measurement", None, driven)
    notes += more
    if unnamed is not None and len(unnamed.stamps_ns):
        table = CsvTable(f"{robot}/{DETECTIONS}", {}, [])
        problem = rows.clock_problem(table, unnamed.stamps_ns, driven)
        if problem is not None:
            raise DatasetError(f"{table.name}, column t_s: {problem}")
        unnamed = unnamed.within(*driven)
    if not len(seen.stamps_ns) and unnamed is None:
        hint = _renaming(stray, "observations") if observed is None else ""
        notes.append(f"no observations: only its odometry is given{hint}")
    teammates, _, more = rows.measurements_of(sighted, "sighting", (robot, team), driven)
    notes += more
    fixes_ns, fixes, more = rows.fixes_of(tables.get("fixes"), driven)
    notes += more
    truth_ns, poses, more = rows.truth_of(tables.get("truth"), driven)
    notes += more if len(poses) else ["no truth.csv: its trajectory's error can not be computed"]
    start = tables.get("start")
    landmarks = merge_detections(_insert_empty(seen.grouped(), empty_ns), unnamed)
    mates = teammates.grouped()
    begins = (np.array(driven, np.int64), landmarks.stamps_ns[:1], mates.stamps_ns[:1])
    return RobotStream(
        robot=robot,
        start_ns=int(np.concatenate(begins).min()),
        start=None if start is None else rows.start_of(start),
        intervals=intervals,
        landmark_detections=landmarks,
        teammate_detections=mates,
        teammates=team,
        truth_ns=truth_ns if len(poses) else None,
        truth=poses if len(poses) else None,
        notes=tuple(notes),
        fixes_ns=fixes_ns,
        fixes=fixes,
        clock_offset_ns=offset_ns,
    )


def _renaming(stray: Sequence[str], kind: str) -> str:
    return f"; if {' or '.join(stray)} has them, rename it to {kind}.csv" if stray else ""


def _table(place: File, kind: str, robot: str) -> CsvTable | None:
    file = place / f"{kind}.csv"
    if not file.is_file():
        return None
    name = name_table(place, file, robot)
    try:
        table = read_table(file, name, TABLES[kind])
    except UnknownColumnError as error:
        of = [other for other, known in TABLES.items() if set(error.header) <= set(known)]
        if not of:
            raise
        raise DatasetError(
            f"{name}, line 1: its columns are those of {' or '.join(f'{o}.csv' for o in of)} "
            f"({', '.join(error.header)}): rename the file"
        ) from None
    for column in REQUIRED[kind]:
        if not table.has(column):
            raise table.fault(f"no column {column}; known: {', '.join(TABLES[kind])}")
    return table.filled(REQUIRED[kind]) if len(table) else None


def _insert_empty(seen: Detections, empty_ns: Int64[np.ndarray, " E"]) -> Detections:
    empty_ns = np.setdiff1d(empty_ns, seen.stamps_ns)
    stamps = np.concatenate([seen.stamps_ns, empty_ns])
    counts = np.concatenate([np.diff(seen.offsets), np.zeros(len(empty_ns), np.int64)])
    order = np.argsort(stamps, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(counts[order])]).astype(np.int64)
    return replace(seen, stamps_ns=stamps[order], offsets=offsets)
