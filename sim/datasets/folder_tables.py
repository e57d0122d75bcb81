"""The tables of one robot in a data set's folder → its measurements in order of time.

What is not handed out is dropped, and a note counts it with its reason and first line.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt32

from sim.datasets.csv_table import CsvTable
from sim.datasets.utias_rows import counted, first_of_each, on_circle
from sim.world.streams import Detections, Intervals, StartPose, grouped, moved

SPEEDS = ("forward_m_s", "yaw_rate_rad_s")
POSES = ("x_m", "y_m", "theta_rad")
INCREMENTS = ("dx_m", "dy_m", "dtheta_rad")
STEERED = ("wheel_speed_m_s", "steering_rad")
ODOMETRY_FORMS = (SPEEDS, POSES, INCREMENTS, STEERED)
POLAR = ("range_m", "bearing_rad")
POINTS = ("x_m", "y_m")
POSE_COVARIANCE = ("c_xx", "c_xy", "c_yy", "c_xt", "c_yt", "c_tt")
POINT_COVARIANCE = ("c_xx", "c_xy", "c_yy")
POLAR_COVARIANCE = ("c_rr", "c_rb", "c_bb")
NOT_A_COVARIANCE = "its covariance is not positive definite"
LATE = "after its last odometry, where its motion is not known"
LONG_GAP_NS = 2_000_000_000


class Rows:
    """A table's rows in order of time, and the notes about those that are left out."""

    def __init__(self, table: CsvTable, thing: str) -> None:
        self.thing = thing
        self.notes: list[str] = []
        stamps = table.stamps("t_s")
        back = np.flatnonzero(np.diff(stamps) < 0)
        if len(back):
            self._note(
                len(back), "earlier than the row before: sorted by time", table, int(back[0]) + 1
            )
        order = np.argsort(stamps, kind="stable").tolist() if len(back) else range(len(table))
        columns = {name: [cells[i] for i in order] for name, cells in table.columns.items()}
        self.table = CsvTable(table.name, columns, [table.lines[i] for i in order])
        self.stamps_ns = stamps[list(order)]

    def drop(self, dropped: Bool[np.ndarray, " rows"], reason: str) -> None:
        """Leave these rows out."""
        if not dropped.any():
            return
        first = int(np.flatnonzero(dropped)[0])
        self._note(int(np.count_nonzero(dropped)), f"dropped: {reason}", self.table, first)
        self.table = self.table.rows((~dropped).tolist())
        self.stamps_ns = self.stamps_ns[~dropped]

    def take_out(self, chosen: Bool[np.ndarray, " rows"]) -> Int64[np.ndarray, " chosen"]:
        """The times of these rows, which are no fault and go elsewhere."""
        stamps: Int64[np.ndarray, " chosen"] = self.stamps_ns[chosen]
        if chosen.any():
            self.table = self.table.rows((~chosen).tolist())
            self.stamps_ns = self.stamps_ns[~chosen]
        return stamps

    def equal(self, column: str, names: Sequence[str]) -> Bool[np.ndarray, " rows"]:
        """Where a column has one of these names."""
        among = set(names)
        return np.array([cell in among for cell in self.table.columns[column]], dtype=np.bool_)

    def _note(self, count: int, what: str, table: CsvTable, row: int) -> None:
        where = "first at" if count > 1 else "at"
        note = counted(count, self.thing, what)
        self.notes.append(f"{note} ({table.name}, {where} line {table.lines[row]})")


def intervals_of(table: CsvTable | None, offset_ns: int) -> tuple[Intervals, list[str]]:
    """Odometry in any of its forms; stamps are moved by offset_ns, the offset of its clock.

    Speeds hold from t_s to the next row's, and the last row only ends the last interval; with a
    column duration_s they are the means over the time that ends at t_s. Poses are of t_s; an
    increment ends at t_s and begins at the row before; its covariance is of an error in the frame
    of its end. A car's wheel speed and steering hold as speeds do.
    """
    if table is None:
        none = np.empty(0, np.int64)
        return Intervals(none, none, np.empty(0), np.empty(0)), []
    rows = Rows(table, "odometry row")
    form = _form(table)
    rows.drop(
        np.diff(rows.stamps_ns, prepend=rows.stamps_ns[:1] - 1) <= 0,
        "another row has the same time, so it lasts no time",
    )
    stamps = rows.stamps_ns + offset_ns
    numbers = rows.table.numbers(*form)
    duration = np.diff(stamps)
    if form == POSES:
        steps = between(numbers)
        ends = stamps[1:]
    elif form in (SPEEDS, STEERED) and not table.has("duration_s"):
        steps, ends = numbers[:-1], stamps[1:]
    else:
        steps, ends = numbers, stamps
        duration = np.concatenate([_first_duration(rows, duration), duration])[: len(stamps)]
    if len(duration) and duration.max() > LONG_GAP_NS:
        seconds = duration.max() * 1e-9
        rows.notes.append(f"odometry has a gap of {seconds:.1f} s: one interval lasts as long")
    if form in (SPEEDS, STEERED):
        forward, yaw_rate = steps.T.copy() if len(steps) else np.zeros((2, 0))
        intervals = Intervals(ends, duration, forward, yaw_rate, steered=form == STEERED)
    else:
        intervals = moved(ends, duration, steps, _claimed(rows, form))
    return intervals, rows.notes


