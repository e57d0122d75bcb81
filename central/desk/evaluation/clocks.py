"""Estimate the time offset of a robot's detections against its odometry, without truth.

A landmark measured at t_i and t_j is at b_i, b_j in the base frame. With the odometry motion D(τ)
from t_i − τ to t_j − τ, b_j = D(τ)⁻¹ b_i up to noise. Sensor mount, range offset, odometry scales
and drift are estimated jointly. The variance is the sandwich over stretches of time (Liang and
Zeger 1986).
"""

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from teamslam.central.desk.names import in_order
from teamslam.central.diagnosis import MIRRORED_REMEDY, clock_remedy
from teamslam.team import translate
from teamslam.team.config import GATE, RobotConfig, Sensor
from teamslam.team.estimation.models import steered
from teamslam.team.estimation.se2 import logarithm
from teamslam.team.shapes import Float, Int64
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats

APART_NS = 2_000_000_000  # greatest time between two compared measurements of a landmark
STRETCH_NS = 5_000_000_000
LEAST_STRETCHES = 12  # least effective number of stretches, 1/Σ share² of the information on τ
STEP_NS = 250_000_000  # step of the central derivative by τ; averages interval noise
HUBER = 2.0
ROUNDS = 20
SETTLED_NS = 1_000_000
LEAST_SLOPE = 0.2  # least share of the derivative that is motion, not odometry noise
LARGEST_NS = 2_000_000_000  # largest plausible clock offset
NEAR_M = 1.0  # point errors grow with distance beyond this [m]
BEYOND_DOUBT = 5.0  # offset, in standard deviations, from which it is reported
CONTRADICTION = 4.0  # standard deviations from which two estimates of an offset exclude each other
LEAST_S = 0.02  # smallest reported offset [s]
UNIX_S = 1e9


@dataclass
class Timed:
    """Stamps, motions and measurements of named landmarks of one stream, in any order.

    motions: per interval (forward [m/s], left [m/s], turn [rad/s]), or (wheel speed [m/s], steering
    [rad], –) if `steered`. seen: (range [m], bearing [rad]) per measurement.
    """

    ends_ns: "array[int]" = field(default_factory=lambda: array("q"))
    durations_ns: "array[int]" = field(default_factory=lambda: array("q"))
    motions: "array[float]" = field(default_factory=lambda: array("d"))
    steered: "array[int]" = field(default_factory=lambda: array("b"))
    stamps_ns: "array[int]" = field(default_factory=lambda: array("q"))
    ids: "array[int]" = field(default_factory=lambda: array("q"))
    seen: "array[float]" = field(default_factory=lambda: array("d"))
    has_points: bool = False

    def span_ns(self, clock_offset_s: float) -> tuple[int, int] | None:
        """Team times of the first and last measurement."""
        ends = np.array(self.ends_ns, np.int64) + round(1e9 * clock_offset_s)
        begins = ends - np.array(self.durations_ns, np.int64)
        stamps = np.concatenate([begins, ends, np.array(self.stamps_ns, np.int64)])
        return (int(stamps.min()), int(stamps.max())) if len(stamps) else None

    def take(self, message: m.AnyOdometry | m.AnyScan) -> None:
        """Add an odometry interval or a scan."""
        if isinstance(message, m.AnyScan):
            scan = translate.scan_of(message)
            self.has_points |= isinstance(message, m.Points)
            self.stamps_ns.extend([message.stamp_ns] * len(scan.ids))
            self.ids.extend(scan.ids.tolist())
            self.seen.extend(np.column_stack([scan.ranges, scan.bearings]).ravel().tolist())
            return
        self.ends_ns.append(message.stamp_ns)
        self.durations_ns.append(message.duration_ns)
        self.steered.append(isinstance(message, m.Steering))
        match message:
            case m.Odometry():
                self.motions.extend((message.forward, 0.0, message.yaw_rate))
            case m.Steering():
                self.motions.extend((message.wheel_speed, message.steering, 0.0))
            case m.Increment():
                per_s = 1.0 / max(1e-9 * message.duration_ns, 1e-9)
                increment = floats(message.increment, "increment").astype(np.float64)
                self.motions.extend((per_s * logarithm(increment)).tolist())


@dataclass(frozen=True)
class Late:
    """Delay of the detections against odometry, and its σ [s]."""

    offset_s: float
    sigma_s: float

    @property
    def is_beyond_doubt(self) -> bool:
        """Whether the offset is significant."""
        return abs(self.offset_s) > max(LEAST_S, BEYOND_DOUBT * self.sigma_s)


