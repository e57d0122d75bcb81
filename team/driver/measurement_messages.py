"""Check a program's measurements, and convert them to odometry intervals and messages."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from teamslam.team import core
from teamslam.team.config import LEAST_STEPS, RESET_M, RESET_TIMES, USUAL_M_S, Bounds
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.codec import find_error

M = TypeVar("M", bound=m.Measurement)
NAME = "[a-z][a-z0-9_]{0,31}"
NAMED = "a small letter, then small letters, digits and _ (32 at most)"
UNNAMED = 2**31  # ids from here on are reserved for landmarks without identity
LARGEST_SIGMA_RAD = 0.5  # a larger standard deviation of a bearing [rad] is probably in degrees


class MeasurementError(ValueError):
    """A value cannot be a measurement; the text has place and remedy."""


class DriverWarning(UserWarning):
    """A value is used, but is probably a mistake."""


def stamp_of(t: float | Decimal, what: str) -> int:
    """Convert a time [s] to [ns]; a Decimal keeps every digit of Unix time."""
    if isinstance(t, Decimal):
        return int((t * 10**9).to_integral_value())
    seconds = _number(t, f"the time of {what}")
    if not abs(seconds) < 4e9:
        raise MeasurementError(
            f"{what} at t = {t!r}: times are seconds, as of Unix time; divide nanoseconds by 1e9"
        )
    return round(seconds * 1e9)


class Call(NamedTuple):
    """A robot's measurement at a time, and its name in errors."""

    robot: str
    stamp_ns: int
    name: str

    @property
    def what(self) -> str:
        """The call in words, as `observe at 3.000 s`."""
        return f"{self.name} at {1e-9 * self.stamp_ns:.3f} s"

    def message(self, kind: type[M], **fields: Any) -> M:
        """Build a message without numbers; raises MeasurementError if receivers would refuse it."""
        message = kind(stamp_ns=self.stamp_ns, robot=self.robot, incarnation=0, number=0, **fields)
        why = find_error(message)
        if why is not None:
            raise MeasurementError(f"{self.what}: {why.detail}")
        return message


def check_speeds(forward: float, yaw_rate: float, what: str) -> tuple[float, float]:
    """Check a speed [m/s] and a yaw rate [rad/s]."""
    return _number(forward, f"forward of {what}"), _number(yaw_rate, f"yaw_rate of {what}")


def pose_of(pose: Sequence[float], what: str) -> tuple[float, float, float]:
    """Check a pose (x [m], y [m], theta [rad])."""
    if len(pose) != 3:
        raise MeasurementError(f"{what}: a pose is (x [m], y [m], theta [rad]), got {pose!r}")
    x, y, theta = (_number(each, what) for each in pose)
    return x, y, theta


def observations(
    call: Call,
    ids: ArrayLike,
    polar: tuple[ArrayLike, ArrayLike],
    covariances: ArrayLike | None,
) -> m.Observations:
    """Build a scan of ids below 2³¹ and (ranges [m], bearings [rad]), which are wrapped."""
    what = call.what
    numbers = _numbers(ids, what)
    far, angles = _polar(polar, what, len(numbers))
    return call.message(
        m.Observations,
        ids=from_ids(numbers),
        ranges=from_floats(far),
        bearings=from_floats(angles),
        covariances=_polar_blocks(covariances, len(numbers), what),
    )


def points(call: Call, ids: ArrayLike, xy: ArrayLike, covariances: ArrayLike | None) -> m.Points:
    """Build a scan of ids below 2³¹ and points (ahead [m], left [m])."""
    what = call.what
    numbers = _numbers(ids, what)
    positions = np.asarray(xy, dtype=np.float64)
    if positions.size != 2 * len(numbers) or (len(numbers) and positions.shape[-1:] != (2,)):
        raise MeasurementError(
            f"{what}: xy has the shape {positions.shape}; one row (ahead [m], left [m]) for each "
            f"of {len(numbers)} seen"
        )
    return call.message(
        m.Points,
        ids=from_ids(numbers),
        positions=from_floats(positions.ravel()),
        covariances=_blocks(covariances, len(numbers), what),
    )