def _claimed(rows: Rows, form: tuple[str, ...]) -> Float[np.ndarray, "N 3 3"] | None:
    """The increments' own covariances; None where they claim none."""
    table = rows.table
    if not any(table.has(column) for column in POSE_COVARIANCE):
        return None
    if form != INCREMENTS or not table.has(*POSE_COVARIANCE):
        raise table.fault(
            f"covariances ({','.join(POSE_COVARIANCE)}) come with {','.join(INCREMENTS)}, all six"
        )
    covariances = matrices(table.numbers(*POSE_COVARIANCE))
    for row in np.flatnonzero(np.linalg.eigvalsh(covariances)[:, 0] <= 0.0)[:1].tolist():
        raise table.error(row, "c_xx", NOT_A_COVARIANCE)
    return covariances


def matrices(packed: Float[np.ndarray, "N 6"]) -> Float[np.ndarray, "N 3 3"]:
    """Of (xx, xy, yy, xt, yt, tt)."""
    return packed[:, [0, 1, 3, 1, 2, 4, 3, 4, 5]].reshape(-1, 3, 3)


def _form(table: CsvTable) -> tuple[str, ...]:
    found = [form for form in ODOMETRY_FORMS if table.has(*form)]
    if len(found) == 1:
        return found[0]
    forms = " or ".join(",".join(form) for form in ODOMETRY_FORMS)
    what = "more than one form of odometry" if found else "no odometry"
    raise table.fault(f"{what} in its columns; give t_s with one of {forms}")


def _first_duration(rows: Rows, others: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, "1"]:
    """How long the first row's interval lasts; as long as the second's where nothing says so."""
    if rows.table.has("duration_s") and len(rows.table):
        first = rows.table.rows([True]).stamps("duration_s")
        if first[0] <= 0:
            raise rows.table.error(0, "duration_s", "not above 0")
        return first
    rows.notes.append("the first increment is taken to last as long as the second")
    return others[:1] if len(others) else np.array([10**9])


def between(poses: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """Each pose but the first in the frame of the pose before: (forward, left, turn)."""
    dx, dy, turn = np.diff(poses, axis=0).T if len(poses) > 1 else np.zeros((3, 0))
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, on_circle(turn)])


@dataclass(frozen=True)
class Scans:
    """Measurements of landmarks, or of teammates by index, in order of time."""

    stamps_ns: Int64[np.ndarray, " R"]
    ids: UInt32[np.ndarray, " R"]
    ranges: Float[np.ndarray, " R"]
    bearings: Float[np.ndarray, " R"]
    points: Float[np.ndarray, "R 2"] | None = None
    covariances: Float[np.ndarray, "R 3"] | None = None

    def where(self, chosen: Bool[np.ndarray, " R"]) -> "Scans":
        """The chosen ones."""
        return Scans(
            self.stamps_ns[chosen],
            self.ids[chosen],
            self.ranges[chosen],
            self.bearings[chosen],
            None if self.points is None else self.points[chosen],
            None if self.covariances is None else self.covariances[chosen],
        )

    def grouped(self) -> Detections:
        """One message per stamp."""
        return grouped(
            self.stamps_ns, self.ids, self.ranges, self.bearings, self.points, self.covariances
        )


