"""What a program hands to its driver, judged at once, as messages without a number."""

import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from team.config import Bounds
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids
from team.wire.codec import unsound

M = TypeVar("M", bound=m.Measurement)
NAME = "[a-z][a-z0-9_]{0,31}"
UNNAMED = 2**31
"""Numbers from here on are for landmarks without names."""


class MeasurementError(ValueError):
    """What was handed over can not be a measurement of this robot: what, where, and what to do.

    Nothing of it was taken.
    """


class DriverWarning(UserWarning):
    """Something that is taken as it is, and is hardly meant."""


def stamp_of(t: float | Decimal, what: str) -> int:
    """A time in seconds as whole nanoseconds; a Decimal keeps every digit of Unix time."""
    if isinstance(t, Decimal):
        return int((t * 10**9).to_integral_value())
    seconds = _number(t, f"the time of {what}")
    if not abs(seconds) < 4e9:
        raise MeasurementError(
            f"{what} at t = {t!r}: times are seconds, as of Unix time; divide nanoseconds by 1e9"
        )
    return round(seconds * 1e9)


def speeds(forward: float, yaw_rate: float, bounds: Bounds, what: str) -> tuple[float, float]:
    """Speed and yaw rate that a robot can have."""
    v, w = _number(forward, f"forward of {what}"), _number(yaw_rate, f"yaw_rate of {what}")
    if abs(v) > bounds.speed_m_s:
        raise MeasurementError(
            f"{what}: {v:g} m/s, {bounds.speed_m_s:g} at most; speeds are in m/s (see bounds)"
        )
    if abs(w) > bounds.yaw_rate_rad_s:
        raise MeasurementError(
            f"{what}: {w:g} rad/s, {bounds.yaw_rate_rad_s:g} at most; yaw rates are in rad/s, "
            "not in degrees (see bounds)"
        )
    return v, w


def pose_of(pose: Sequence[float], what: str) -> tuple[float, float, float]:
    """x, y and theta of a pose."""
    if len(pose) != 3:
        raise MeasurementError(f"{what}: a pose is (x [m], y [m], theta [rad]), got {pose!r}")
    x, y, theta = (_number(each, what) for each in pose)
    return x, y, theta


def observations(
    robot: str, stamp_ns: int, ids: ArrayLike, ranges: ArrayLike, bearings: ArrayLike
) -> m.Observations:
    """Landmarks seen: numbers below 2³¹, ranges [m], bearings [rad], which are wrapped."""
    what = f"observe at {1e-9 * stamp_ns:.3f} s"
    numbers = _numbers(ids, what)
    far, angles = (
        _row(ranges, "ranges", what, len(numbers)),
        _row(bearings, "bearings", what, len(numbers)),
    )
    return _sound(
        m.Observations(
            stamp_ns=stamp_ns,
            robot=robot,
            incarnation=0,
            number=0,
            ids=from_ids(numbers),
            ranges=from_floats(_positive(far, what)),
            bearings=from_floats(_wrapped(angles, what)),
        ),
        what,
    )


def sightings(
    robot: str, stamp_ns: int, teammates: Iterable[str], ranges: ArrayLike, bearings: ArrayLike
) -> m.Sightings:
    """Teammates seen: their names, ranges [m], bearings [rad]."""
    what = f"sight at {1e-9 * stamp_ns:.3f} s"
    names = tuple(teammates)
    for name in names:
        if not re.fullmatch(NAME, name):
            raise MeasurementError(
                f"{what}: {name!r} is no robot's name: a small letter, then small letters, digits "
                "and _; a string alone is taken letter by letter"
            )
    if robot in names:
        raise MeasurementError(f"{what}: {robot} can not see itself; name its teammates")
    far, angles = (
        _row(ranges, "ranges", what, len(names)),
        _row(bearings, "bearings", what, len(names)),
    )
    return _sound(
        m.Sightings(
            stamp_ns=stamp_ns,
            robot=robot,
            incarnation=0,
            number=0,
            teammates=names,
            ranges=from_floats(_positive(far, what)),
            bearings=from_floats(_wrapped(angles, what)),
        ),
        what,
    )


def range_bearing_of(xy: ArrayLike, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (ahead, left) in the robot's frame [m] as ranges and bearings."""
    points = np.asarray(xy, dtype=np.float64)
    if points.size == 0:
        return np.empty(0), np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2:
        raise MeasurementError(
            f"{what}: xy has the shape {points.shape}; one row (ahead [m], left [m]) a landmark"
        )
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])


def _sound(message: M, what: str) -> M:
    why = unsound(message)
    if why is not None:
        raise MeasurementError(f"{what}: {why.detail}")
    return message


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


def _positive(ranges: np.ndarray, what: str) -> np.ndarray:
    if len(ranges) and ranges.min() < 0.0:
        raise MeasurementError(f"{what}: a range of {ranges.min():g} m; ranges are distances")
    return ranges


def _wrapped(angles: np.ndarray, what: str) -> np.ndarray:
    if len(angles) and np.abs(angles).max() > 2.0 * np.pi:
        raise MeasurementError(
            f"{what}: a bearing of {angles[np.abs(angles).argmax()]:g}; bearings are in radians"
        )
    outside = np.abs(angles) > np.pi
    return np.where(outside, np.pi - np.mod(np.pi - angles, 2.0 * np.pi), angles)
