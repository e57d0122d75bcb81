"""Convert a robot's tables to ordered measurements; unused rows are counted in notes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from teamslam.sim.datasets.csv_table import (
    POSE_COVARIANCE,
    CsvTable,
    covariances_of,
    numbers_in,
    pose_covariances,
)
from teamslam.sim.datasets.tables import Scans, count_note, first_of_each, on_circle
from teamslam.sim.world.streams import StartPose
from teamslam.team.shapes import Bool, Float, Int64, UInt32

SPEEDS = ("forward_m_s", "yaw_rate_rad_s")
POSES = ("x_m", "y_m", "theta_rad")
DEGREE = "0.017453292519943295"
INCREMENTS = ("dx_m", "dy_m", "dtheta_rad")
STEERED = ("wheel_speed_m_s", "steering_rad")
POLAR = ("range_m", "bearing_rad")
POINTS = ("x_m", "y_m")
POINT_COVARIANCE = ("c_xx", "c_xy", "c_yy")
POLAR_COVARIANCE = ("c_rr", "c_rb", "c_bb")
NOT_A_COVARIANCE = (
    "its covariance is not positive definite; where none is known leave its columns out, and the "
    "scenario's noise holds"
)
EARLY = "more than 2 s before its first odometry, where its motion is not known"
LATE = "after its last odometry, where its motion is not known"
EARLY_NS = 2_000_000_000  # longest time by which measurements may precede odometry, at standstill
LEAST_OUTSIDE, MOST_OUTSIDE = 5, 0.9
"""Number and share of a table's rows that may be outside the odometry's times."""
UNITS = (
    ("milliseconds", "1e-3", 10**3),
    ("microseconds", "1e-6", 10**6),
    ("nanoseconds", "1e-9", 10**9),
)
UNEQUAL = 2.0  # greatest ratio of two spans of one recording in one unit
FAR_M = 1_000.0  # median range [m] above which metres are improbable
LEAST_BELOW, MOST_BELOW = 2, 0.1  # number and share of ranges that may be below 0 by chance
MOST_RAD = 2.0 * np.pi + 1e-3  # largest bearing that can be in radians

CHORD_M, LEAST_CHORDS = 0.2, 20
"""Length of a path's chords [m], and the least number that shows the unit of its headings."""
FOLLOWS, DIFFERS = 0.9, 0.5
"""Concentration of headings about the motion in the right unit, at least, and in the wrong one, at
most.
"""


class Rows:
    """Ordered rows, and notes on omitted ones."""

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
        self.table = replace(table, columns=columns, lines=[table.lines[i] for i in order])
        self.stamps_ns = stamps[list(order)]

    def drop(self, dropped: Bool[np.ndarray, " rows"], reason: str) -> None:
        """Remove these rows with a note."""
        if not dropped.any():
            return
        first = int(np.flatnonzero(dropped)[0])
        self._note(int(np.count_nonzero(dropped)), f"dropped: {reason}", self.table, first)
        self.table = self.table.rows((~dropped).tolist())
        self.stamps_ns = self.stamps_ns[~dropped]

    def take_out(self, chosen: Bool[np.ndarray, " rows"]) -> Int64[np.ndarray, " chosen"]:
        """Remove these rows without a note; return their times."""
        stamps: Int64[np.ndarray, " chosen"] = self.stamps_ns[chosen]
        if chosen.any():
            self.table = self.table.rows((~chosen).tolist())
            self.stamps_ns = self.stamps_ns[~chosen]
        return stamps

    def equal(self, column: str, names: Sequence[str]) -> Bool[np.ndarray, " rows"]:
        """Mask of rows with one of these names."""
        among = set(names)
        return np.array([cell in among for cell in self.table.columns[column]], dtype=np.bool_)

    def note(self, chosen: Bool[np.ndarray, " rows"], what: str) -> None:
        """Note a remark about rows that stay."""
        if chosen.any():
            first = int(np.flatnonzero(chosen)[0])
            self._note(int(np.count_nonzero(chosen)), what, self.table, first)

    def _note(self, count: int, what: str, table: CsvTable, row: int) -> None:
        where = "first at" if count > 1 else "at"
        note = count_note(count, self.thing, what)
        self.notes.append(f"{note} ({table.name}, {where} line {table.lines[row]})")


