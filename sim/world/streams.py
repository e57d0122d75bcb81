"""Streams of a world: each robot's measurements in order, and the truth.

One counter spans a robot's measurements in the order (stamp, kind); measurement 0 is the initial
pose. Odometry intervals are contiguous and stamped with their *end*, behind measurements of that
time.
"""

from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, cast

import numpy as np

from teamslam.team.shapes import Bool, Float, Int64, UInt8, UInt32

START = 0
OBSERVATIONS = 1
SIGHTINGS = 2
FIXES = 3
ODOMETRY = 4
NO_LABEL = 2**32 - 1  # identity of clutter, or of an unknown landmark


R = TypeVar("R")


def rows_of(record: R, chosen: np.ndarray) -> R:
    """Chosen rows of every array of a dataclass."""
    arrays = {name: each for name, each in vars(record).items() if isinstance(each, np.ndarray)}
    taken: R = replace(cast(Any, record), **{name: each[chosen] for name, each in arrays.items()})
    return taken


@dataclass(frozen=True)
class StartPose:
    """Pose (x, y, θ) in the team's frame; covariance None: exact."""

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"] | None


@dataclass(frozen=True)
class Intervals:
    """Odometry: end stamp, length, mean forward speed [m/s] and yaw rate [rad/s].

    steered: wheel speed [m/s] and steering angle [rad] instead. increments: poses (x, y, theta) of
    the end in the frame of the start instead; speeds are then zero. covariances: in the frame of
    the end. NaN: absent.
    """

    end_ns: Int64[np.ndarray, " I"]
    duration_ns: Int64[np.ndarray, " I"]
    forward: Float[np.ndarray, " I"]
    yaw_rate: Float[np.ndarray, " I"]
    steered: bool = False
    increments: Float[np.ndarray, "I 3"] | None = None
    covariances: Float[np.ndarray, "I 3 3"] | None = None

    @property
    def as_motions(self) -> Bool[np.ndarray, " I"]:
        """Mask of intervals that measure a motion."""
        if self.increments is None:
            return np.zeros(len(self.end_ns), np.bool_)
        return np.asarray(~np.isnan(self.increments[:, 0]))

    @property
    def claimed(self) -> Bool[np.ndarray, " I"]:
        """Mask of intervals with a covariance."""
        if self.covariances is None:
            return np.zeros(len(self.end_ns), np.bool_)
        return np.asarray(~np.isnan(self.covariances[:, 0, 0]))

    def where(self, chosen: Bool[np.ndarray, " I"]) -> "Intervals":
        """Chosen intervals."""
        return rows_of(self, chosen)


COLUMNS = ("ids", "ranges", "bearings", "points", "covariances", "signatures", "classes")
"""Fields of `Detections` that have a value for each row."""


@dataclass(frozen=True)
class Detections:
    """M range-bearing messages: message m has the rows offsets[m] … offsets[m + 1].

    ids: landmarks, or indices of teammates. points: measured (x, y) in the sensor frame [m], NaN
    for a range and bearing. covariances: (rr, rb, bb), or (xx, xy, yy) of points, NaN if absent;
    alike within a message. hidden: messages published without identities, whose ids are for
    scoring, NO_LABEL for clutter. Of hidden ones only: signatures, similar for the same landmark,
    and classes, ln P(reported class | class).
    """

    stamps_ns: Int64[np.ndarray, " M"]
    offsets: Int64[np.ndarray, " M_plus_1"]
    ids: UInt32[np.ndarray, " R"]
    ranges: Float[np.ndarray, " R"]
    bearings: Float[np.ndarray, " R"]
    points: Float[np.ndarray, "R 2"] | None = None
    covariances: Float[np.ndarray, "R 3"] | None = None
    hidden: Bool[np.ndarray, " M"] | None = None
    signatures: Float[np.ndarray, " R"] | None = None
    classes: Float[np.ndarray, "R C"] | None = None

    def rows(self, message: int) -> slice:
        """Rows of one message."""
        return slice(int(self.offsets[message]), int(self.offsets[message + 1]))

    @property
    def message_of(self) -> Int64[np.ndarray, " R"]:
        """Message of each row."""
        return np.repeat(np.arange(len(self.stamps_ns)), np.diff(self.offsets))

    def within(self, first_ns: int, last_ns: int) -> "Detections":
        """Messages stamped first_ns … last_ns."""
        first, last = np.searchsorted(self.stamps_ns, [first_ns, last_ns + 1])
        return self.only(int(first), int(last))

    def only(self, first: int, last: int) -> "Detections":
        """Messages first … last − 1."""
        offsets = self.offsets[first : last + 1] - self.offsets[first]
        return self._select(
            slice(first, last), offsets, slice(int(self.offsets[first]), int(self.offsets[last]))
        )

    def where(self, rows: Bool[np.ndarray, " R"]) -> "Detections":
        """Chosen rows; messages stay, with or without rows."""
        kept = np.concatenate(([0], np.cumsum(rows)))
        return self._select(slice(None), kept[self.offsets], rows)

    def take(self, messages: Int64[np.ndarray, " N"]) -> "Detections":
        """These messages, in this order."""
        counts = np.diff(self.offsets)[messages]
        first = np.repeat(self.offsets[messages] - np.cumsum(counts) + counts, counts)
        offsets = np.concatenate(([0], np.cumsum(counts)))
        return self._select(messages, offsets, first + np.arange(int(counts.sum())))

    def _select(
        self,
        messages: slice | np.ndarray,
        offsets: Int64[np.ndarray, " N_plus_1"],
        rows: slice | np.ndarray,
    ) -> "Detections":
        columns = {
            name: values[rows] for name in COLUMNS if (values := getattr(self, name)) is not None
        }
        return replace(
            self,
            stamps_ns=self.stamps_ns[messages],
            offsets=offsets.astype(np.int64),
            hidden=None if self.hidden is None else self.hidden[messages],
            **columns,
        )


