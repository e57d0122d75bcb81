"""Write streams in the UTIAS MRCLAM format, for `teamslam.sim.datasets.utias`."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.utias import ROBOTS
from teamslam.sim.world.streams import RobotStream, WorldStreams

Row = tuple[str | float, ...]

FIRST_BARCODE = 100
"""Subject k has barcode 100 + k."""


def write_utias(streams: WorldStreams, directory: Path | str) -> None:
    """Write text files: times in microseconds, other numbers to nine decimals.

    Robot i becomes subject i + 1. Landmarks keep their ids unless one is a robot's subject: then
    all move beyond. The format has no start poses, covariances or empty messages.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    shift = landmark_shift(streams)
    robots = np.arange(1, len(streams.streams) + 1, dtype=np.uint32)
    seen = [stream.landmark_detections.ids for stream in streams.streams]
    landmarks = np.unique(np.concatenate([streams.landmark_ids, *seen])) + shift
    subjects = np.concatenate([robots, landmarks]).tolist()
    codes = ((subject, FIRST_BARCODE + subject) for subject in subjects)
    _write(folder / "Barcodes.dat", "Subject #    Barcode #", "{} {}", codes)
    if streams.landmarks is not None:
        ids = (streams.landmark_ids + shift).tolist()
        survey = (
            (subject, x, y, 0.0, 0.0)
            for subject, (x, y) in zip(ids, streams.landmarks.tolist(), strict=True)
        )
        title = "Subject #    x [m]    y [m]    x std-dev [m]    y std-dev [m]"
        _write(folder / "Landmark_Groundtruth.dat", title, "{} {:.9f} {:.9f} {:.9f} {:.9f}", survey)
    number = {stream.robot: i for i, stream in enumerate(streams.streams, 1)}
    for stream in streams.streams:
        _write_robot(folder, stream, number, shift)


def beyond_utias(streams: WorldStreams) -> list[str]:
    """Measurement forms that the format lacks."""
    intervals = [stream.intervals for stream in streams.streams]
    seen = [stream.landmark_detections for stream in streams.streams]
    found = {
        "odometry as motions": any(each.increments is not None for each in intervals),
        "a car's wheel speed and steering": any(each.steered for each in intervals),
        "detections without identities": any(
            each.hidden is not None and each.hidden.any() for each in seen
        ),
        "landmarks as points": any(each.points is not None for each in seen),
        "covariances of landmarks": any(each.covariances is not None for each in seen),
    }
    return [form for form, is_present in found.items() if is_present]


def landmark_shift(streams: WorldStreams) -> int:
    """Number that `write_utias` adds to landmark ids."""
    last_robot = max(ROBOTS, len(streams.streams))
    seen = [stream.landmark_detections.ids for stream in streams.streams]
    ids = np.concatenate([streams.landmark_ids, *seen])
    return last_robot if np.any(ids <= last_robot) else 0


def _write_robot(folder: Path, stream: RobotStream, number: Mapping[str, int], shift: int) -> None:
    prefix = f"Robot{number[stream.robot]}"
    odometry = _odometry_rows(stream)
    if odometry:
        title = "Time [s]    forward velocity [m/s]    angular velocity[rad/s]"
        _write(folder / f"{prefix}_Odometry.dat", title, "{} {:.9f} {:.9f}", odometry)
    title = "Time [s]    Subject #    range [m]    bearing [rad]"
    measured = _measured_rows(stream, number, shift)
    _write(folder / f"{prefix}_Measurement.dat", title, "{} {} {:.9f} {:.9f}", measured)
    if stream.truth is not None and stream.truth_ns is not None:
        title = "Time [s]    x [m]    y [m]    orientation [rad]"
        poses = zip(stream.truth_ns.tolist(), stream.truth.tolist(), strict=True)
        rows = [(_seconds(stamp_ns), *pose) for stamp_ns, pose in poses]
        _write(folder / f"{prefix}_Groundtruth.dat", title, "{} {:.9f} {:.9f} {:.9f}", rows)


def _odometry_rows(stream: RobotStream) -> list[Row]:
    intervals = stream.intervals
    if not len(intervals.end_ns):
        return []
    ends_ns = intervals.end_ns - stream.clock_offset_ns
    begins = (ends_ns - intervals.duration_ns).tolist()
    columns = zip(begins, intervals.forward.tolist(), intervals.yaw_rate.tolist(), strict=True)
    rows: list[Row] = [(_seconds(begin_ns), v, w) for begin_ns, v, w in columns]
    return [*rows, (_seconds(int(ends_ns[-1])), 0.0, 0.0)]


def _measured_rows(stream: RobotStream, number: Mapping[str, int], shift: int) -> list[Row]:
    subject_of = np.array([number[name] for name in stream.teammates], dtype=np.int64)
    landmarks, teammates = stream.landmark_detections, stream.teammate_detections
    subjects = (landmarks.ids.astype(np.int64) + shift, subject_of[teammates.ids])
    both = (landmarks, teammates)
    stamps = np.concatenate([np.repeat(d.stamps_ns, np.diff(d.offsets)) for d in both])
    barcodes = np.concatenate(subjects) + FIRST_BARCODE
    ranges = np.concatenate([d.ranges for d in both])
    bearings = np.concatenate([d.bearings for d in both])
    order = np.argsort(stamps, kind="stable")
    columns = (each[order].tolist() for each in (stamps, barcodes, ranges, bearings))
    return [(_seconds(stamp_ns), *rest) for stamp_ns, *rest in zip(*columns, strict=True)]


def _seconds(stamp_ns: int) -> str:
    micro = (stamp_ns + 500) // 1000
    sign, micro = ("-", -micro) if micro < 0 else ("", micro)
    return f"{sign}{micro // 10**6}.{micro % 10**6:06d}"


def _write(path: Path, title: str, form: str, rows: Iterable[Row]) -> None:
    lines = ["# UTIAS MRCLAM format, written by teamslam", f"# {title}"]
    lines += (form.format(*row) for row in rows)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
