"""A data set of one robot whose landmarks have no names (docs/landmarks_without_names.md).

A step is taken as 1 s. Labels, reference and GPS are for scoring, but for the GPS with
`world.fixes`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.csv_table import POSE_COVARIANCE, CsvTable, matrices, read_table
from teamslam.sim.datasets.detections_table import labels_of, scans_of
from teamslam.sim.datasets.factor_graph import turn_covariance
from teamslam.sim.datasets.folder_odometry import pace_notes
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.world.config import UnlabelledWorld
from teamslam.sim.world.streams import (
    NO_LABEL,
    Detections,
    Intervals,
    RobotStream,
    StartPose,
    WorldStreams,
    moved,
    no_detections,
    polar_covariances,
)
from teamslam.team.shapes import Float, Int64, UInt32

FILES = ("odometry.csv", "detections.csv")
CAR = ("t_s", "rear_wheel_speed_m_s", "steering_rad")
STEPS = ("step", "dx_m", "dy_m", "dtheta_rad")
STEP_NS = 1_000_000_000
POLAR = ("t_s", "range_m", "bearing_rad")
POINTS = ("step", "x_m", "y_m", "c_xx", "c_xy", "c_yy")
EXPECTED = "expected a folder with odometry.csv and detections.csv"


def is_unlabelled(path: str | Path) -> bool:
    """Whether a folder has such tables, or odometry.csv alone."""
    root = Path(path)
    if not (root / FILES[0]).is_file() or (root / "observations.csv").is_file():
        return False
    if (root / FILES[1]).is_file():
        return True
    try:
        odometry = _table(root, FILES[0])
    except DatasetError:
        return False
    return any(odometry.has(column) for column in (STEPS[0], CAR[1]))


def is_car(path: str | Path) -> bool:
    """Whether the odometry is a car's; raises DatasetError."""
    file = Path(path) / FILES[0]
    return file.is_file() and _form(_table(Path(path), FILES[0]))[0] == CAR


def unlabelled(world: UnlabelledWorld, robots: int) -> WorldStreams:
    """Streams of a data set, cut into one piece per robot, which begin at one time; raises
    DatasetError.
    """
    root = Path(world.path)
    lacking = [name for name in FILES if not (root / name).is_file()]
    if lacking:
        raise DatasetError(f"{root}: no {' and no '.join(lacking)} in it; {EXPECTED}")
    whole = _stream(root, world)
    if robots > len(whole.intervals.end_ns):
        raise DatasetError(
            f"{root}: {len(whole.intervals.end_ns)} odometry intervals can not be cut into "
            f"{robots} pieces"
        )
    ids, positions = _reference(root)
    return WorldStreams(
        streams=pieces(whole, robots) if robots > 1 else (whole,),
        landmark_ids=ids,
        landmarks=positions if len(ids) else None,
        source=f"data set {root.resolve().name}",
    )


def _table(root: Path, name: str, *needed: str) -> CsvTable:
    table = read_table(root / name, name)
    lacking = [column for column in needed if not table.has(column)]
    if lacking:
        raise table.fault(f"no column {', '.join(lacking)}; it needs {','.join(needed)}")
    return table


