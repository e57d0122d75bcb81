"""Turns odometry as it arrives into intervals that follow one another without a gap."""

from dataclasses import dataclass, field

import numpy as np

from team.config import Bounds
from team.driver.measured import MeasurementError, wrapped
from team.odometry_resets import LEAST_STEPS, RESET_M, RESET_TIMES, USUAL_M_S

TOLERANCE = 0.1
"""An interval's start may differ from the last one's end by this share of it (clock jitter)."""
LEAST_NS = 2_000_000
"""… or by this."""
UNMEASURED = (1.0, 0.5)
"""Least standard deviation [m/s, rad/s] of a motion that was not measured; otherwise it is as large
as the motion itself."""
Pose = tuple[float, float, float]


@dataclass
class Odometer:
    """The odometry so far: the end of its last interval, and the odometry pose there if given.

    speeds: of the last interval, ahead [m/s] and turning [rad/s]. gap_ns: time before
    the last interval that no odometry covers, beyond clock jitter; 0: none. home: the first pose.
    steps, fastest: the number of intervals and their highest speed [m/s]. rates: of the last one,
    (ahead, left, turn) per second.
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
        """How long an interval is that ends now; None for a first one that does not say it.

        It begins where the last one ended, as far as clocks go. Nothing changes before `taken`.
        """
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
        """Refuse a motion that no robot can make; step: (ahead [m], left [m], turn [rad])."""
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

    def taken(self, stamp_ns: int, step: Pose, duration_ns: int, pose: Pose | None) -> None:
        """Note that the interval has been written to the file."""
        self.end_ns, self.pose = stamp_ns, pose
        self.home = self.home or pose
        if duration_ns:
            seconds = duration_ns * 1e-9
            self.rates = step[0] / seconds, step[1] / seconds, step[2] / seconds
            self.steps += 1
            self.fastest = max(self.fastest, float(np.hypot(*step[:2])) / seconds)
            self.speeds = step[0] * 1e9 / duration_ns, step[2] * 1e9 / duration_ns

    def was_reset(self, step: Pose, duration_ns: int, pose: Pose) -> bool:
        """Whether odometry poses begin anew: the first pose again, faster than the robot ever was,
        or a step that is RESET_TIMES as fast.
        """
        way, usual_m = float(np.hypot(*step[:2])), max(self.fastest, USUAL_M_S) * duration_ns * 1e-9
        home = pose == self.home and way > 2.0 * usual_m
        known = self.steps >= LEAST_STEPS and way > RESET_M
        return known and (home or way > RESET_TIMES * usual_m)

    def as_before(self, duration_ns: int) -> Pose:
        """The motion of an interval at the rates of the one before."""
        seconds = duration_ns * 1e-9
        return self.rates[0] * seconds, self.rates[1] * seconds, self.rates[2] * seconds

    def bridge(self) -> tuple[Pose, list[float]]:
        """The motion over the gap at the last speeds, with a large covariance.

        Standard deviations: of as much as the motion is, UNMEASURED at least, within half a turn.
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


def between(before: Pose, after: Pose) -> Pose:
    """A pose in the frame of the one before: (ahead, left, turn)."""
    dx, dy = after[0] - before[0], after[1] - before[1]
    c, s = float(np.cos(before[2])), float(np.sin(before[2]))
    turn = float(wrapped(np.array(after[2] - before[2])))
    return c * dx + s * dy, c * dy - s * dx, turn
