"""Convert rows of UTIAS tables to ordered measurements, with notes on dropped rows."""

from collections.abc import Mapping

import numpy as np

from teamslam.sim.datasets.scans import Scans, count_note, first_of_each, on_circle
from teamslam.sim.world.streams import Intervals
from teamslam.team.shapes import Float, Int64

LONG_GAP_NS = 2_000_000_000
"""Least reported gap in odometry or truth."""

START_WINDOW_NS = 200_000_000
"""Time around a robot's first measurement from which the initial pose is computed."""

START_SPREAD_RAD = 0.2
"""Largest heading difference [rad] within that time (the base turns at most 0.58 rad/s)."""


def nanoseconds(seconds: Float[np.ndarray, " N"]) -> Int64[np.ndarray, " N"]:
    """Round seconds to the microsecond, the precision of a double since 1970."""
    return np.rint(seconds * 1e6).astype(np.int64) * 1000


def intervals_of(
    rows: Float[np.ndarray, "N 3"], delay_ns: int
) -> tuple[Intervals, tuple[str, ...]]:
    """Odometry rows (t, v, ω): row k acts over [t_k, t_{k+1}] + delay."""
    rows, backward = _sort_by_time(rows)
    stamps = nanoseconds(rows[:, 0]) + delay_ns
    duration = np.diff(stamps)
    lasting = duration > 0
    intervals = Intervals(
        end_ns=stamps[1:][lasting],
        duration_ns=duration[lasting],
        forward=rows[:-1, 1][lasting],
        yaw_rate=rows[:-1, 2][lasting],
    )
    notes = [
        count_note(backward, "odometry row", "earlier than the row before: sorted by time"),
        count_note(
            int(np.count_nonzero(~lasting)),
            "odometry row",
            "dropped: another row has the same time",
        ),
    ]
    if np.any(duration > LONG_GAP_NS):
        seconds = duration.max() * 1e-9
        notes.append(f"odometry has a gap of {seconds:.1f} s: its last velocities hold over it")
    return intervals, tuple(filter(None, notes))


def measurements_of(
    rows: Float[np.ndarray, "N 4"], subject_of: Mapping[int, int]
) -> tuple[Scans, tuple[str, ...]]:
    """Convert measurement rows (t, barcode, range, bearing) to measurements by subject."""
    rows, backward = _sort_by_time(rows)
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
    notes = (
        count_note(backward, "measurement", "earlier than the row before: sorted by time"),
        count_note(int(np.count_nonzero(~known)), "measurement", "dropped: unknown barcode"),
        count_note(
            int(np.count_nonzero(known & ~positive)), "measurement", "dropped: range not above 0"
        ),
        count_note(
            int(np.count_nonzero(usable & ~single)),
            "measurement",
            "dropped: a second one of the same subject at the same time",
        ),
    )
    return measurements.where(single), tuple(filter(None, notes))


def truth_of(
    rows: Float[np.ndarray, "N 4"],
) -> tuple[Int64[np.ndarray, " N"], Float[np.ndarray, "N 3"], tuple[str, ...]]:
    """Unchanged ground truth rows (t, x, y, θ) by time."""
    rows, backward = _sort_by_time(rows)
    stamps = nanoseconds(rows[:, 0])
    notes = [
        count_note(backward, "ground truth row", "earlier than the row before: sorted by time")
    ]
    gaps = np.diff(stamps)
    if np.any(gaps > LONG_GAP_NS):
        notes.append(f"ground truth has gaps, the longest of {gaps.max() * 1e-9:.1f} s")
    return stamps, rows[:, 1:].copy(), tuple(filter(None, notes))


def start_pose(
    truth_ns: Int64[np.ndarray, " T"], truth: Float[np.ndarray, "T 3"], start_ns: int
) -> Float[np.ndarray, "3"] | None:
    """True pose at start_ns, interpolated on the circle, or None.

    Resampled truth has wrong headings beside ±π, so only samples about the start that agree with
    the one nearest to all others count.
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


def _sort_by_time(rows: Float[np.ndarray, "N C"]) -> tuple[Float[np.ndarray, "N C"], int]:
    """Sort rows stably by the first column; also returns the number of backward steps."""
    backward = int(np.count_nonzero(np.diff(rows[:, 0]) < 0.0))
    return (rows[np.argsort(rows[:, 0], kind="stable")] if backward else rows), backward