def _form(odometry: CsvTable) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Columns of both tables, by those of odometry.csv."""
    own = {CAR: CAR[1:], STEPS + POSE_COVARIANCE: STEPS}
    form = max(own, key=lambda each: sum(odometry.has(column) for column in own[each]))
    if not any(odometry.has(column) for column in own[form]):
        needed = " or ".join(",".join(columns) for columns in own)
        raise odometry.fault(f"columns of neither kind; it needs {needed}")
    return form, POLAR if form == CAR else POINTS


def _stream(root: Path, world: UnlabelledWorld) -> RobotStream:
    form, seen_form = _form(_table(root, "odometry.csv"))
    odometry, detections = (
        _table(root, name, *needed) for name, needed in zip(FILES, (form, seen_form), strict=True)
    )
    labels = labels_of(
        _table(root, "labels.csv") if (root / "labels.csv").is_file() else None, len(detections)
    )
    take = _read_car if form == CAR else _read_steps
    intervals, seen = take(odometry, detections, labels)
    if not len(intervals.end_ns):
        raise odometry.fault("no odometry interval in its rows: there is nothing to run")
    start_ns = int(intervals.end_ns[0] - intervals.duration_ns[0])
    end_ns = int(intervals.end_ns[-1])
    outside = int(np.sum((seen.stamps_ns < start_ns) | (seen.stamps_ns > end_ns)))
    seen = seen.within(start_ns, end_ns)
    if world.identities == "known":
        seen = _name_by_labels(seen)
    gps_ns, gps = _positions(root)
    fixes_ns, fixes = np.empty(0, np.int64), np.zeros((0, 5))
    if world.fixes:
        if gps_ns is None or gps is None:
            raise DatasetError(f"{root}: no gps.csv in it, and world.fixes is true")
        inside = (gps_ns >= start_ns) & (gps_ns <= end_ns)
        fixes_ns = gps_ns[inside]
        fixes = np.hstack((gps[inside], np.full((len(fixes_ns), 3), np.nan)))
    notes = [f"{outside} scans are outside the time of the odometry"] if outside else []
    if form == CAR:
        notes += pace_notes(intervals.duration_ns)
    whole = RobotStream(
        robot="r1",
        start_ns=start_ns,
        start=None if world.fixes else StartPose(np.zeros(3), None),
        intervals=intervals,
        landmark_detections=seen,
        teammate_detections=no_detections(),
        teammates=("r1",),
        notes=tuple(notes),
        positions_ns=gps_ns,
        positions=gps,
        fixes_ns=fixes_ns,
        fixes=fixes,
    )
    if world.duration_s is None:
        return whole
    return whole.until(start_ns + round(world.duration_s * 1e9))


def _read_car(
    odometry: CsvTable, detections: CsvTable, labels: UInt32[np.ndarray, " R"]
) -> tuple[Intervals, Detections]:
    """Convert a car's tables; the first row also holds before its time."""
    stamps, seen_ns = odometry.stamps("t_s"), detections.stamps("t_s")
    if not len(stamps):
        raise odometry.fault("no row")
    first = min(int(seen_ns.min(initial=stamps[0])), int(stamps[0]))
    values = odometry.numbers(*CAR[1:])
    if first < stamps[0]:
        stamps = np.concatenate(([first], stamps))
        values = np.concatenate((values[:1], values))
    duration = np.diff(stamps)
    if (duration <= 0).any():
        raise odometry.fault("t_s does not ascend")
    intervals = Intervals(
        stamps[1:], duration, values[:-1, 0].copy(), values[:-1, 1].copy(), steered=True
    )
    polar = detections.numbers("range_m", "bearing_rad")
    diameters = detections.numbers("diameter_m")[:, 0] if detections.has("diameter_m") else None
    return intervals, scans_of(detections, seen_ns, *_columns(polar), labels, None, diameters)


def _read_steps(
    odometry: CsvTable, detections: CsvTable, labels: UInt32[np.ndarray, " R"]
) -> tuple[Intervals, Detections]:
    steps = _steps(odometry)
    if not np.array_equal(steps, np.arange(len(steps))):
        raise odometry.fault("step does not count from 0 by ones")
    ends = (steps + 1) * STEP_NS
    increments = odometry.numbers(*STEPS[1:])
    covariances = turn_covariance(matrices(odometry.numbers(*POSE_COVARIANCE)), increments[:, 2])
    intervals = moved(ends, np.full(len(ends), STEP_NS), increments, covariances)
    x, y = detections.numbers("x_m", "y_m").T
    ranges = np.maximum(np.hypot(x, y), 1e-3)
    polar = np.column_stack((ranges, np.arctan2(y, x)))
    claimed = polar_covariances(x, y, ranges, detections.numbers("c_xx", "c_xy", "c_yy"))
    stamps = (_steps(detections) + 1) * STEP_NS
    return intervals, scans_of(detections, stamps, *_columns(polar), labels, claimed, None)


