"""UTIAS multi-robot cooperative localisation and mapping data sets (MRCLAM).

Leung, Halpern, Barfoot, Liu, IJRR 30(8):969-974, 2011. Measurements name a *barcode*;
`Barcodes.dat` gives its subject: a robot or a landmark.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from teamslam.sim.datasets.tables import (
    EXPECTED,
    DatasetError,
    File,
    Scans,
    count_note,
    first_of_each,
    on_circle,
    open_data_set,
    optional_table,
    table,
)
from teamslam.sim.world.config import UtiasWorld
from teamslam.sim.world.streams import Intervals, RobotStream, StartPose, WorldStreams
from teamslam.team.config import RobotConfig
from teamslam.team.shapes import Bool, Float, Int64, UInt32


@dataclass(frozen=True)
class _Erratum:
    """Measurements of subject k are of subjects[k]."""

    subjects: Mapping[int, int]
    note: str


def content_digest(barcodes: Float[np.ndarray, "B 2"], landmarks: Float[np.ndarray, "L 5"]) -> str:
    """SHA-256 of the numbers of two tables."""
    numbers = barcodes.astype("<f8").tobytes() + landmarks.astype("<f8").tobytes()
    return hashlib.sha256(numbers).hexdigest()


ERRATA: Mapping[str, _Erratum] = {
    "60e044e708a8e77ea50d4ce724a4f85fa8ccd99276ed30acee64e58df8c0d5e4": _Erratum(
        subjects={11: 17, 17: 11},
        note=(
            "erratum of UTIAS set 1 applied: the survey and the barcodes have landmarks 11 and 17 "
            "exchanged (all sightings of the two by all robots are 6 m off otherwise); "
            "world.errata = false leaves them as they are"
        ),
    ),
}


ROBOTS = 5  # subjects 1 … 5 are robots, even without files; landmarks follow

BARCODES = ("subject", "barcode")
SURVEY = ("subject", "x [m]", "y [m]", "x std-dev [m]", "y std-dev [m]")
TRUTH = ("time [s]", "x [m]", "y [m]", "orientation [rad]")
ODOMETRY = ("time [s]", "forward velocity [m/s]", "angular velocity [rad/s]")
MEASUREMENT = ("time [s]", "barcode", "range [m]", "bearing [rad]")


def utias(world: UtiasWorld, robots: Sequence[RobotConfig]) -> WorldStreams:
    """Read the measurements of robots r1, r2, …; raises DatasetError.

    Odometry row k acts from its time to the next row's, delayed by odometry_delay_s and
    clock_offset_s, which the robot corrects. Stamps are nanoseconds since 1970. The initial pose is
    the truth at the first measurement, with the world's start sigmas.
    """
    with open_data_set(world.path, "Barcodes.dat") as files:
        clocks = {robot.id: round(robot.clock_offset_s * 1e9) for robot in robots}
        return _streams(world, clocks, files)


def _streams(
    world: UtiasWorld, clocks: Mapping[str, int], files: Mapping[str, File]
) -> WorldStreams:
    present = present_robots(files)
    if not present:
        raise DatasetError(f"{world.path}: no RobotN_Odometry.dat in it; {EXPECTED}")
    last_robot = max(ROBOTS, *present)
    barcodes = table(files["Barcodes.dat"], BARCODES)
    survey = optional_table(files, "Landmark_Groundtruth.dat", SURVEY)
    subject_of = _subjects(barcodes)
    notes = []
    erratum = ERRATA.get(content_digest(barcodes, survey)) if world.errata else None
    if erratum:
        notes.append(erratum.note)
        swap = erratum.subjects
        subject_of = {code: swap.get(subject, subject) for code, subject in subject_of.items()}
    ids, positions = _landmarks(survey, last_robot)
    if not len(ids):
        notes.append("no landmark ground truth: the map's error can not be computed")
    delay_ns = round(world.odometry_delay_s * 1e9)
    read = _Reading(world, files, subject_of, clocks, delay_ns, last_robot)
    streams = [_stream(robot, read) for robot in clocks]
    if world.duration_s is not None:
        end_ns = min(each.start_ns for each in streams) + round(world.duration_s * 1e9)
        streams = [each.until(end_ns) for each in streams]
    return WorldStreams(
        streams=tuple(streams),
        landmark_ids=ids,
        landmarks=positions if len(ids) else None,
        source=f"UTIAS data set {Path(world.path).name}",
        notes=tuple(notes),
    )


def _subjects(barcodes: Float[np.ndarray, "B 2"]) -> dict[int, int]:
    if not len(barcodes) or np.any(barcodes != np.rint(barcodes)) or np.any(barcodes < 0):
        raise DatasetError("Barcodes.dat: expected rows of two whole numbers, subject and barcode")
    subject_of = {int(code): int(subject) for subject, code in barcodes}
    if len(subject_of) < len(barcodes):
        raise DatasetError("Barcodes.dat: one barcode has two subjects")
    return subject_of


def _landmarks(
    survey: Float[np.ndarray, "L 5"], last_robot: int
) -> tuple[UInt32[np.ndarray, " M"], Float[np.ndarray, "M 2"]]:
    survey = survey[survey[:, 0] > last_robot]
    survey = survey[np.argsort(survey[:, 0], kind="stable")]
    if np.any(np.diff(survey[:, 0]) == 0.0):
        raise DatasetError("Landmark_Groundtruth.dat: one landmark has two positions")
    return survey[:, 0].astype(np.uint32), survey[:, 1:3].copy()


class _Reading(NamedTuple):
    """subject_of: barcode → subject. clocks: offsets [ns]. last_robot: largest robot subject."""

    world: UtiasWorld
    files: Mapping[str, File]
    subject_of: Mapping[int, int]
    clocks: Mapping[str, int]
    delay_ns: int
    last_robot: int


def present_robots(files: Mapping[str, File]) -> list[int]:
    """Numbers of the robots with files."""
    matches = (re.fullmatch(r"Robot([1-9]\d*)_(Odometry|Measurement)\.dat", name) for name in files)
    return sorted({int(match[1]) for match in matches if match})


def _subject(robot: str, files: Mapping[str, File]) -> int:
    present = present_robots(files)
    subject = int(robot[1:]) if re.fullmatch(r"r[1-9]\d*", robot) else 0
    if subject not in present:
        known = ", ".join(f"r{number}" for number in present)
        raise DatasetError(
            f"the data set has no measurements of a robot {robot}; it has {known}: give "
            "--robots, or a scenario of its own, such as `teamslam simulate` writes beside it"
        )
    return subject


def _stream(robot: str, read: _Reading) -> RobotStream:
    subject = _subject(robot, read.files)
    odometry, measured, true_rows = (
        optional_table(read.files, f"Robot{subject}_{name}.dat", columns)
        for name, columns in (
            ("Odometry", ODOMETRY), ("Measurement", MEASUREMENT), ("Groundtruth", TRUTH),
        )
    )  # fmt: skip
    notes: list[str] = []
    intervals = _intervals_of(odometry, read.delay_ns + read.clocks[robot], notes)
    seen = _measurements_of(measured, read.subject_of, notes)
    truth_ns, truth = _truth_of(true_rows, notes)
    missing = (
        "no odometry: only its observations are used" if not len(intervals.end_ns) else "",
        "no measurements: only its odometry is given" if not len(seen.stamps_ns) else "",
        "no ground truth: its trajectory's error can not be computed" if not len(truth) else "",
    )
    if missing[0] and missing[1]:
        raise DatasetError(f"robot {robot}: neither odometry nor measurements in its files")
    notes = [*filter(None, missing), *notes]
    start_ns = int(
        np.concatenate((intervals.end_ns[:1] - intervals.duration_ns[:1], seen.stamps_ns[:1])).min()
    )

    def keep(chosen: Bool[np.ndarray, " R"], otherwise: str) -> Scans:
        _count(notes, ~chosen, "measurement", f"dropped: {otherwise}")
        return seen.where(chosen)

    if len(intervals.end_ns):
        in_time = seen.stamps_ns <= intervals.end_ns[-1]
        seen = keep(in_time, "after its last odometry, where its motion is not known")
    numbers = np.array([int(each[1:]) for each in read.clocks], dtype=np.uint32)
    seen = keep(seen.ids != subject, "of itself")
    of_team = (seen.ids > read.last_robot) | np.isin(seen.ids, numbers)
    seen = keep(of_team, "of a robot that is not in the team")
    teammates = seen.where(seen.ids <= read.last_robot)
    index = (teammates.ids[:, np.newaxis] == numbers).argmax(axis=1).astype(np.uint32)
    start = _start_pose(truth_ns, truth, start_ns)
    if start is None:
        notes.append("no ground truth at its first measurement: its start pose is not known")
    ends = intervals.end_ns[-1:]
    if len(truth) and len(ends) and ends[0] - truth_ns[-1] > 10**9:
        seconds = (ends[0] - truth_ns[-1]) * 1e-9
        notes.append(f"ground truth ends {seconds:.0f} s before the odometry")
    return RobotStream(
        robot=robot,
        start_ns=start_ns,
        start=_start(read.world, start),
        intervals=intervals,
        landmark_detections=seen.where(seen.ids > read.last_robot).grouped(),
        teammate_detections=replace(teammates, ids=index).grouped(),
        teammates=tuple(read.clocks),
        truth_ns=truth_ns if len(truth) else None,
        truth=truth if len(truth) else None,
        notes=tuple(notes),
        clock_offset_ns=read.clocks[robot],
    )


def _start(world: UtiasWorld, pose: Float[np.ndarray, "3"] | None) -> StartPose | None:
    if pose is None:
        return None
    if world.start_sigma_m == 0.0:
        return StartPose(pose, None)
    sigmas = np.array([world.start_sigma_m, world.start_sigma_m, world.start_sigma_rad])
    return StartPose(pose, np.diag(sigmas**2))


LONG_GAP_NS = 2_000_000_000  # least reported gap in odometry or truth

START_WINDOW_NS = 200_000_000  # time around a robot's first measurement for its initial pose

START_SPREAD_RAD = 0.2  # largest heading difference [rad] within that time


def nanoseconds(seconds: Float[np.ndarray, " N"]) -> Int64[np.ndarray, " N"]:
    """Round seconds to the microsecond, the precision of a double since 1970."""
    return np.rint(seconds * 1e6).astype(np.int64) * 1000


def _intervals_of(rows: Float[np.ndarray, "N 3"], delay_ns: int, notes: list[str]) -> Intervals:
    """Convert odometry rows (t, v, ω): row k acts over [t_k, t_{k+1}] + delay."""
    rows = _sort_by_time(rows, "odometry row", notes)
    stamps = nanoseconds(rows[:, 0]) + delay_ns
    duration = np.diff(stamps)
    lasting = duration > 0
    _count(notes, ~lasting, "odometry row", "dropped: another row has the same time")
    if np.any(duration > LONG_GAP_NS):
        seconds = duration.max() * 1e-9
        notes.append(f"odometry has a gap of {seconds:.1f} s: its last velocities hold over it")
    return Intervals(
        end_ns=stamps[1:][lasting],
        duration_ns=duration[lasting],
        forward=rows[:-1, 1][lasting],
        yaw_rate=rows[:-1, 2][lasting],
    )


def _measurements_of(
    rows: Float[np.ndarray, "N 4"], subject_of: Mapping[int, int], notes: list[str]
) -> Scans:
    rows = _sort_by_time(rows, "measurement", notes)
    codes = np.array(sorted(subject_of), dtype=np.float64)
    subjects = np.array([subject_of[int(code)] for code in codes], dtype=np.uint32)
    at = np.minimum(np.searchsorted(codes, rows[:, 1]), len(codes) - 1)
    known = codes[at] == rows[:, 1]
    positive = rows[:, 2] > 0.0
    measurements = Scans(
        nanoseconds(rows[:, 0]), subjects[at], rows[:, 2].copy(), on_circle(rows[:, 3])
    )
    usable = known & positive
    single = first_of_each(measurements.stamps_ns, measurements.ids, usable)
    for dropped, reason in (
        (~known, "unknown barcode"),
        (known & ~positive, "range not above 0"),
        (usable & ~single, "a second one of the same subject at the same time"),
    ):
        _count(notes, dropped, "measurement", f"dropped: {reason}")
    return measurements.where(single)


def _truth_of(
    rows: Float[np.ndarray, "N 4"], notes: list[str]
) -> tuple[Int64[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Rows (t, x, y, θ) by time."""
    rows = _sort_by_time(rows, "ground truth row", notes)
    stamps = nanoseconds(rows[:, 0])
    gaps = np.diff(stamps)
    if np.any(gaps > LONG_GAP_NS):
        notes.append(f"ground truth has gaps, the longest of {gaps.max() * 1e-9:.1f} s")
    return stamps, rows[:, 1:].copy()


