"""Convert a robot's odometry.csv of any form to ordered intervals."""

import numpy as np

from teamslam.sim.datasets.csv_table import POSE_COVARIANCE, CsvTable, numbers_in, pose_covariances
from teamslam.sim.datasets.folder_tables import (
    DEGREE,
    INCREMENTS,
    NOT_A_COVARIANCE,
    POSES,
    SPEEDS,
    STEERED,
    Rows,
)
from teamslam.sim.datasets.tables import DatasetError, on_circle
from teamslam.sim.world.streams import Intervals, moved
from teamslam.team.config import LEAST_STEPS, RESET_M, RESET_TIMES, USUAL_M_S, Bounds
from teamslam.team.shapes import Bool, Float, Int64

FORMS = (SPEEDS, STEERED, POSES, INCREMENTS)
MIXED = ((SPEEDS, INCREMENTS), (STEERED, INCREMENTS))
LONG_GAP_NS = 2_000_000_000
JUMP_NS = 86_400 * 10**9  # longest step between rows without a clock jump
PACE = "most rows of its odometry are"  # prefix of the note on times in other units
WHIRLING_RAD_S = 10.0
"""Yaw rate [rad/s] above which radians are improbable. Ground robots turn by 1 to 5 rad/s at most;
in degrees even a slow turn of 10 °/s exceeds it.
"""
LEAST_WHIRLS, WHIRLS = 2, 0.01
"""Number and share of the stretches of 1 s in which a robot must turn faster than that."""
SHORTEST_S, LONGEST_S = 1e-4, 5.0  # plausible median odometry interval in seconds
IMPOSSIBLE_S = 60.0  # median odometry interval [s] of no robot
LEAST_OTHERS, MOST_OTHERS = 2, 0.1
"""Number and share of rows that may have the time of another row and other values."""
OFF_NS = 1_000_000
"""A duration deviates if it differs from the time since the previous row by more than this and by a
hundredth.
"""


def intervals_of(table: CsvTable | None, offset_ns: int) -> tuple[Intervals, list[str]]:
    """Convert odometry of any form; stamps are shifted by offset_ns.

    Speeds, and a car's wheel speed and steering, hold from t_s to the next row; with duration_s
    they are means over the time that ends at t_s. Poses are at t_s; an increment spans from the
    previous row to t_s. A covariance is of the row's motion, for an error in the frame of its end;
    speeds with one become increments. With duration_s, speed and increment rows may be mixed.
    """
    if table is None:
        none = np.empty(0, np.int64)
        return Intervals(none, none, np.empty(0), np.empty(0)), []
    rows = Rows(table, "odometry row")
    forms = _forms(table)
    form = forms[0]
    _check_times(rows)
    rows.drop(
        np.diff(rows.stamps_ns, prepend=rows.stamps_ns[:1] - 1) <= 0,
        "another row has the same time",
    )
    _drop_other_clocks(rows)
    stamps = rows.stamps_ns + offset_ns
    numbers = numbers_in(rows.table, form, forms)
    duration = np.diff(stamps)
    used = slice(None)
    if form == POSES:
        steps, ends, used = _motions_between(numbers), stamps[1:], slice(1, None)
        steps = _omit_resets(rows, numbers, steps, duration)
    elif form in (SPEEDS, STEERED) and not table.has("duration_s"):
        steps, ends, used = numbers[:-1], stamps[1:], slice(0, -1)
    else:
        steps, ends = numbers, stamps
        duration = np.concatenate([_first_duration(rows, duration), duration])[: len(stamps)]
        _judge_durations(rows, duration)
    if len(duration) and duration.max() > LONG_GAP_NS:
        seconds = duration.max() * 1e-9
        rows.notes.append(f"odometry has a gap of {seconds:.1f} s: one interval lasts as long")
    claims = _covariances_of(rows, form, used)
    if form in (SPEEDS, STEERED):
        forward, yaw_rate = steps.T.copy() if len(steps) else np.zeros((2, 0))
        motions = numbers_in(rows.table, INCREMENTS, forms)[used]
        if form == SPEEDS and claims is not None:
            arced = ~np.isnan(claims[:, 0, 0]) & np.isnan(motions[:, 0])
            motions[arced] = _arcs(steps[arced], duration[arced])
        as_motions = ~np.isnan(motions[:, 0])
        forward[as_motions], yaw_rate[as_motions] = 0.0, 0.0
        increments = motions if as_motions.any() else None
        intervals = Intervals(
            ends, duration, forward, yaw_rate, form == STEERED, increments, claims
        )
        if len(forms) > 1:
            _judge_speeds(rows, INCREMENTS, motions, duration)
    else:
        intervals = moved(ends, duration, steps, claims)
    rows.notes += pace_notes(duration, table)
    _judge_speeds(rows, form, steps, duration)
    return intervals, rows.notes