@dataclass(frozen=True, kw_only=True)
class RobotStream:
    """All measurements of a robot by (stamp, kind), initial pose first; the counter indexes kinds,
    stamps_ns and rows.

    start: at start_ns, None if unknown. rows: row in the arrays of the measurement's kind. truth:
    (x, y, θ) in the team's frame. clock_offset_ns: published odometry stamps read this much less.
    positions: of another sensor, in its own frame, for scoring. fixes: (x, y) [m] in the survey's
    frame with covariances (xx, xy, yy) [m²] or NaN. Raises ValueError for a measurement before the
    initial pose, or non-contiguous odometry.
    """

    robot: str
    start_ns: int
    start: StartPose | None
    intervals: Intervals
    landmark_detections: Detections
    teammate_detections: Detections
    teammates: tuple[str, ...]
    truth_ns: Int64[np.ndarray, " T"] | None = None
    truth: Float[np.ndarray, "T 3"] | None = None
    notes: tuple[str, ...] = ()
    clock_offset_ns: int = 0
    positions_ns: Int64[np.ndarray, " G"] | None = None
    positions: Float[np.ndarray, "G 2"] | None = None
    fixes_ns: Int64[np.ndarray, " F"] = field(default_factory=lambda: np.zeros(0, np.int64))
    fixes: Float[np.ndarray, "F 5"] = field(default_factory=lambda: np.zeros((0, 5)))
    kinds: UInt8[np.ndarray, " N"] = field(init=False)
    stamps_ns: Int64[np.ndarray, " N"] = field(init=False)
    rows: Int64[np.ndarray, " N"] = field(init=False)

    def __post_init__(self) -> None:
        intervals = self.intervals
        parts = (
            np.array([self.start_ns]),
            self.landmark_detections.stamps_ns,
            self.teammate_detections.stamps_ns,
            self.fixes_ns,
            intervals.end_ns,
        )
        stamps = np.concatenate(parts)
        kinds = np.repeat(np.arange(5, dtype=np.uint8), [len(part) for part in parts])
        rows = np.concatenate([np.arange(len(part), dtype=np.int64) for part in parts])
        if stamps.min() < self.start_ns:
            raise ValueError(
                f"{self.robot}: a measurement at {stamps.min()} ns is before its start, "
                f"{self.start_ns}"
            )
        begins = intervals.end_ns - intervals.duration_ns
        for k in np.flatnonzero(begins[1:] != intervals.end_ns[:-1])[:1].tolist():
            ends_s, begins_s = 1e-9 * intervals.end_ns[k], 1e-9 * begins[k + 1]
            raise ValueError(
                f"{self.robot}: odometry intervals are not contiguous in time: one ends at "
                f"{ends_s:.3f} s, the next begins at {begins_s:.3f} s"
            )
        order = np.lexsort((kinds, stamps))
        for name, values in (("kinds", kinds), ("stamps_ns", stamps), ("rows", rows)):
            object.__setattr__(self, name, values[order])

    def __len__(self) -> int:
        """Number of measurements, including the initial pose."""
        return len(self.kinds)

    def until(self, end_ns: int) -> "RobotStream":
        """Stream up to the last odometry interval that ends by end_ns."""
        intervals = self.intervals.where(self.intervals.end_ns <= end_ns)
        last_ns = int(intervals.end_ns[-1]) if len(intervals.end_ns) else end_ns
        truth_ns, truth = self.truth_ns, self.truth
        if truth_ns is not None and truth is not None:
            poses = int(np.searchsorted(truth_ns, end_ns)) + 1
            truth_ns, truth = truth_ns[:poses], truth[:poses]
        fixes = int(np.searchsorted(self.fixes_ns, last_ns, side="right"))
        return replace(
            self,
            intervals=intervals,
            landmark_detections=self.landmark_detections.within(self.start_ns, last_ns),
            teammate_detections=self.teammate_detections.within(self.start_ns, last_ns),
            fixes_ns=self.fixes_ns[:fixes],
            fixes=self.fixes[:fixes],
            truth_ns=truth_ns,
            truth=truth,
        )


