"""The streams of any world, simulated or recorded: measurements of each robot in order, and the
truth.

One counter spans all measurements of a robot, in the order (stamp, kind); measurement 0 is the
initial pose. An odometry measurement is an interval that is stamped with its *end*, and the
intervals of a robot are contiguous in time. So at equal stamps the measurements at the end of an
interval come before it. SI units, radians, bearings in (−π, π].
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8, UInt32

START = 0
OBSERVATIONS = 1
SIGHTINGS = 2
ODOMETRY = 3
NO_LABEL = 2**32 - 1
"""The identity of a detection that is clutter, or whose landmark is not known."""

KIND_NAMES = ("start pose", "observations", "sightings", "odometry")


@dataclass(frozen=True)
class StartPose:
    """The pose (x, y, θ) of measurement 0 in the team's frame; covariance None: exactly known."""

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"] | None


@dataclass(frozen=True)
class Intervals:
    """Odometry intervals: end stamp, length, and the mean forward speed [m/s] and yaw rate [rad/s].

    Interval k ends where interval k + 1 begins. steered: of a car, whose forward is the speed of
    the wheel [m/s] and yaw_rate the steering angle [rad]. increments: odometry that measures
    motions instead, each the pose (x, y, theta) of its end in the frame of its start; forward and
    yaw_rate are then zero. covariances: of the increments, in the frame of the end. An increment of
    NaN: that interval has speeds; a covariance of NaN: that motion has none.
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
        """Which of them measure a motion."""
        if self.increments is None:
            return np.zeros(len(self.end_ns), np.bool_)
        return np.asarray(~np.isnan(self.increments[:, 0]))

    @property
    def claimed(self) -> Bool[np.ndarray, " I"]:
        """Which of them have a covariance of their own."""
        if self.covariances is None:
            return np.zeros(len(self.end_ns), np.bool_)
        return np.asarray(~np.isnan(self.covariances[:, 0, 0]))

    def where(self, chosen: Bool[np.ndarray, " I"]) -> "Intervals":
        """The chosen intervals."""
        return Intervals(
            self.end_ns[chosen],
            self.duration_ns[chosen],
            self.forward[chosen],
            self.yaw_rate[chosen],
            self.steered,
            None if self.increments is None else self.increments[chosen],
            None if self.covariances is None else self.covariances[chosen],
        )


@dataclass(frozen=True)
class Detections:
    """M messages of range-bearing measurements: message m has the rows offsets[m] … offsets[m + 1].

    ids are landmark identities, or indices into a tuple of teammates. points: the sensor measures
    these (x, y) in its frame [m], and ranges and bearings are computed from them. covariances: that
    each measurement carries, (rr, rb, bb) of range and bearing or (xx, xy, yy) of points. A point
    of NaN: that one was measured as range and bearing; a covariance of NaN: it has none; the rows
    of a message are alike. hidden:
    messages that are published without identities (None: none); their ids are for scoring, NO_LABEL
    of clutter. signatures: a number for each that is alike for the same landmark, of hidden ones
    only.
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

    def rows(self, message: int) -> slice:
        """The rows of one message."""
        return slice(int(self.offsets[message]), int(self.offsets[message + 1]))

    def only(self, first: int, last: int) -> "Detections":
        """The messages first … last − 1."""
        rows = slice(int(self.offsets[first]), int(self.offsets[last]))
        return Detections(
            stamps_ns=self.stamps_ns[first:last],
            offsets=self.offsets[first : last + 1] - self.offsets[first],
            ids=self.ids[rows],
            ranges=self.ranges[rows],
            bearings=self.bearings[rows],
            points=None if self.points is None else self.points[rows],
            covariances=None if self.covariances is None else self.covariances[rows],
            hidden=None if self.hidden is None else self.hidden[first:last],
            signatures=None if self.signatures is None else self.signatures[rows],
        )


class OdometryMeasurement(NamedTuple):
    """One interval that ends at stamp_ns; the rest as in `Intervals`."""

    stamp_ns: int
    duration_ns: int
    forward: float
    yaw_rate: float
    steered: bool = False
    increment: Float[np.ndarray, "3"] | None = None
    covariance: Float[np.ndarray, "3 3"] | None = None


class ObservationMeasurement(NamedTuple):
    """Landmarks seen at stamp_ns: ids, ranges [m], bearings [rad]; may be empty.

    points, covariances, signatures: as in `Detections`. hidden: it is published without the ids.
    """

    stamp_ns: int
    ids: UInt32[np.ndarray, " R"]
    ranges: Float[np.ndarray, " R"]
    bearings: Float[np.ndarray, " R"]
    points: Float[np.ndarray, "R 2"] | None = None
    covariances: Float[np.ndarray, "R 3"] | None = None
    hidden: bool = False
    signatures: Float[np.ndarray, " R"] | None = None


class SightingMeasurement(NamedTuple):
    """Teammates seen at stamp_ns: names, ranges [m], bearings [rad]."""

    stamp_ns: int
    teammates: tuple[str, ...]
    ranges: Float[np.ndarray, " R"]
    bearings: Float[np.ndarray, " R"]