def _columns(
    polar: Float[np.ndarray, "R 2"],
) -> tuple[Float[np.ndarray, " R"], Float[np.ndarray, " R"]]:
    return polar[:, 0].copy(), np.pi - np.remainder(np.pi - polar[:, 1], 2.0 * np.pi)


def _steps(table: CsvTable) -> Int64[np.ndarray, " rows"]:
    return table.numbers("step")[:, 0].astype(np.int64)


def _name_by_labels(seen: Detections) -> Detections:
    chosen = seen.ids != NO_LABEL
    _, first = np.unique(np.column_stack((seen.message_of, seen.ids)), axis=0, return_index=True)
    once = np.zeros(len(chosen), np.bool_)
    once[first] = True
    return replace(seen.where(chosen & once), hidden=None, signatures=None)


def _reference(root: Path) -> tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    if not (root / "reference_landmarks.csv").is_file():
        return np.empty(0, np.uint32), np.empty((0, 2))
    table = _table(root, "reference_landmarks.csv", "landmark", "x_m", "y_m")
    ids = table.names("landmark")
    order = np.argsort(ids)
    return ids[order], table.numbers("x_m", "y_m")[order]


def _positions(
    root: Path,
) -> tuple[Int64[np.ndarray, " G"] | None, Float[np.ndarray, "G 2"] | None]:
    if not (root / "gps.csv").is_file():
        return None, None
    table = _table(root, "gps.csv", "t_s", "x_m", "y_m")
    return table.stamps("t_s"), table.numbers("x_m", "y_m")


def pieces(whole: RobotStream, count: int) -> tuple[RobotStream, ...]:
    """Cut a log into robots of equal interval counts and unknown initial poses."""
    intervals = whole.intervals
    bounds = np.linspace(0, len(intervals.end_ns), count + 1).astype(np.int64)
    names = tuple(f"r{i + 1}" for i in range(count))
    zero_ns = int(whole.stamps_ns[0])
    return tuple(
        _piece(whole, names, i, (int(bounds[i]), int(bounds[i + 1])), zero_ns) for i in range(count)
    )


def _piece(
    whole: RobotStream, names: tuple[str, ...], index: int, part: tuple[int, int], zero_ns: int
) -> RobotStream:
    intervals = whole.intervals
    chosen = np.zeros(len(intervals.end_ns), np.bool_)
    chosen[part[0] : part[1]] = True
    own = intervals.where(chosen)
    begin_ns, end_ns = int(own.end_ns[0] - own.duration_ns[0]), int(own.end_ns[-1])
    back = begin_ns - zero_ns
    seen = whole.landmark_detections
    # A scan at an interval's end belongs to it; one at the first start to the first.
    mine = seen.within(begin_ns + (index > 0), end_ns)
    truth_ns, truth = _cut_values(whole.truth_ns, whole.truth, begin_ns, end_ns, back)
    gps_ns, gps = _cut_values(whole.positions_ns, whole.positions, begin_ns, end_ns, back)
    fixed = (whole.fixes_ns > begin_ns - (index == 0)) & (whole.fixes_ns <= end_ns)
    return RobotStream(
        robot=names[index],
        start_ns=zero_ns,
        start=None,
        intervals=replace(own, end_ns=own.end_ns - back),
        landmark_detections=replace(mine, stamps_ns=mine.stamps_ns - back),
        teammate_detections=no_detections(),
        teammates=names,
        truth_ns=truth_ns,
        truth=truth,
        notes=(*whole.notes, f"it begins {back * 1e-9:.2f} s into the log"),
        positions_ns=gps_ns,
        positions=gps,
        fixes_ns=whole.fixes_ns[fixed] - back,
        fixes=whole.fixes[fixed],
    )


def _cut_values(
    stamps_ns: Int64[np.ndarray, " G"] | None,
    values: Float[np.ndarray, "G n"] | None,
    begin_ns: int,
    end_ns: int,
    back_ns: int,
) -> tuple[Int64[np.ndarray, " K"] | None, Float[np.ndarray, "K n"] | None]:
    if stamps_ns is None or values is None:
        return None, None
    inside = (stamps_ns >= begin_ns) & (stamps_ns <= end_ns)
    return stamps_ns[inside] - back_ns, values[inside]