def detections(
    call: Call,
    polar: tuple[ArrayLike, ArrayLike],
    covariances: ArrayLike | None,
    classes: ArrayLike | None = None,
) -> m.Detections:
    """Build a scan without identities: (ranges [m], bearings [rad]), P(reported | class) each."""
    what = call.what
    far, angles = _polar(polar, what, np.asarray(polar[0]).size)
    likely = np.empty((len(far), 0)) if classes is None else np.asarray(classes, np.float64)
    if likely.ndim != 2 or len(likely) != len(far) or not (likely > 0.0).all():
        raise MeasurementError(
            f"{what}: classes has the shape {likely.shape}; one row for each of {len(far)} seen, "
            "with the probability above 0 of its reported class given each class of the team"
        )
    return call.message(
        m.Detections,
        ranges=from_floats(far),
        bearings=from_floats(angles),
        covariances=_polar_blocks(covariances, len(far), what),
        classes=from_floats(core.log(likely).ravel()),
    )


def sightings(
    call: Call, teammates: Iterable[str], ranges: ArrayLike, bearings: ArrayLike
) -> m.Sightings:
    """Build inter-robot measurements: teammates' names, ranges [m], bearings [rad]."""
    what = call.what
    names = tuple(teammates)
    for name in names:
        if not re.fullmatch(NAME, name):
            raise MeasurementError(
                f"{what}: {name!r} is no robot's name: {NAMED}; a string alone is taken letter by "
                "letter"
            )
    if call.robot in names:
        raise MeasurementError(f"{what}: {call.robot} can not see itself; name its teammates")
    far, angles = _polar((ranges, bearings), what, len(names))
    polar = {"ranges": from_floats(far), "bearings": from_floats(angles)}
    return call.message(m.Sightings, teammates=names, **polar)


def fix(call: Call, position: tuple[float, float], covariance: ArrayLike | None) -> m.Fix:
    """Build an absolute position [m], with its covariance (2 × 2) if stated."""
    what = call.what
    stated = b""
    if covariance is not None:
        P = np.asarray(covariance, dtype=np.float64)
        if P.shape != (2, 2):
            raise MeasurementError(f"{what}: its covariance is not 2 × 2")
        check_definite(P[np.newaxis], what)
        stated = from_floats([P[0, 0], P[0, 1], P[1, 1]])
    return call.message(
        m.Fix,
        position=from_floats([_number(x, f"a position of {what}") for x in position]),
        covariance=stated,
    )


def square(covariance: ArrayLike | None, what: str) -> bytes:
    """Encode a 3 × 3 covariance; None: empty."""
    if covariance is None:
        return b""
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise MeasurementError(f"{what}: a covariance is 3 × 3, not {matrix.shape}")
    return from_floats(matrix.ravel())


def _polar_blocks(covariances: ArrayLike | None, count: int, what: str) -> bytes:
    packed = _blocks(covariances, count, what)
    for sigma in np.sqrt(np.asarray(covariances)[:, 1, 1]).tolist() if packed else ():
        if sigma > LARGEST_SIGMA_RAD:
            raise MeasurementError(
                f"{what}: the bearing's standard deviation of {sigma:.3g} rad is "
                f"{np.degrees(sigma):.0f}°; if it is in degrees, give {np.radians(sigma):.3g}"
            )
    return packed


def _blocks(covariances: ArrayLike | None, count: int, what: str) -> bytes:
    if covariances is None or not count:
        return b""
    blocks = np.asarray(covariances, dtype=np.float64)
    if blocks.shape != (count, 2, 2):
        raise MeasurementError(
            f"{what}: covariances have the shape {blocks.shape}; {count} of 2 × 2 are needed"
        )
    check_definite(blocks, what)
    return from_floats(blocks[:, [0, 0, 1], [0, 1, 1]].ravel())


def check_definite(covariances: np.ndarray, what: str) -> None:
    """Raise MeasurementError unless each is finite, symmetric and positive definite."""
    finite = np.isfinite(covariances).all(axis=(1, 2))
    checked = np.where(finite[:, np.newaxis, np.newaxis], covariances, 0.0)
    apart = np.abs(checked - checked.transpose(0, 2, 1)).max(axis=(1, 2))
    bad = (apart > 1e-6 * np.abs(checked).max(axis=(1, 2))) | (
        np.linalg.eigvalsh(checked)[:, 0] <= 0.0
    )
    for each in covariances[bad][:1].tolist():
        raise MeasurementError(
            f"{what}: a covariance is symmetric and positive definite, not {each}; leave "
            "covariances out where none are known"
        )