def measurements_of(
    table: CsvTable | None,
    thing: str,
    team: tuple[str, Sequence[str]] | None,
    driven: tuple[int, int] | None,
) -> tuple[Scans, Int64[np.ndarray, " E"], list[str]]:
    """Measurements of landmarks, or of teammates by index, and the times of empty rows.

    team: own name and all names. driven: begin and end of the odometry.
    """
    if table is None:
        none = np.empty(0, np.int64)
        empty = Scans(none, none.astype(np.uint32), np.empty(0), np.empty(0))
        return empty, none, []
    rows = Rows(table, thing)
    if driven is not None:
        _check_clock(rows, driven)
    measured = (cells for name, cells in rows.table.columns.items() if name != "t_s")
    empty_ns = rows.take_out(
        ~np.array([any(cells) for cells in zip(*measured, strict=True)], dtype=np.bool_)
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

    def keep(chosen: Bool[np.ndarray, " rows"], otherwise: str) -> Scans:
        rows.drop(~chosen, otherwise)
        return found.where(chosen)

    if len(found.ranges) and np.median(found.ranges) > FAR_M:
        rows.notes.append(
            f"the median range is {np.median(found.ranges):,.0f} m "
            f"({rows.table.name}): ranges must be in metres; "
            f"{rows.table.conversion('range_m', 'millimetres', '0.001')}"
        )
    found = keep(found.ranges > 0.0, "range not above 0")
    if found.covariances is not None:
        aa, ab, bb = found.covariances.T
        found = keep(np.isnan(aa) | ((aa > 0.0) & (aa * bb > ab * ab)), NOT_A_COVARIANCE)
    single = first_of_each(found.stamps_ns, found.ids, np.ones(len(found.ids), np.bool_))
    found = keep(single, f"a second one of the same {column} at the same time")
    if driven is not None:
        begin_ns, end_ns = driven
        found = keep(found.stamps_ns <= end_ns, LATE)
        found = keep(found.stamps_ns >= begin_ns - EARLY_NS, EARLY)
        empty_ns = empty_ns[(empty_ns <= end_ns) & (empty_ns >= begin_ns - EARLY_NS)]
    return found, empty_ns, rows.notes


def _check_clock(rows: Rows, driven: tuple[int, int], *, may_outlast: bool = False) -> None:
    problem = clock_problem(rows.table, rows.stamps_ns, driven, may_outlast=may_outlast)
    if problem is not None:
        row = int(_are_outside(rows.stamps_ns, driven).argmax())
        raise rows.table.error(row, "t_s", problem)


def clock_problem(
    table: CsvTable,
    stamps_ns: Int64[np.ndarray, " R"],
    driven: tuple[int, int],
    *,
    may_outlast: bool = False,
) -> str | None:
    """Describe ordered stamps of another clock or unit than the odometry's, or None.

    No stamp, or fewer than one in ten, is at a time of the odometry. may_outlast: the latter is a
    problem only if the spans differ as units do.
    """
    (first_ns, last_ns), (begin_ns, end_ns) = (int(stamps_ns[0]), int(stamps_ns[-1])), driven
    count = int(np.count_nonzero(_are_outside(stamps_ns, driven)))
    unit = unit_of((last_ns - first_ns) / max(end_ns - begin_ns, 1))
    is_apart = first_ns > end_ns or last_ns < begin_ns - EARLY_NS
    is_mostly = count > max(LEAST_OUTSIDE, MOST_OUTSIDE * len(stamps_ns))
    if not is_apart and (not is_mostly or (may_outlast and unit is None)):
        return None
    remedy = "put them on it by a map of columns (offset, scale)"
    if unit is not None:
        name, scale, times = unit
        remedy = f"its span is about {times:,} times as long, as times in {name} are; "
        remedy += table.conversion("t_s", name, scale)
    share = "" if is_apart else f", {count} of {len(stamps_ns)} rows outside"
    return (
        f"its times, {first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s, are not those of the "
        f"odometry, {begin_ns * 1e-9:.3f} to {end_ns * 1e-9:.3f} s{share}; all tables of a team "
        f"have one clock: {remedy}"
    )


def _are_outside(
    stamps_ns: Int64[np.ndarray, " R"], driven: tuple[int, int]
) -> Bool[np.ndarray, " R"]:
    return (stamps_ns > driven[1]) | (stamps_ns < driven[0] - EARLY_NS)


def unit_of(ratio: float) -> tuple[str, str, int] | None:
    """Name, scale and number per second of the unit that makes a span this many times as long."""
    for name, scale, times in UNITS:
        if times / UNEQUAL < ratio < times * UNEQUAL:
            return name, scale, times
    return None


def _scans(rows: Rows, ids: UInt32[np.ndarray, " R"], *, claims: bool) -> Scans:
    table = rows.table
    forms = [form for form in (POLAR, POINTS) if table.has(*form)]
    if not forms:
        raise table.lack("measurement", (POLAR, POINTS))
    polar, points = (numbers_in(table, form, forms) for form in (POLAR, POINTS))
    ranges, bearings = polar.T.copy()
    check_polar(table, ranges, bearings)
    bearings, as_points = on_circle(bearings), ~np.isnan(points[:, 0])
    x, y = points[as_points].T
    ranges[as_points], bearings[as_points] = np.hypot(x, y), on_circle(np.arctan2(y, x))
    claimed = _own(rows, forms, as_points) if claims else None
    measured = points if claims and as_points.any() else None
    return Scans(rows.stamps_ns, ids, ranges, bearings, measured, claimed)


def check_polar(
    table: CsvTable, ranges: Float[np.ndarray, " R"], bearings: Float[np.ndarray, " R"]
) -> None:
    """Refuse ranges that are bearings, and bearings in degrees; NaN in rows of another form."""
    below = ranges <= 0.0
    count, measured = int(np.count_nonzero(below)), int(np.count_nonzero(~np.isnan(ranges)))
    varied = len(np.unique(ranges[below]))  # few values mark an echo that did not return
    if count > max(LEAST_BELOW, MOST_BELOW * measured) and 2 * varied > count:
        where = "" if table.origin is None else f" in {table.origin.place}"
        raise table.error(
            int(below.argmax()),
            "range_m",
            f"{count} of {measured} ranges are not above 0, as bearings are: exchange range_m and "
            f"bearing_rad{where}",
        )
    for row in np.flatnonzero(np.abs(bearings) > MOST_RAD)[:1].tolist():
        raise table.error(
            row,
            "bearing_rad",
            f"{bearings[row]:g} is more than a whole turn; bearings must be in radians: "
            f"{table.conversion('bearing_rad', 'degrees', DEGREE)}",
        )


def _own(
    rows: Rows, forms: Sequence[tuple[str, ...]], as_points: Bool[np.ndarray, " R"]
) -> Float[np.ndarray, "R 3"] | None:
    table, claimed = rows.table, np.full((len(rows.table), 3), np.nan)
    allowed = [POLAR_COVARIANCE if form == POLAR else POINT_COVARIANCE for form in forms]
    present = {c for c in (*POLAR_COVARIANCE, *POINT_COVARIANCE) if table.has(c)}
    whole = [columns for columns in allowed if table.has(*columns)]
    if present != {column for columns in whole for column in columns}:
        names = " or ".join(",".join(columns) for columns in allowed)
        raise table.fault(f"a covariance here has the columns {names}, all three")
    if not whole:
        return None
    for columns in whole:
        given = covariances_of(table, columns)
        own = as_points if columns == POINT_COVARIANCE else ~as_points
        stray = ~np.isnan(given[:, 0]) & ~own
        table.refuse(stray, columns[0], "a covariance of the form that is not in this row")
        claimed[own] = given[own]
    unclaimed = np.isnan(claimed[:, 0])
    rows.note(unclaimed, "without a covariance, as others have: the sensor's noise holds for it")
    return claimed


def fixes_of(
    table: CsvTable | None, driven: tuple[int, int] | None
) -> tuple[Int64[np.ndarray, " F"], Float[np.ndarray, "F 5"], list[str]]:
    """Times, positions with covariances (x, y, xx, xy, yy; NaN if not stated), and notes."""
    if table is None:
        return np.empty(0, np.int64), np.empty((0, 5)), []
    rows = Rows(table, "position")
    if driven is None:
        rows.drop(np.ones(len(table), np.bool_), "there is no odometry")
    else:
        _check_clock(rows, driven)
        rows.drop(rows.stamps_ns < driven[0], "before its first odometry")
        rows.drop(rows.stamps_ns > driven[1], LATE)
    stated = np.full((len(rows.table), 3), np.nan)
    if any(rows.table.has(column) for column in POINT_COVARIANCE):
        missing = ", ".join(column for column in POINT_COVARIANCE if not rows.table.has(column))
        if missing:
            raise table.fault(
                f"a covariance has all of {','.join(POINT_COVARIANCE)}: {missing} missing"
            )
        stated = covariances_of(rows.table, POINT_COVARIANCE)
        xx, xy, yy = stated.T
        rows.table.refuse(
            ~np.isnan(xx) & ~((xx > 0.0) & (xx * yy > xy * xy)),
            "c_xx",
            "its covariance is not positive definite; leave its cells empty where none is known, "
            "and gnss.sigma_m holds",
        )
    return rows.stamps_ns, np.hstack((rows.table.numbers(*POINTS), stated)), rows.notes


def truth_of(
    table: CsvTable | None, driven: tuple[int, int] | None
) -> tuple[Int64[np.ndarray, " N"], Float[np.ndarray, "N 3"], list[str]]:
    """True poses by time, and notes."""
    if table is None:
        return np.empty(0, np.int64), np.zeros((0, 3)), []
    rows = Rows(table, "true pose")
    if driven is not None:
        _check_clock(rows, driven, may_outlast=True)
    poses = rows.table.numbers(*POSES)
    if _are_degrees(poses):
        row = int((np.abs(poses[:, 2]) > MOST_RAD).argmax())
        raise rows.table.error(
            row,
            "theta_rad",
            f"{poses[row, 2]:g}: the headings follow the path's direction as degrees, and must be "
            f"in radians: {rows.table.conversion('theta_rad', 'degrees', DEGREE)}",
        )
    return rows.stamps_ns, poses, rows.notes


def _are_degrees(poses: Float[np.ndarray, "N 3"]) -> bool:
    """Whether headings θ follow the directions δ of the path's chords in degrees.

    Concentration: |mean of exp(2i(δ − θ))|, at any constant offset. Degrees must explain twice as
    much as θ = 0, which small angles are.
    """
    if len(poses) < LEAST_CHORDS:
        return False
    lengths = np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))
    ends = np.flatnonzero(np.diff(np.append(0.0, lengths) // CHORD_M, prepend=-1.0))
    dx, dy = np.diff(poses[ends, :2], axis=0).T
    straight = np.hypot(dx, dy) > 0.5 * CHORD_M
    if np.count_nonzero(straight) < LEAST_CHORDS:
        return False
    directions = np.arctan2(dy, dx)[straight]
    headings = poses[(ends[:-1] + ends[1:]) // 2, 2][straight]
    in_radians, in_degrees, fixed = (
        abs(np.exp(2j * (directions - scale * headings)).mean())
        for scale in (1.0, float(DEGREE), 0.0)
    )
    explains = 1.0 - in_degrees < 0.5 * (1.0 - fixed)
    return bool(in_degrees > FOLLOWS and in_radians < DIFFERS and explains)


def start_of(table: CsvTable) -> StartPose | None:
    """Initial pose of a one-row table."""
    if not len(table):
        return None
    if len(table) > 1:
        raise table.fault(f"{len(table)} rows: one pose is where a robot starts")
    pose = table.numbers(*POSES)[0]
    if abs(pose[2]) > MOST_RAD:
        raise table.error(
            0,
            "theta_rad",
            f"{pose[2]:g} is more than a whole turn; it must be in radians: "
            f"{table.conversion('theta_rad', 'degrees', DEGREE)}",
        )
    if not any(table.has(column) for column in POSE_COVARIANCE):
        return StartPose(pose, None)
    covariance = pose_covariances(table)[0]
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise table.error(0, "c_xx", NOT_A_COVARIANCE)
    return StartPose(pose, covariance)


def landmarks_of(table: CsvTable) -> tuple[UInt32[np.ndarray, " M"], Float[np.ndarray, "M 2"]]:
    """True landmarks, ascending."""
    ids, positions = table.names("landmark"), table.numbers(*POINTS)
    order = np.argsort(ids, kind="stable")
    repeated = np.flatnonzero(np.diff(ids[order]) == 0)
    if len(repeated):
        raise table.error(
            int(order[repeated[0] + 1]), "landmark", "a second position of one landmark"
        )
    return ids[order], positions[order]