def _check_times(rows: Rows) -> None:
    cells = list(zip(*(c for name, c in rows.table.columns.items() if name != "t_s"), strict=True))
    same = (np.flatnonzero(np.diff(rows.stamps_ns) == 0) + 1).tolist()
    others = [row for row in same if cells[row] != cells[row - 1]]
    if len(others) <= max(LEAST_OTHERS, MOST_OTHERS * len(cells)):
        return
    table = rows.table.origin.place if rows.table.origin else "the table [odometry] of a column map"
    raise rows.table.error(
        others[0],
        "t_s",
        f"{len(others)} of {len(cells)} odometry rows have the time of another row with other "
        'values. Rows of several robots: keep those of one by drop = { robot = ["r2", "r3"] } in '
        f"{table}. Rounded times: write them with their decimals (docs/your_data.md)",
    )


def pace_notes(duration_ns: Int64[np.ndarray, " I"], table: CsvTable | None = None) -> list[str]:
    """Note on an implausible interval; an impossible one raises DatasetError."""
    usual_s = 1e-9 * float(np.median(duration_ns)) if len(duration_ns) else SHORTEST_S
    if SHORTEST_S <= usual_s <= LONGEST_S:
        return []
    convert = (table or CsvTable("", {}, [])).conversion
    usual = f"{usual_s:,.0f}" if usual_s > 1.0 else f"{usual_s:.3g}"
    note = (
        f"{PACE} {usual} s apart: times are taken for seconds; "
        f"{convert('t_s', 'other units, as milliseconds', '1e-3')}"
    )
    if table is not None and usual_s > IMPOSSIBLE_S:
        raise DatasetError(f"{table.name}, column t_s: {note}")
    return [note]


def _drop_other_clocks(rows: Rows) -> None:
    """Keep the longest stretch between clock jumps."""
    jumps = np.flatnonzero(np.diff(rows.stamps_ns) > JUMP_NS) + 1
    if not len(jumps):
        return
    edges = np.concatenate([[0], jumps, [len(rows.stamps_ns)]])
    longest = int(np.diff(edges).argmax())
    chosen = np.zeros(len(rows.stamps_ns), np.bool_)
    chosen[edges[longest] : edges[longest + 1]] = True
    days = float(np.diff(rows.stamps_ns).max()) * 1e-9 / 86_400.0
    rows.drop(
        ~chosen,
        f"by another clock than most rows: it jumps by {days:,.0f} days at most, as where a clock "
        "is set",
    )


def _omit_resets(
    rows: Rows,
    poses: Float[np.ndarray, "N 3"],
    steps: Float[np.ndarray, "M 3"],
    duration: Int64[np.ndarray, " M"],
) -> Float[np.ndarray, "M 3"]:
    """Continue the previous motion across an odometry reset or a wrong row.

    A step of RESET_M is one if it returns to the first pose faster than any usual step, or is
    RESET_TIMES as fast as nine steps of ten.
    """
    lengths, seconds = np.hypot(*steps[:, :2].T), duration * 1e-9
    if len(steps) < LEAST_STEPS:
        return steps
    usual = max(float(np.quantile(lengths / seconds, 0.9)), USUAL_M_S)
    home = (poses[1:] == poses[0]).all(axis=1) & (lengths > 2.0 * usual * seconds)
    reset = (lengths > RESET_M) & (home | (lengths > RESET_TIMES * usual * seconds))
    if not reset.any():
        return steps
    going = np.maximum.accumulate(np.where(reset, -1, np.arange(len(steps))))
    before = np.maximum(going, 0)
    rates = np.where(going[:, np.newaxis] < 0, 0.0, steps[before] / seconds[before, np.newaxis])
    rows.note(
        np.append(False, reset),
        f"at which its pose jumps, by {lengths[reset].max():.1f} m at most: its odometry was reset "
        "there, or the row is wrong; the previous motion is assumed",
    )
    return np.where(reset[:, np.newaxis], rates * seconds[:, np.newaxis], steps)


def _covariances_of(
    rows: Rows, form: tuple[str, ...], used: slice
) -> Float[np.ndarray, "N 3 3"] | None:
    table = rows.table
    if not any(table.has(column) for column in POSE_COVARIANCE):
        return None
    matrices = pose_covariances(table)
    given = ~np.isnan(matrices[:, 0, 0])
    of_motions = given if form != STEERED else _find_filled(table, INCREMENTS)
    table.refuse(
        given & ~of_motions,
        "c_xx",
        f"covariances come with {','.join(SPEEDS)} or {','.join(POSES)} or "
        f"{','.join(INCREMENTS)}; a car's noise stands in the scenario",
    )
    least = np.linalg.eigvalsh(np.where(given[:, np.newaxis, np.newaxis], matrices, np.eye(3)))
    taken = np.zeros(len(table), np.bool_)
    taken[used] = True
    table.refuse(taken & (least[:, 0] <= 0.0), "c_xx", NOT_A_COVARIANCE)
    without = taken & ~given
    rows.note(without, "without a covariance, as others have: the scenario's noise holds for it")
    return matrices[used]


