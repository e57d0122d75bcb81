"""The tables of one robot in a data set's folder → its measurements in order of time.

What is not handed out is dropped, and a note counts it with its reason and first line.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt32

from sim.datasets.csv_table import CsvTable
from sim.datasets.utias_rows import Measurements, counted, first_of_each, on_circle
from sim.world.streams import Intervals, StartPose

SPEEDS = ("forward_m_s", "yaw_rate_rad_s")
POSES = ("x_m", "y_m", "theta_rad")
INCREMENTS = ("dx_m", "dy_m", "dtheta_rad")
ODOMETRY_FORMS = (SPEEDS, POSES, INCREMENTS)
POLAR = ("range_m", "bearing_rad")
POINTS = ("x_m", "y_m")
POSE_COVARIANCE = ("c_xx", "c_xy", "c_yy", "c_xt", "c_yt", "c_tt")
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
    increment ends at t_s and begins at the row before.
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
    elif form == SPEEDS and not table.has("duration_s"):
        steps, ends = numbers[:-1], stamps[1:]
    else:
        steps, ends = numbers, stamps
        duration = np.concatenate([_first_duration(rows, duration), duration])[: len(stamps)]
    if len(duration) and duration.max() > LONG_GAP_NS:
        seconds = duration.max() * 1e-9
        rows.notes.append(f"odometry has a gap of {seconds:.1f} s: one interval lasts as long")
    if form == SPEEDS:
        forward, yaw_rate = steps.T.copy() if len(steps) else np.zeros((2, 0))
    else:
        forward, yaw_rate = _speeds(steps, duration)
    return Intervals(ends, duration, forward, yaw_rate), rows.notes


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


def _speeds(
    steps: Float[np.ndarray, "N 3"], duration_ns: Int64[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """The arc of each increment: what is lateral to it is left out."""
    x, y, turn = steps.T
    seconds = duration_ns * 1e-9
    half = 0.5 * turn
    chord = np.cos(half) * x + np.sin(half) * y
    return chord / np.sinc(half / np.pi) / seconds, turn / seconds


def measurements_of(
    table: CsvTable | None,
    thing: str,
    team: tuple[str, Sequence[str]] | None,
    end_ns: int | None,
) -> tuple[Measurements, Int64[np.ndarray, " E"], list[str]]:
    """Measurements up to end_ns of landmarks, or of teammates as indices into the team's names
    (team: the robot itself, and all of them); and when the robot looked and saw nothing, which a
    row says that has a time alone.
    """
    if table is None:
        none = np.empty(0, np.int64)
        empty = Measurements(none, none.astype(np.uint32), np.empty(0), np.empty(0))
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
    ranges, bearings = _polar(rows.table)
    kept = ranges > 0.0
    rows.drop(~kept, "range not above 0")
    found = Measurements(rows.stamps_ns, ids[kept], ranges[kept], bearings[kept])
    kept = first_of_each(found.stamps_ns, found.subjects, np.ones(len(rows.table), np.bool_))
    rows.drop(~kept, f"a second one of the same {column} at the same time")
    found = found.where(kept)
    if end_ns is not None:
        kept = found.stamps_ns <= end_ns
        rows.drop(~kept, "after its last odometry, where its motion is not known")
        found, looked = found.where(kept), looked[looked <= end_ns]
    return found, looked, rows.notes


def _cells(table: CsvTable) -> list[tuple[str, ...]]:
    """Row by row, the time first."""
    columns = [table.columns["t_s"], *(c for name, c in table.columns.items() if name != "t_s")]
    return list(zip(*columns, strict=True))


def _polar(table: CsvTable) -> tuple[Float[np.ndarray, " R"], Float[np.ndarray, " R"]]:
    if table.has(*POLAR):
        numbers = table.numbers(*POLAR)
        return numbers[:, 0].copy(), on_circle(numbers[:, 1])
    if table.has(*POINTS):
        x, y = table.numbers(*POINTS).T
        return np.hypot(x, y), on_circle(np.arctan2(y, x))
    raise table.fault(
        f"no measurement in its columns; give {','.join(POLAR)} or {','.join(POINTS)}"
    )


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
    xx, xy, yy, xt, yt, tt = table.numbers(*POSE_COVARIANCE)[0]
    covariance = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise table.error(0, "c_xx", "the covariance is not positive definite")
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