def clock_cause(robot: str, found: Late) -> m.Diagnosis | None:
    """Diagnose a significant clock offset."""
    if not found.is_beyond_doubt:
        return None
    return m.Diagnosis(
        cause="clock_offset",
        robot=robot,
        value=(found.offset_s,),
        sigma=(found.sigma_s,),
        evidence=(found.offset_s / found.sigma_s) ** 2,
        remedy=clock_remedy(found.offset_s),
    )


def is_refuted(cause: m.Diagnosis, found: Late | None) -> bool:
    """Whether the measurements alone exclude a clock offset of the map.

    A wrong odometry scale bends the windows' sensitivities as a late clock does, but not the motion
    between two measurements.
    """
    if found is None or cause.cause != "clock_offset" or found.is_beyond_doubt:
        return False
    apart = abs(cause.value[0] - found.offset_s)
    return apart > CONTRADICTION * math.hypot(cause.sigma[0], found.sigma_s)


def separate_times_warning(spans_ns: Mapping[str, tuple[int, int]]) -> str | None:
    """Warn about robots whose measurement times do not overlap."""
    groups: list[list[str]] = []
    until_ns = 0
    for robot in sorted(spans_ns, key=lambda each: spans_ns[each]):
        first_ns, last_ns = spans_ns[robot]
        if not groups or first_ns > until_ns:
            groups.append([])
        groups[-1].append(robot)
        until_ns = max(until_ns, last_ns)
    if len(groups) < 2:
        return None
    times = "; ".join(
        f"{', '.join(in_order(group))} from {_time(min(spans_ns[each][0] for each in group))} to "
        f"{_time(max(spans_ns[each][1] for each in group))}"
        for group in groups
    )
    return (
        f"the robots' times do not overlap: {times}. If these robots drove at the same time their "
        "clocks differ: give all stamps of the team one clock (a data set: `offset` of t_s in a "
        "map of columns; robots: NTP or PTP)"
    )


def _time(stamp_ns: int) -> str:
    seconds = 1e-9 * stamp_ns
    if seconds < UNIX_S:
        return f"{seconds:,.0f} s"
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"


def lateness(timed: Timed, config: RobotConfig) -> Late | None:
    """Estimate a robot's delay beyond its `clock_offset_s`; None if undetermined.

    Gauss–Newton under Huber's loss; σ is divided by the slope of the step in τ, which noise of the
    derivative reduces.
    """
    with np.errstate(all="ignore"):
        pairs = _pairs_of(timed, config)
        if pairs is None:
            return None
        late_ns = 0
        for _ in range(ROUNDS):
            step, sigma = pairs.step(late_ns)
            if not abs(late_ns + 1e9 * step) < LARGEST_NS:
                return None
            late_ns += round(1e9 * step)
            if abs(1e9 * step) < SETTLED_NS:
                break
        else:
            return None
        before, after = (pairs.step(late_ns + by)[0] for by in (-STEP_NS, STEP_NS))
        slope = min((before - after) / (2e-9 * STEP_NS), 1.0)
        return Late(1e-9 * late_ns, sigma / slope) if slope > LEAST_SLOPE else None


