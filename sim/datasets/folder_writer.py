"""Write streams bit-exactly as a data set of CSV tables."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.csv_table import POSE_COVARIANCE, cells_of
from teamslam.sim.datasets.detections_table import rows_of, split
from teamslam.sim.datasets.folder_tables import (
    INCREMENTS,
    POINT_COVARIANCE,
    POINTS,
    POLAR,
    POLAR_COVARIANCE,
    POSES,
    SPEEDS,
    STEERED,
)
from teamslam.sim.world.streams import Detections, RobotStream, WorldStreams

Row = Sequence[object]


def write_folder(streams: WorldStreams, directory: Path | str) -> None:
    """Write one folder per robot."""
    place = Path(directory)
    place.mkdir(parents=True, exist_ok=True)
    for stream in streams.streams:
        _write_robot(place / stream.robot, stream)
    if streams.landmarks is not None:
        positions = streams.landmarks.tolist()
        rows = zip(streams.landmark_ids.tolist(), positions, strict=True)
        write_table(place / "landmarks.csv", ("landmark", *POINTS), ((i, *p) for i, p in rows))


def _write_robot(place: Path, stream: RobotStream) -> None:
    place.mkdir(exist_ok=True)
    if len(stream.intervals.end_ns):
        write_table(place / "odometry.csv", *_odometry(stream))
    (seen, unnamed), teammates = split(stream.landmark_detections), stream.teammate_detections
    if unnamed is None or len(seen.stamps_ns):
        write_table(place / "observations.csv", *_measured(seen, "landmark", seen.ids.tolist()))
    if unnamed is not None:
        columns, table_rows, labels = rows_of(unnamed)
        write_table(
            place / "detections.csv", columns, ((seconds(t), *row) for t, row in table_rows)
        )
        write_table(place / "labels.csv", ("landmark",), ((label,) for label in labels))
    if len(teammates.ids):
        names = [stream.teammates[i] for i in teammates.ids]
        write_table(place / "sightings.csv", *_measured(teammates, "teammate", names))
    if len(stream.fixes):
        at = zip(stream.fixes_ns.tolist(), cells_of(stream.fixes), strict=True)
        columns = ("t_s", *POINTS, *POINT_COVARIANCE)
        write_table(place / "fixes.csv", columns, ((seconds(t), *row) for t, row in at))
    if stream.start is not None:
        covariance = stream.start.covariance
        columns, row = [*POSES], stream.start.pose.tolist()
        if covariance is not None:
            columns += POSE_COVARIANCE
            row += covariance[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]].tolist()
        write_table(place / "start.csv", columns, [row])
    if stream.truth is not None and stream.truth_ns is not None:
        poses = zip(stream.truth_ns.tolist(), stream.truth.tolist(), strict=True)
        truth = ((seconds(stamp_ns), *pose) for stamp_ns, pose in poses)
        write_table(place / "truth.csv", ("t_s", *POSES), truth)


def _odometry(stream: RobotStream) -> tuple[Sequence[str], list[Row]]:
    """Columns, and rows at each interval's start and the last end; of increments at each end."""
    intervals = stream.intervals
    ends_ns = intervals.end_ns - stream.clock_offset_ns
    if intervals.increments is not None:
        columns = ["t_s", "duration_s", *INCREMENTS]
        numbers = intervals.increments
        if not intervals.as_motions.all():
            columns += STEERED if intervals.steered else SPEEDS
            speeds = np.column_stack([intervals.forward, intervals.yaw_rate])
            speeds[intervals.as_motions] = np.nan
            numbers = np.hstack((numbers, speeds))
        if intervals.covariances is not None:
            columns += POSE_COVARIANCE
            packed = intervals.covariances[:, [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
            numbers = np.hstack((numbers, packed))
        times = zip(ends_ns.tolist(), intervals.duration_ns.tolist(), strict=True)
        measured = zip(times, cells_of(numbers), strict=True)
        return columns, [(seconds(end), seconds(length), *row) for (end, length), row in measured]
    begins = (ends_ns - intervals.duration_ns).tolist()
    pairs = zip(begins, intervals.forward.tolist(), intervals.yaw_rate.tolist(), strict=True)
    rows: list[Row] = [(seconds(begin_ns), v, w) for begin_ns, v, w in pairs]
    columns = ["t_s", *(STEERED if intervals.steered else SPEEDS)]
    return columns, [*rows, (seconds(int(ends_ns[-1])), 0.0, 0.0)]


def _measured(
    seen: Detections, name: str, names: Sequence[object]
) -> tuple[Sequence[str], Iterable[Row]]:
    columns, parts = ["t_s", name], []
    polar = np.column_stack((seen.ranges, seen.bearings))
    points = np.full_like(polar, np.nan) if seen.points is None else seen.points
    as_points = ~np.isnan(points[:, 0])
    polar[as_points] = np.nan
    for form, own, among in (
        ((POLAR, POLAR_COVARIANCE), polar, ~as_points),
        ((POINTS, POINT_COVARIANCE), points, as_points),
    ):
        if among.any() or (seen.points is None) == (form[0] == POLAR):
            columns += form[0]
            parts.append(own)
            if seen.covariances is not None:
                columns += form[1]
                parts.append(np.where(among[:, np.newaxis], seen.covariances, np.nan))
    numbers = cells_of(np.hstack(parts))
    return columns, _measured_rows(seen, names, numbers, len(columns) - 1)


def _measured_rows(
    seen: Detections,
    names: Sequence[object],
    numbers: Sequence[Sequence[object]],
    width: int,
) -> Iterable[Row]:
    offsets = seen.offsets.tolist()
    for message, stamp_ns in enumerate(seen.stamps_ns.tolist()):
        time = seconds(stamp_ns)
        first, last = offsets[message : message + 2]
        if first == last:
            yield (time, *[""] * width)
        for i in range(first, last):
            yield (time, names[i], *numbers[i])


def seconds(stamp_ns: int) -> str:
    """Exact seconds of a stamp."""
    sign, stamp_ns = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    whole, part = divmod(stamp_ns, 10**9)
    return f"{sign}{whole}.{part:09d}".rstrip("0").removesuffix(".")


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Write one table."""
    lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
