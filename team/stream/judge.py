"""Checks whether a stream's measurements are physically sensible, one after the other."""

import math

import numpy as np
from jaxtyping import Bool, Float

from team.config import Bounds
from team.estimation.compiled import compiled
from team.estimation.odometry import Intervals, OdometryInterval
from team.estimation.plausible import is_motion_spread as _spread
from team.rejection import Rejection

LONGEST_NS = 2**62
"""No two stamps are as far apart."""


class StreamJudge:
    """Checks one incarnation of a sensor stream; it remembers the time of the last odometry.

    A stamp that lies `jump_s` ahead of the odometry is refused, and so is the odometry itself,
    until the next interval confirms that the clock has really jumped.
    """

    def __init__(self, bounds: Bounds, now_ns: int | None = None) -> None:
        self._bounds = bounds
        self._jump_ns = round(bounds.jump_s * 1e9)
        self._now_ns = now_ns
        self._jumped_ns: int | None = None

    def odometry(self, interval: OdometryInterval) -> Rejection | None:
        """Why an interval is refused: for `Rejection.SPEED` only its motion, otherwise all of
        it.
        """
        stamp_ns, duration_ns = interval.end_ns, interval.duration_ns
        if duration_ns == 0:
            return Rejection.NO_TIME
        if self._now_ns is not None:
            if stamp_ns <= self._now_ns:
                return Rejection.OLDER
            near_ns = self._now_ns if self._jumped_ns is None else self._jumped_ns
            ahead_ns = stamp_ns - self._now_ns
            if ahead_ns > self._jump_ns and not 0 < stamp_ns - near_ns <= self._jump_ns:
                self._jumped_ns = stamp_ns
                return Rejection.TIME
        self._now_ns, self._jumped_ns = stamp_ns, None
        bounds, moved = self._bounds, interval.moved
        claimed = None if moved is None else moved.covariance
        if math.isnan(interval.forward):
            return Rejection.STEERING
        sensible = (
            duration_ns <= bounds.interval_s * 1e9
            and abs(interval.speed) <= bounds.speed_m_s
            and abs(interval.yaw_rate) <= bounds.yaw_rate_rad_s
            and (claimed is None or _spread(claimed, bounds))
        )
        return None if sensible else Rejection.SPEED

    def sensible(self, intervals: Intervals) -> int:
        """Number of the first intervals that `odometry` would not refuse, which are all in their
        order. 0 for a stream that has none yet.
        """
        if self._now_ns is None:
            return 0
        bounds = self._bounds
        speeds = bounds.speed_m_s, bounds.yaw_rate_rad_s
        longest_ns = min(bounds.interval_s * 1e9, 2.0**52)
        jump_ns = min(self._jump_ns, LONGEST_NS)
        return _sensible(intervals, self._now_ns, jump_ns, longest_ns, speeds)

    def passed(self, end_ns: int) -> None:
        """Note that all `sensible` intervals up to this time have been taken."""
        self._now_ns, self._jumped_ns = end_ns, None

    def time(self, stamp_ns: int) -> Rejection | None:
        """Why a measurement at this time is refused."""
        ahead_ns = 0 if self._now_ns is None else stamp_ns - self._now_ns
        return Rejection.TIME if ahead_ns > self._jump_ns else None

    def near(self, ranges: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Which ranges are within the bounds."""
        within: Bool[np.ndarray, " n"] = ranges <= self._bounds.extent_m
        return within


@compiled
def _sensible(
    intervals: Intervals,
    now_ns: int,
    jump_ns: int,
    longest_ns: float,
    speeds: tuple[float, float],
) -> int:
    for k in range(len(intervals.forward)):
        end_ns, duration_ns = intervals.ends_ns[k], intervals.durations_ns[k]
        in_time = 0 < end_ns - now_ns <= jump_ns and 0 < duration_ns <= longest_ns
        slow = abs(intervals.forward[k]) <= speeds[0] and abs(intervals.yaw_rates[k]) <= speeds[1]
        if not (in_time and slow):
            return k
        now_ns = end_ns
    return len(intervals.forward)