@dataclass(frozen=True)
class _DeadReckoning:
    starts_ns: Int64[np.ndarray, " n"]
    ends_ns: Int64[np.ndarray, " n"]
    rates: Float[np.ndarray, "n 3"]
    poses: Float[np.ndarray, "n 3"]

    def at(self, stamps_ns: Int64[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
        k = np.maximum(np.searchsorted(self.starts_ns, stamps_ns, "right") - 1, 0)
        seconds = 1e-9 * (np.minimum(stamps_ns, self.ends_ns[k]) - self.starts_ns[k])
        return _after(self.poses[k], self.rates[k] * np.maximum(seconds, 0.0)[:, np.newaxis])


@dataclass(frozen=True)
class Pairs:
    """Pairs of measurements of one landmark at b_i, b_j."""

    path: _DeadReckoning
    t_i: Int64[np.ndarray, " k"]
    t_j: Int64[np.ndarray, " k"]
    b_i: Float[np.ndarray, "k 2"]
    b_j: Float[np.ndarray, "k 2"]
    stretch: Int64[np.ndarray, " k"]

    def step(self, late_ns: int) -> tuple[float, float]:
        """Further delay [s] and its σ; NaN if undetermined."""
        d, turn = self._motion(late_ns)
        q, way = _turn(self.b_i - d, -turn), _turn(d, -turn)
        before, after = (self._again(late_ns + by) for by in (-STEP_NS, STEP_NS))
        ahead, left = (np.broadcast_to(each, q.shape) for each in ((1.0, 0.0), (0.0, 1.0)))
        r_i, r_j = (np.maximum(np.hypot(*b.T), 1e-3)[:, np.newaxis] for b in (self.b_i, self.b_j))
        turns, seconds = turn[:, np.newaxis], 1e-9 * (self.t_j - self.t_i)[:, np.newaxis]
        columns = (
            (before - after) / (2e-9 * STEP_NS),
            way,  # scale of the way, then of the turn, then drift
            turns * (_across(q) - 0.5 * _across(way)),
            seconds * _across(q),
            ahead - _turn(ahead, -turn),  # mount
            left - _turn(left, -turn),
            _across(self.b_j) - _turn(_across(self.b_i), -turn),
            self.b_j / r_j - _turn(self.b_i / r_i, -turn),  # offset of the range
        )
        scale = np.maximum(r_j, NEAR_M)
        J = np.stack(columns, axis=2) / scale[:, :, np.newaxis]
        return _first_of_fit((self.b_j - q) / scale, J, self.stretch)

    @property
    def gaps(self) -> Float[np.ndarray, " k"]:
        """Distance of b_j from its place by the odometry/max(range, NEAR_M)."""
        gaps, ranges = np.hypot(*(self.b_j - self._again(0)).T), np.hypot(*self.b_j.T)
        return np.asarray(gaps / np.maximum(ranges, NEAR_M))

    def _motion(self, late_ns: int) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        one, two = self.path.at(self.t_i - late_ns), self.path.at(self.t_j - late_ns)
        return _turn(two[:, :2] - one[:, :2], -one[:, 2]), two[:, 2] - one[:, 2]

    def _again(self, late_ns: int) -> Float[np.ndarray, "k 2"]:
        d, turn = self._motion(late_ns)
        return _turn(self.b_i - d, -turn)


def _pairs_of(timed: Timed, config: RobotConfig, side: float = 1.0) -> Pairs | None:
    """Pairs of measurements, or None for too few; side: −1 reflects the bearings."""
    if not timed.ends_ns or not timed.ids:
        return None
    path = _dead_reckoning(timed, config)
    stamps, names = np.array(timed.stamps_ns, np.int64), np.array(timed.ids, np.int64)
    order = np.lexsort((stamps, names))
    stamps, names = stamps[order], names[order]
    seen = np.array(timed.seen).reshape(-1, 2)[order] * (1.0, side)
    points = _on_base(seen, config.sensor)
    apart = np.diff(stamps)
    chosen = (np.diff(names) == 0) & (apart > 0) & (apart <= APART_NS)
    chosen &= stamps[:-1] > int(path.starts_ns[0]) + LARGEST_NS
    chosen &= stamps[1:] < int(path.ends_ns[-1]) - LARGEST_NS
    i = np.flatnonzero(chosen)
    stretches, which = np.unique(stamps[i] // STRETCH_NS, return_inverse=True)
    if len(stretches) < LEAST_STRETCHES:
        return None
    return Pairs(path, stamps[i], stamps[i + 1], points[i], points[i + 1], which)


def _dead_reckoning(timed: Timed, config: RobotConfig) -> _DeadReckoning:
    ends = np.array(timed.ends_ns, np.int64) + round(1e9 * config.clock_offset_s)
    rates = np.array(timed.motions).reshape(-1, 3)
    for k in np.flatnonzero(np.array(timed.steered)).tolist():
        forward, turn = steered(config.motion, float(rates[k, 0]), float(rates[k, 1]))
        rates[k] = forward, 0.0, turn
    order = np.argsort(ends, kind="stable")
    ends, rates = ends[order], rates[order]
    starts = ends - np.array(timed.durations_ns, np.int64)[order]
    starts[1:] = np.maximum(starts[1:], ends[:-1])
    twists = rates * (1e-9 * (ends - starts))[:, np.newaxis]
    headings = np.cumsum(twists[:, 2]) - twists[:, 2]
    steps = _after(np.column_stack([np.zeros((len(ends), 2)), headings]), twists)[:, :2]
    places = np.cumsum(steps, axis=0) - steps
    return _DeadReckoning(starts, ends, rates, np.column_stack([places, headings]))


def _on_base(seen: Float[np.ndarray, "k 2"], sensor: Sensor) -> Float[np.ndarray, "k 2"]:
    x, y, heading = sensor.mount
    ranges = (seen[:, 0] - sensor.range_offset) / sensor.range_scale
    angles = seen[:, 1] - sensor.bearing_offset + heading
    return np.column_stack([x + ranges * np.cos(angles), y + ranges * np.sin(angles)])


def _after(
    poses: Float[np.ndarray, "k 3"], twists: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k 3"]:
    """Compose poses with Exp(twist), whose chord points at half the turn."""
    half = 0.5 * twists[:, 2]
    chord = np.sinc(half / math.pi)[:, np.newaxis] * twists[:, :2]
    places = poses[:, :2] + _turn(chord, poses[:, 2] + half)
    return np.column_stack([places, poses[:, 2] + twists[:, 2]])


def _turn(
    points: Float[np.ndarray, "k 2"], angles: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k 2"]:
    c, s = np.cos(angles), np.sin(angles)
    x, y = points.T
    return np.column_stack([c * x - s * y, s * x + c * y])


def _across(points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 2"]:
    return np.column_stack([-points[:, 1], points[:, 0]])


def _first_of_fit(
    e: Float[np.ndarray, "k 2"], J: Float[np.ndarray, "k 2 p"], stretch: Int64[np.ndarray, " k"]
) -> tuple[float, float]:
    """First component of argmin_p of Huber's loss of e + J p, and its σ; NaN if undetermined.

    Iteratively reweighted least squares, scaled by the median error. σ² = Σ (s/(1 − h))² over
    stretches with influence s and share h of the information (Bell and McCaffrey 2002).
    """
    errors, rows = e.reshape(-1), J.reshape(len(e) * 2, -1)
    norms = np.linalg.norm(rows, axis=0)
    if not (np.isfinite(norms).all() and np.isfinite(errors).all() and norms[0] > 0.0):
        return math.nan, math.nan
    used = norms > 0.0
    rows = rows[:, used] / norms[used]
    p = np.zeros(rows.shape[1])
    for _ in range(ROUNDS):
        r = errors + rows @ p
        lengths = np.hypot(*r.reshape(-1, 2).T)
        sigma = float(np.median(lengths)) / math.sqrt(2.0 * math.log(2.0)) + 1e-12
        w = np.repeat(np.minimum(1.0, HUBER * sigma / np.maximum(lengths, 1e-12)), 2)
        # Directions without motion have no part in p.
        inverse = np.linalg.pinv(rows.T @ (w[:, np.newaxis] * rows), rcond=1e-10, hermitian=True)
        change = -inverse @ (rows.T @ (w * r))
        p += change
        if np.abs(change).max() < 1e-4 * sigma:
            break
    r = errors + rows @ p
    gain = rows @ inverse[0]
    share = np.bincount(stretch, (w * gain * gain).reshape(-1, 2).sum(axis=1)) / inverse[0, 0]
    sums = np.bincount(stretch, (w * gain * r).reshape(-1, 2).sum(axis=1)) / (1.0 - share)
    if not float(share @ share) * LEAST_STRETCHES < 1.0:
        return math.nan, math.nan
    return float(p[0] / norms[0]), math.sqrt(float(sums @ sums)) / float(norms[0])


MIRRORED = 0.9  # least share of the deciding stretches that fit reflected: 11 of 12


def mirrored_cause(robot: str, timed: Timed, config: RobotConfig) -> m.Diagnosis | None:
    """Diagnose a robot whose measurements fit its odometry reflected, or None.

    A stretch decides if the χ² of its measured points less that of the reflected ones is beyond
    GATE; evidence is the mean of these. A pair counts GATE at most.
    """
    gains = _gains(timed, config)
    deciding = gains[np.abs(gains) > GATE]
    right = int((deciding > 0.0).sum())
    if len(deciding) < LEAST_STRETCHES or right < MIRRORED * len(deciding):
        return None
    return m.Diagnosis(
        cause="mirrored",
        robot=robot,
        value=(-1.0,),
        sigma=(0.0,),
        evidence=float(deciding.mean()),
        remedy=MIRRORED_REMEDY,
    )


def _gains(timed: Timed, config: RobotConfig) -> Float[np.ndarray, " n"]:
    """χ² that a reflection removes from each stretch of time."""
    none = np.zeros(0)
    with np.errstate(all="ignore"):
        own, other = (_pairs_of(timed, config, side) for side in (1.0, -1.0))
        if own is None or other is None:
            return none
        unit = min(float(np.median(each.gaps)) for each in (own, other))
        chi2, reflected = (
            np.minimum(2.0 * math.log(2.0) * (each.gaps / unit) ** 2, GATE) for each in (own, other)
        )
        sums = np.bincount(own.stretch, chi2 - reflected)
    return sums if np.isfinite(sums).all() else none