def _start_pose(
    truth_ns: Int64[np.ndarray, " T"], truth: Float[np.ndarray, "T 3"], start_ns: int
) -> Float[np.ndarray, "3"] | None:
    """True pose at start_ns, interpolated on the circle, or None.

    Resampled truth has wrong headings beside ±π: only samples near the most central one count.
    """
    first, last = np.searchsorted(
        truth_ns, [start_ns - START_WINDOW_NS, start_ns + START_WINDOW_NS + 1]
    )
    if first == last:
        return None
    poses = truth[first:last]
    difference = np.abs(on_circle(poses[:, 2, np.newaxis] - poses[:, 2]))
    middle = int(np.argmin(difference.sum(axis=1)))
    agreeing = difference[middle] <= START_SPREAD_RAD
    since = (truth_ns[first:last][agreeing] - start_ns).astype(np.float64)
    x, y, heading = poses[agreeing].T
    turned = on_circle(heading - poses[middle, 2])
    at = [float(np.interp(0.0, since, values)) for values in (x, y, turned)]
    return np.array([at[0], at[1], on_circle(np.array(at[2] + poses[middle, 2])).item()])


def _sort_by_time(
    rows: Float[np.ndarray, "N C"], thing: str, notes: list[str]
) -> Float[np.ndarray, "N C"]:
    backward = np.diff(rows[:, 0]) < 0.0
    _count(notes, backward, thing, "earlier than the row before: sorted by time")
    return rows[np.argsort(rows[:, 0], kind="stable")] if backward.any() else rows


def _count(notes: list[str], chosen: Bool[np.ndarray, " _"], thing: str, what: str) -> None:
    if chosen.any():
        notes.append(count_note(int(np.count_nonzero(chosen)), thing, what))


Row = tuple[str | float, ...]

FIRST_BARCODE = 100  # subject k has barcode 100 + k


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