def measurements_of(
    table: CsvTable | None,
    thing: str,
    team: tuple[str, Sequence[str]] | None,
    end_ns: int | None,
) -> tuple[Scans, Int64[np.ndarray, " E"], list[str]]:
    """Measurements up to end_ns of landmarks, or of teammates as indices into the team's names
    (team: the robot itself, and all of them); and when the robot looked and saw nothing, which a
    row says that has a time alone.
    """
    if table is None:
        none = np.empty(0, np.int64)
        empty = Scans(none, none.astype(np.uint32), np.empty(0), np.empty(0))
        return empty, none, []
    rows = Rows(table, thing)
    looked = rows.take_out(
        ~np.array([any(cells[1:]) for cells in _cells(rows.table)], dtype=np.bool_)
    )
    column = "landmark" if team is None else "teammate"
    if team is not None:
        own, names = team
        rows.drop(rows.equal(column, [own]), "of itself")
        rows.drop(~rows.equal(column, names), "of a robot that is not in the team")
        places = {name: i for i, name in enumerate(names)}
        ids = np.array([places[name] for name in rows.table.columns[column]], dtype=np.uint32)
    else:
        ids = rows.table.names(column)
    found = _scans(rows, ids, claims=team is None)

    def keep(kept: Bool[np.ndarray, " rows"], otherwise: str) -> Scans:
        rows.drop(~kept, otherwise)
        return found.where(kept)

    found = keep(found.ranges > 0.0, "range not above 0")
    if found.covariances is not None:
        aa, ab, bb = found.covariances.T
        found = keep((aa > 0.0) & (aa * bb > ab * ab), NOT_A_COVARIANCE)
    single = first_of_each(found.stamps_ns, found.ids, np.ones(len(found.ids), np.bool_))
    found = keep(single, f"a second one of the same {column} at the same time")
    if end_ns is not None:
        found = keep(found.stamps_ns <= end_ns, LATE)
        looked = looked[looked <= end_ns]
    return found, looked, rows.notes


def _cells(table: CsvTable) -> list[tuple[str, ...]]:
    """Row by row, the time first."""
    columns = [table.columns["t_s"], *(c for name, c in table.columns.items() if name != "t_s")]
    return list(zip(*columns, strict=True))


def _scans(rows: Rows, ids: UInt32[np.ndarray, " R"], *, claims: bool) -> Scans:
    """Ranges and bearings or points, with what the detector claims of them if it may."""
    table, stamps = rows.table, rows.stamps_ns
    if table.has(*POLAR):
        ranges, bearings = table.numbers(*POLAR).T
        claimed = _own(table, POLAR_COVARIANCE) if claims else None
        return Scans(stamps, ids, ranges.copy(), on_circle(bearings), None, claimed)
    if not table.has(*POINTS):
        raise table.fault(
            f"no measurement in its columns; give {','.join(POLAR)} or {','.join(POINTS)}"
        )
    points = table.numbers(*POINTS)
    x, y = points.T
    ranges, bearings = np.hypot(x, y), on_circle(np.arctan2(y, x))
    claimed = _own(table, POINT_COVARIANCE) if claims else None
    return Scans(stamps, ids, ranges, bearings, points if claims else None, claimed)


def _own(table: CsvTable, columns: tuple[str, ...]) -> Float[np.ndarray, "R 3"] | None:
    other = {*POLAR_COVARIANCE, *POINT_COVARIANCE} - {*columns}
    wrong = [column for column in other if table.has(column)]
    if wrong or any(table.has(c) for c in columns) != table.has(*columns):
        raise table.fault(f"a covariance here has the columns {','.join(columns)}, all three")
    return table.numbers(*columns) if table.has(*columns) else None


def truth_of(
    table: CsvTable | None,
) -> tuple[Int64[np.ndarray, " N"], Float[np.ndarray, "N 3"], list[str]]:
    """True poses in order of time."""
    if table is None:
        return np.empty(0, np.int64), np.zeros((0, 3)), []
    rows = Rows(table, "true pose")
    return rows.stamps_ns, rows.table.numbers(*POSES), rows.notes


def start_of(table: CsvTable) -> StartPose | None:
    """The initial pose of a table with one row; None of one without a row."""
    if not len(table):
        return None
    if len(table) > 1:
        raise table.fault(f"{len(table)} rows: one pose is where a robot starts")
    pose = table.numbers(*POSES)[0]
    if not table.has(*POSE_COVARIANCE):
        return StartPose(pose, None)
    covariance = matrices(table.numbers(*POSE_COVARIANCE))[0]
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise table.error(0, "c_xx", NOT_A_COVARIANCE)
    return StartPose(pose, covariance)


def landmarks_of(
    table: CsvTable,
) -> tuple[UInt32[np.ndarray, " M"], Float[np.ndarray, "M 2"]]:
    """True landmarks, ascending."""
    ids, positions = table.names("landmark"), table.numbers(*POINTS)
    order = np.argsort(ids, kind="stable")
    again = np.flatnonzero(np.diff(ids[order]) == 0)
    if len(again):
        raise table.error(int(order[again[0] + 1]), "landmark", "a second position of one landmark")
    return ids[order], positions[order]