def _find_filled(table: CsvTable, columns: tuple[str, ...]) -> Bool[np.ndarray, " rows"]:
    if not table.has(*columns):
        return np.zeros(len(table), np.bool_)
    return np.asarray(~np.isnan(table.known_numbers(*columns)).any(axis=1))


def _judge_durations(rows: Rows, duration: Int64[np.ndarray, " N"]) -> None:
    if not rows.table.has("duration_s"):
        return
    stated = rows.table.stamps("duration_s")
    rows.table.refuse(stated <= 0, "duration_s", "not above 0")
    off = np.abs(stated - duration) > np.maximum(OFF_NS, duration // 100)
    rows.note(
        off, "whose duration_s is not the time since the row before: it is taken to last as long"
    )


def _judge_speeds(
    rows: Rows,
    form: tuple[str, ...],
    steps: Float[np.ndarray, "N _"],
    duration: Int64[np.ndarray, " N"],
) -> None:
    """Note impossible motions; refuse turns in degrees."""
    if form == STEERED or not len(steps):
        return
    seconds = duration * 1e-9
    if steps.shape[1] == 2:
        speed, rate = np.abs(steps).T
    else:
        speed, rate = np.hypot(*steps[:, :2].T) / seconds, np.abs(steps[:, 2]) / seconds
    turn = next(column for column in form if column.endswith(("rad", "rad_s")))
    first = 1 if form == POSES else 0
    usual_most = _usual_maximum(rate, seconds)
    if usual_most > WHIRLING_RAD_S:
        raise rows.table.error(
            first + int((rate > WHIRLING_RAD_S).argmax()),
            turn,
            f"it turns by {usual_most:.1f} rad/s and more, which no robot does: "
            f"{rows.table.conversion(turn, 'degrees', DEGREE)}",
        )
    bounds = Bounds()
    fast = (speed > bounds.speed_m_s) | (rate > bounds.yaw_rate_rad_s)
    too_fast = np.zeros(len(rows.table), np.bool_)
    too_fast[first : first + len(fast)] = fast
    rows.note(
        too_fast,
        f"beyond {bounds.speed_m_s:g} m/s or {bounds.yaw_rate_rad_s:g} rad/s, which a robot "
        "refuses: metres, radians and seconds are meant",
    )


def _usual_maximum(rate: Float[np.ndarray, " N"], seconds: Float[np.ndarray, " N"]) -> float:
    """Mean yaw rate [rad/s] that LEAST_WHIRLS and a share WHIRLS of stretches of 1 s reach."""
    ends = np.append(0.0, np.cumsum(seconds))
    stretches = min(int(ends[-1]), len(rate))
    if stretches < LEAST_WHIRLS:
        return 0.0
    edges = np.linspace(0.0, ends[-1], 1 + stretches)
    turned = np.append(0.0, np.cumsum(np.nan_to_num(rate) * seconds))
    means = np.sort(np.diff(np.interp(edges, ends, turned)) / edges[1])
    return float(means[-max(LEAST_WHIRLS, int(WHIRLS * stretches))])


def _forms(table: CsvTable) -> tuple[tuple[str, ...], ...]:
    found = tuple(form for form in FORMS if table.has(*form))
    if len(found) == 1 or (found in MIXED and table.has("duration_s")):
        return found
    if not found:
        raise table.lack("odometry", FORMS)
    forms = " or ".join(",".join(form) for form in FORMS)
    raise table.fault(
        f"more than one form of odometry in its columns; give t_s with one of {forms}"
    )


def _first_duration(rows: Rows, others: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, "1"]:
    if rows.table.has("duration_s") and len(rows.table):
        return rows.table.rows([True]).stamps("duration_s")
    rows.notes.append("the first increment is taken to last as long as the second")
    return others[:1] if len(others) else np.array([10**9])


def _arcs(
    speeds: Float[np.ndarray, "N 2"], duration_ns: Int64[np.ndarray, " N"]
) -> Float[np.ndarray, "N 3"]:
    """Chord (forward, left, turn) of the arc at constant speed and yaw rate."""
    ahead, turn = (speeds * (duration_ns * 1e-9)[:, np.newaxis]).T
    chord = ahead * np.sinc(0.5 * turn / np.pi)
    return np.column_stack([chord * np.cos(0.5 * turn), chord * np.sin(0.5 * turn), turn])


def _motions_between(poses: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    dx, dy, turn = np.diff(poses, axis=0).T if len(poses) > 1 else np.zeros((3, 0))
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, on_circle(turn)])
