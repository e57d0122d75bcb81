"""Odometry as it comes, speeds or poses, to intervals that follow one another without a gap."""

from dataclasses import dataclass, field

import numpy as np

from team.config import Bounds
from team.driver.measured import MeasurementError, speeds

TOLERANCE = 0.1
"""A beginning may be off the last interval's end by this share of the interval, as clocks are."""
LEAST_NS = 2_000_000
"""… or by this."""


@dataclass(frozen=True)
class Interval:
    """Mean speed [m/s] and yaw rate [rad/s] over duration_ns, until stamp_ns."""

    stamp_ns: int
    duration_ns: int
    forward: float
    yaw_rate: float


@dataclass
class Odometer:
    """Where the odometry has come to: the end of its last interval, and the pose there if told.

    gap_ns: what no odometry covers before the last call, where that was more than clocks are off;
    0: nothing. The stream can not go on behind a gap: how the robot moved there nobody knows.
    """

    robot: str
    bounds: Bounds
    end_ns: int | None = None
    pose: tuple[float, float, float] | None = None
    gap_ns: int = field(default=0, init=False)

    def speeds(
        self, stamp_ns: int, forward: float, yaw_rate: float, duration_ns: int | None
    ) -> Interval | None:
        """An interval by its speeds; None for a first one that does not say how long it was."""
        what = self._what("odometry", stamp_ns)
        v, w = speeds(forward, yaw_rate, self.bounds, what)
        self._forward_only(stamp_ns, what)
        if duration_ns is None:
            if self.end_ns is None:
                self.end_ns = stamp_ns
                return None
            duration_ns = stamp_ns - self.end_ns
        if duration_ns <= 0:
            raise MeasurementError(f"{what}: its duration is not positive")
        return self._continued(Interval(stamp_ns, duration_ns, v, w), what)

    def posed(self, stamp_ns: int, pose: tuple[float, float, float]) -> Interval | None:
        """The interval since the last pose in the odometry's frame; None for the first pose."""
        what = self._what("odometry_pose", stamp_ns)
        self._forward_only(stamp_ns, what)
        before, self_end = self.pose, self.end_ns
        if before is None or self_end is None:
            self.end_ns, self.pose = stamp_ns, pose
            return None
        duration_ns = stamp_ns - self_end
        seconds = 1e-9 * duration_ns
        turn = float(np.pi - np.mod(np.pi - (pose[2] - before[2]), 2.0 * np.pi))
        dx, dy = pose[0] - before[0], pose[1] - before[1]
        middle = before[2] + 0.5 * turn
        half = 0.5 * turn
        arc = half / np.sin(half) if abs(half) > 1e-9 else 1.0
        ahead = float((dx * np.cos(middle) + dy * np.sin(middle)) * arc)
        v, w = speeds(ahead / seconds, turn / seconds, self.bounds, what)
        self.end_ns, self.pose, self.gap_ns = stamp_ns, pose, 0
        return Interval(stamp_ns, duration_ns, v, w)

    def _continued(self, interval: Interval, what: str) -> Interval:
        """The interval from where the last one ended; `gap_ns` says if nothing covers the time."""
        end_ns, begin_ns = self.end_ns, interval.stamp_ns - interval.duration_ns
        tolerance_ns = max(LEAST_NS, round(TOLERANCE * interval.duration_ns))
        self.gap_ns = 0
        if end_ns is not None and abs(begin_ns - end_ns) <= tolerance_ns:
            begin_ns = end_ns
        elif end_ns is not None and begin_ns < end_ns:
            raise MeasurementError(
                f"{what}: it begins {1e-9 * (end_ns - begin_ns):.3f} s before the last interval "
                "has ended: t is the interval's end; leave `duration` away for one without a gap"
            )
        elif end_ns is not None:
            self.gap_ns = begin_ns - end_ns
        self.end_ns, self.pose = interval.stamp_ns, None
        duration_ns = interval.stamp_ns - begin_ns
        return Interval(interval.stamp_ns, duration_ns, interval.forward, interval.yaw_rate)

    def _forward_only(self, stamp_ns: int, what: str) -> None:
        if self.end_ns is not None and stamp_ns <= self.end_ns:
            back_s = 1e-9 * (self.end_ns - stamp_ns)
            raise MeasurementError(
                f"{what}: time goes back by {back_s:.3f} s, behind {1e-9 * self.end_ns:.3f} s: "
                "hand odometry over once, in the order of its times"
            )

    def _what(self, call: str, stamp_ns: int) -> str:
        return f"{call} of {self.robot} at {1e-9 * stamp_ns:.3f} s"