def _number(value: float, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise MeasurementError(f"{what}: expected a number, got {value!r}") from None
    if not np.isfinite(number):
        raise MeasurementError(f"{what} is {number}: leave out what was not measured")
    return number


def _numbers(ids: ArrayLike, what: str) -> np.ndarray:
    numbers = np.asarray(ids)
    if numbers.size == 0:
        return np.empty(0, np.uint32)
    if numbers.ndim != 1:
        raise MeasurementError(f"{what}: ids has the shape {numbers.shape}, not one row")
    whole = numbers.dtype.kind in "iu" or (
        numbers.dtype.kind == "f" and bool(np.all(numbers == np.floor(numbers)))
    )
    if not whole:
        raise MeasurementError(f"{what}: ids are whole numbers, got {numbers.dtype}")
    outside = numbers[(numbers < 0) | (numbers >= UNNAMED)]
    if len(outside):
        raise MeasurementError(
            f"{what}: the id {outside[0]} is not in 0 … 2³¹ − 1; larger ones are for landmarks "
            "without names"
        )
    return numbers.astype(np.uint32)


def _row(values: ArrayLike, name: str, what: str, count: int) -> np.ndarray:
    try:
        row = np.asarray(values, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise MeasurementError(f"{what}: {name} are no numbers: {values!r}") from None
    if len(row) != count:
        raise MeasurementError(f"{what}: {len(row)} {name} of {count} seen: one for each")
    if not np.isfinite(row).all():
        bad = row[~np.isfinite(row)][0]
        raise MeasurementError(f"{what}: {name} have {bad}: leave out what was not measured")
    return row


def _polar(
    polar: tuple[ArrayLike, ArrayLike], what: str, count: int
) -> tuple[np.ndarray, np.ndarray]:
    far = _row(polar[0], "ranges", what, count)
    angles = _row(polar[1], "bearings", what, count)
    if far.min(initial=0.0) < 0.0:
        raise MeasurementError(f"{what}: a range of {far.min():g} m; ranges are distances")
    if np.abs(angles).max(initial=0.0) > 2.0 * np.pi:
        raise MeasurementError(
            f"{what}: a bearing of {angles[np.abs(angles).argmax()]:g}; bearings are in radians"
        )
    return far, wrap_angles(angles)


def wrap_angles(angles: np.ndarray) -> np.ndarray:
    """Wrap angles to (−π, π]; angles within keep their bits."""
    turned = (angles + np.pi) % (2.0 * np.pi) - np.pi
    turned = np.where(turned == -np.pi, np.pi, turned)
    inside: np.ndarray = np.where((angles > -np.pi) & (angles <= np.pi), angles, turned)
    return inside


TOLERANCE = 0.1
"""Clock jitter: largest share of an interval between its start and the end of the last one."""
LEAST_NS = 2_000_000  # clock jitter that is always accepted
UNMEASURED = (1.0, 0.5)
"""Least standard deviation [m/s, rad/s] of a bridged motion; otherwise that of its speed."""
Pose = tuple[float, float, float]


@dataclass
class Odometer:
    """State of the odometry: end of the last interval, and the odometry pose there if given.

    speeds: forward [m/s] and yaw rate [rad/s]; rates: (ahead, left, turn) per second. gap_ns: time
    before it without odometry. home: first pose. fastest: highest speed [m/s].
    """

    robot: str
    bounds: Bounds
    end_ns: int | None = None
    pose: Pose | None = None
    speeds: tuple[float, float] = (0.0, 0.0)
    gap_ns: int = field(default=0, init=False)
    home: Pose | None = field(default=None, init=False)
    steps: int = field(default=0, init=False)
    fastest: float = field(default=0.0, init=False)
    rates: Pose = field(default=(0.0, 0.0, 0.0), init=False)

    def until(self, stamp_ns: int, duration_ns: int | None, call: str) -> int | None:
        """Return the length [ns] of the interval that ends now; None: the first without one."""
        end_ns, what = self.end_ns, self._what(call, stamp_ns)
        self.gap_ns = 0
        if end_ns is not None and stamp_ns <= end_ns:
            raise MeasurementError(
                f"{what}: time goes back by {1e-9 * (end_ns - stamp_ns):.3f} s, behind "
                f"{1e-9 * end_ns:.3f} s: hand odometry over once, in the order of its times"
            )
        if duration_ns is None:
            return None if end_ns is None else stamp_ns - end_ns
        if duration_ns <= 0:
            raise MeasurementError(f"{what}: its duration is not positive")
        if end_ns is None:
            return duration_ns
        begin_ns = stamp_ns - duration_ns
        if abs(begin_ns - end_ns) <= max(LEAST_NS, round(TOLERANCE * duration_ns)):
            return stamp_ns - end_ns
        if begin_ns < end_ns:
            raise MeasurementError(
                f"{what}: it begins {1e-9 * (end_ns - begin_ns):.3f} s before the last interval "
                "has ended: t is the interval's end; leave `duration` away for one without a gap"
            )
        self.gap_ns = begin_ns - end_ns
        return duration_ns

    def judge(self, step: Pose, duration_ns: int, call: str, stamp_ns: int) -> None:
        """Refuse a motion (ahead [m], left [m], turn [rad]) beyond the robot's bounds."""
        seconds, what = 1e-9 * duration_ns, self._what(call, stamp_ns)
        speed, rate = float(np.hypot(step[0], step[1])) / seconds, abs(step[2]) / seconds
        if speed > self.bounds.speed_m_s:
            raise MeasurementError(
                f"{what}: {speed:g} m/s, {self.bounds.speed_m_s:g} at most; lengths are in metres, "
                "times in seconds (see bounds)"
            )
        if rate > self.bounds.yaw_rate_rad_s:
            raise MeasurementError(
                f"{what}: {rate:g} rad/s, {self.bounds.yaw_rate_rad_s:g} at most; turns are in "
                "radians, not in degrees (see bounds)"
            )

    def add(self, stamp_ns: int, step: Pose, duration_ns: int, pose: Pose | None) -> None:
        """Add an interval that has been written to the file."""
        self.end_ns, self.pose = stamp_ns, pose
        self.home = self.home or pose
        if duration_ns:
            seconds = duration_ns * 1e-9
            self.rates = step[0] / seconds, step[1] / seconds, step[2] / seconds
            self.speeds = step[0] * 1e9 / duration_ns, step[2] * 1e9 / duration_ns
            self.steps += 1
            self.fastest = max(self.fastest, float(np.hypot(*step[:2])) / seconds)

    def was_reset(self, step: Pose, duration_ns: int, pose: Pose) -> bool:
        """Whether the odometry jumps to its first pose, or RESET_TIMES as fast as ever."""
        way, usual_m = float(np.hypot(*step[:2])), max(self.fastest, USUAL_M_S) * duration_ns * 1e-9
        home = pose == self.home and way > 2.0 * usual_m
        known = self.steps >= LEAST_STEPS and way > RESET_M
        return known and (home or way > RESET_TIMES * usual_m)

    def as_before(self, duration_ns: int) -> Pose:
        """Return the motion of an interval at the rates of the one before."""
        seconds = duration_ns * 1e-9
        return self.rates[0] * seconds, self.rates[1] * seconds, self.rates[2] * seconds

    def bridge(self) -> tuple[Pose, list[float]]:
        """Return the motion over the gap at the last speeds, and its covariance (row-major, 3 × 3).

        Standard deviations equal the motion, at least UNMEASURED, at most half a turn.
        """
        seconds = 1e-9 * self.gap_ns
        (v, w), (least_v, least_w) = self.speeds, UNMEASURED
        way, turn = max(abs(v), least_v) * seconds, min(max(abs(w), least_w) * seconds, np.pi)
        half = 0.5 * np.clip(w * seconds, -np.pi, np.pi)
        chord = v * seconds * float(np.sinc(half / np.pi))
        step = chord * float(np.cos(half)), chord * float(np.sin(half)), 2.0 * float(half)
        return step, [way * way, 0.0, 0.0, 0.0, way * way, 0.0, 0.0, 0.0, turn * turn]

    def _what(self, call: str, stamp_ns: int) -> str:
        return f"{call} of {self.robot} at {1e-9 * stamp_ns:.3f} s"


def relative_pose(before: Pose, after: Pose) -> Pose:
    """Express a pose in the frame of the one before: (ahead, left, turn)."""
    dx, dy = after[0] - before[0], after[1] - before[1]
    c, s = float(np.cos(before[2])), float(np.sin(before[2]))
    turn = float(wrap_angles(np.array(after[2] - before[2])))
    return c * dx + s * dy, c * dy - s * dx, turn
