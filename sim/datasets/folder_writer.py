"""Write streams as a data set of CSV tables, which `sim.datasets.folder` reads: every bit stays."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from sim.datasets.folder_tables import POINTS, POLAR, POSE_COVARIANCE, POSES, SPEEDS
from sim.world.streams import Detections, RobotStream, WorldStreams

Row = Sequence[object]


def write_folder(streams: WorldStreams, directory: Path | str) -> None:
    """One folder for each robot; times to the nanosecond, all other numbers as their shortest text
    that reads back the same.
    """
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
    odometry = _odometry_rows(stream)
    if odometry:
        write_table(place / "odometry.csv", ("t_s", *SPEEDS), odometry)
    ids = stream.landmark_detections.ids.tolist()
    observed = _measured_rows(stream.landmark_detections, ids)
    write_table(place / "observations.csv", ("t_s", "landmark", *POLAR), observed)
    if len(stream.teammate_detections.ids):
        names = [stream.teammates[i] for i in stream.teammate_detections.ids]
        sighted = _measured_rows(stream.teammate_detections, names)
        write_table(place / "sightings.csv", ("t_s", "teammate", *POLAR), sighted)
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


def _odometry_rows(stream: RobotStream) -> list[Row]:
    """A row where each interval begins, and one that ends the last, by the odometry's own clock."""
    intervals = stream.intervals
    if not len(intervals.end_ns):
        return []
    ends_ns = intervals.end_ns - stream.clock_offset_ns
    begins = (ends_ns - intervals.duration_ns).tolist()
    columns = zip(begins, intervals.forward.tolist(), intervals.yaw_rate.tolist(), strict=True)
    rows: list[Row] = [(seconds(begin_ns), v, w) for begin_ns, v, w in columns]
    return [*rows, (seconds(int(ends_ns[-1])), 0.0, 0.0)]


def _measured_rows(seen: Detections, names: Sequence[object]) -> Iterable[Row]:
    """Message by message; one that is empty as a time alone."""
    ranges, bearings = seen.ranges.tolist(), seen.bearings.tolist()
    offsets = seen.offsets.tolist()
    for message, stamp_ns in enumerate(seen.stamps_ns.tolist()):
        time = seconds(stamp_ns)
        first, last = offsets[message : message + 2]
        if first == last:
            yield (time, "", "", "")
        for i in range(first, last):
            yield (time, names[i], ranges[i], bearings[i])


def seconds(stamp_ns: int) -> str:
    """Nanoseconds as seconds, exact."""
    sign, stamp_ns = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    whole, part = divmod(stamp_ns, 10**9)
    return f"{sign}{whole}.{part:09d}".rstrip("0").removesuffix(".")


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """One table."""
    lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