@dataclass(frozen=True)
class WorldStreams:
    """Streams of a team, true landmarks by ascending ids (None: unknown), and source name."""

    streams: tuple[RobotStream, ...]
    landmark_ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"] | None
    source: str
    notes: tuple[str, ...] = ()

    @property
    def spans_ns(self) -> dict[str, tuple[int, int]]:
        """First and last stamp of each robot."""
        return {
            each.robot: (int(each.stamps_ns[0]), int(each.stamps_ns[-1])) for each in self.streams
        }

    def order(self) -> tuple[Int64[np.ndarray, " A"], Int64[np.ndarray, " A"]]:
        """Stream indices and counters by (stamp, stream, counter)."""
        lengths = [len(stream) for stream in self.streams]
        stream = np.repeat(np.arange(len(lengths), dtype=np.int64), lengths)
        counter = np.concatenate([np.arange(n, dtype=np.int64) for n in lengths])
        stamps = np.concatenate([each.stamps_ns for each in self.streams])
        by_time = np.lexsort((counter, stream, stamps))
        return stream[by_time], counter[by_time]


def grouped(
    stamps_ns: Int64[np.ndarray, " R"],
    ids: UInt32[np.ndarray, " R"],
    ranges: Float[np.ndarray, " R"],
    bearings: Float[np.ndarray, " R"],
    points: Float[np.ndarray, "R 2"] | None = None,
    covariances: Float[np.ndarray, "R 3"] | None = None,
) -> Detections:
    """Group ordered rows into one message per stamp and form."""
    bare = np.zeros(len(stamps_ns), np.bool_)
    polar = bare if points is None else np.isnan(points[:, 0])
    unclaimed = bare if covariances is None else np.isnan(covariances[:, 0])
    form = 2 * polar.astype(np.int64) + unclaimed
    if form.any() and not form.all():
        order = np.lexsort((form, stamps_ns))
        stamps_ns, ids, ranges, bearings = (
            each[order] for each in (stamps_ns, ids, ranges, bearings)
        )
        points = None if points is None else points[order]
        covariances = None if covariances is None else covariances[order]
        form = form[order]
    changes = np.diff(stamps_ns, prepend=stamps_ns[:1] - 1) | np.diff(form, prepend=form[:1])
    first = np.flatnonzero(changes)
    offsets = np.append(first, len(stamps_ns)).astype(np.int64)
    return Detections(stamps_ns[first], offsets, ids, ranges, bearings, points, covariances)


def no_detections() -> Detections:
    """No message."""
    none = np.empty(0)
    return grouped(none.astype(np.int64), none.astype(np.uint32), none, none)


def moved(
    end_ns: Int64[np.ndarray, " I"],
    duration_ns: Int64[np.ndarray, " I"],
    increments: Float[np.ndarray, "I 3"],
    covariances: Float[np.ndarray, "I 3 3"] | None = None,
) -> Intervals:
    """Odometry intervals that measure SE(2) motions."""
    untold = np.zeros(len(end_ns))
    return Intervals(end_ns, duration_ns, untold, untold, False, increments, covariances)


def polar_covariances(
    x: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
    r: Float[np.ndarray, " N"],
    packed: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N 3"]:
    """J C Jᵀ as (rr, rb, bb) of points at distance r with packed C; J = ∂(r, bearing)/∂(x, y)."""
    c, s = x / r, y / r
    xx, xy, yy = packed.T
    rr = c * c * xx + 2.0 * c * s * xy + s * s * yy
    rb = (c * s * (yy - xx) + (c * c - s * s) * xy) / r
    bb = (s * s * xx - 2.0 * c * s * xy + c * c * yy) / (r * r)
    return np.column_stack((rr, rb, bb))