@dataclass(frozen=True, kw_only=True)
class RobotStream:
    """All measurements of one robot, numbered by (stamp, kind), the initial pose first; the index
    into kinds, stamps_ns and rows is the measurement counter.

    start: at start_ns, None when the initial pose is not known. rows: the measurement's row in the
    arrays of its kind. truth (x, y, θ) in the team's frame at truth_ns, or None. notes: what was
    repaired or can not be given, for users. clock_offset_ns: all stamps here are team time; the
    odometry's own clock, whose stamps are published, reads this much less. positions: where another
    sensor, as a GPS, measured the robot at positions_ns, in a frame of its own.

    Raises ValueError for a measurement before the initial pose, or odometry that is not contiguous.
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
    kinds: UInt8[np.ndarray, " N"] = field(init=False)
    stamps_ns: Int64[np.ndarray, " N"] = field(init=False)
    rows: Int64[np.ndarray, " N"] = field(init=False)

    def __post_init__(self) -> None:
        intervals = self.intervals
        parts = (
            np.array([self.start_ns]),
            self.landmark_detections.stamps_ns,
            self.teammate_detections.stamps_ns,
            intervals.end_ns,
        )
        stamps = np.concatenate(parts)
        kinds = np.repeat(np.arange(4, dtype=np.uint8), [len(part) for part in parts])
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
        """The number of measurements, the initial pose included."""
        return len(self.kinds)

    def odometry(self, counter: int) -> OdometryMeasurement:
        """The odometry interval with this measurement counter."""
        row = self._row(counter, ODOMETRY)
        intervals = self.intervals
        increment = _known(intervals.increments, row)
        return OdometryMeasurement(
            int(intervals.end_ns[row]),
            int(intervals.duration_ns[row]),
            float(intervals.forward[row]),
            float(intervals.yaw_rate[row]),
            intervals.steered and increment is None,
            increment,
            _known(intervals.covariances, row),
        )

    def observations(self, counter: int) -> ObservationMeasurement:
        """The landmarks seen, of the message with this measurement counter."""
        seen = self.landmark_detections
        row = self._row(counter, OBSERVATIONS)
        at = seen.rows(row)
        return ObservationMeasurement(
            stamp_ns=int(self.stamps_ns[counter]),
            ids=seen.ids[at],
            ranges=seen.ranges[at],
            bearings=seen.bearings[at],
            points=_alike(seen.points, at),
            covariances=_alike(seen.covariances, at),
            hidden=seen.hidden is not None and bool(seen.hidden[row]),
            signatures=_alike(seen.signatures, at),
        )

    def sightings(self, counter: int) -> SightingMeasurement:
        """The teammates seen, of the message with this measurement counter."""
        seen = self.teammate_detections
        at = seen.rows(self._row(counter, SIGHTINGS))
        names = tuple(self.teammates[i] for i in seen.ids[at])
        stamp_ns = int(self.stamps_ns[counter])
        return SightingMeasurement(stamp_ns, names, seen.ranges[at], seen.bearings[at])

    def _row(self, counter: int, kind: int) -> int:
        found = int(self.kinds[counter])
        if found != kind:
            raise LookupError(
                f"measurement {counter} of {self.robot}: {KIND_NAMES[found]}, not "
                f"{KIND_NAMES[kind]}"
            )
        return int(self.rows[counter])


def _known(values: np.ndarray | None, row: int) -> np.ndarray | None:
    """A row of the array; None where there is no array, or the row is NaN."""
    return None if values is None or np.isnan(values[row].flat[0]) else values[row]


def _alike(values: np.ndarray | None, rows: slice) -> np.ndarray | None:
    """The rows of one message; None where there is no array, or they are NaN."""
    return None if values is None or np.isnan(values[rows]).any() else values[rows]


@dataclass(frozen=True)
class WorldStreams:
    """The streams of a team, the true landmark positions (None: not known), and the name of their
    source.

    landmark_ids ascend; without positions they are empty.
    """

    streams: tuple[RobotStream, ...]
    landmark_ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"] | None
    source: str
    notes: tuple[str, ...] = ()

    @property
    def spans_ns(self) -> dict[str, tuple[int, int]]:
        """The times of each robot's first and last measurement."""
        return {
            each.robot: (int(each.stamps_ns[0]), int(each.stamps_ns[-1])) for each in self.streams
        }

    def order(self) -> tuple[Int64[np.ndarray, " A"], Int64[np.ndarray, " A"]]:
        """All measurements of the team by (stamp, stream, counter): their stream indices and
        counters.

        Restricted to one stream the counters ascend, since its stamps never decrease.
        """
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
    """Measurements in order of time → one message per stamp, and per form."""
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


def moved(
    end_ns: Int64[np.ndarray, " I"],
    duration_ns: Int64[np.ndarray, " I"],
    increments: Float[np.ndarray, "I 3"],
    covariances: Float[np.ndarray, "I 3 3"] | None = None,
) -> Intervals:
    """Odometry intervals that measure motions on SE(2)."""
    untold = np.zeros(len(end_ns))
    return Intervals(end_ns, duration_ns, untold, untold, False, increments, covariances)
