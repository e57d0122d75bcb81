"""Check whether a stream's measurements are physically plausible."""

import math

import numpy as np

from teamslam.team.config import Bounds
from teamslam.team.estimation.odometry import OdometryInterval
from teamslam.team.estimation.plausibility import is_motion_spread as _spread
from teamslam.team.rejection import Rejection
from teamslam.team.shapes import Bool, Float


class StreamJudge:
    """Checks one incarnation of a sensor stream against the time of its last odometry.

    A stamp `jump_s` ahead of the odometry is refused, even of odometry, until the next interval
    confirms that the clock has jumped.
    """

    def __init__(self, bounds: Bounds, now_ns: int | None = None) -> None:
        self._bounds = bounds
        self._jump_ns = round(bounds.jump_s * 1e9)
        self._longest_ns = bounds.interval_s * 1e9
        self._now_ns = now_ns
        self._jumped_ns: int | None = None

    def odometry(self, interval: OdometryInterval) -> Rejection | None:
        """Return why an interval is refused: for `Rejection.SPEED` only its motion is."""
        stamp_ns, duration_ns, moved = interval.end_ns, interval.duration_ns, interval.moved
        if duration_ns == 0:
            return Rejection.NO_TIME
        if self._now_ns is not None:
            ahead_ns = stamp_ns - self._now_ns
            if ahead_ns <= 0:
                return Rejection.OLDER
            if ahead_ns > self._jump_ns:
                near_ns = self._now_ns if self._jumped_ns is None else self._jumped_ns
                if not 0 < stamp_ns - near_ns <= self._jump_ns:
                    self._jumped_ns = stamp_ns
                    return Rejection.TIME
        self._now_ns, self._jumped_ns = stamp_ns, None
        if math.isnan(interval.forward):
            return Rejection.STEERING
        bounds = self._bounds
        sensible = (
            duration_ns <= self._longest_ns
            and abs(interval.speed) <= bounds.speed_m_s
            and abs(interval.yaw_rate) <= bounds.yaw_rate_rad_s
            and (moved is None or moved.covariance is None or _spread(moved.covariance, bounds))
        )
        return None if sensible else Rejection.SPEED

    def time(self, stamp_ns: int) -> Rejection | None:
        """Return why a measurement at this time is refused."""
        is_ahead = self._now_ns is not None and stamp_ns - self._now_ns > self._jump_ns
        return Rejection.TIME if is_ahead else None

    def near(self, ranges: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Mask the ranges within the bounds."""
        within: Bool[np.ndarray, " n"] = ranges <= self._bounds.extent_m
        return within
