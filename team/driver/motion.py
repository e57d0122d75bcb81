"""Convert odometry to consecutive intervals without gaps."""

from dataclasses import dataclass, field

import numpy as np

from teamslam.team.config import Bounds
from teamslam.team.driver.measurement_messages import MeasurementError, wrap_angles
from teamslam.team.odometry_resets import LEAST_STEPS, RESET_M, RESET_TIMES, USUAL_M_S

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
        """Return the length [ns] of the interval that ends now; None: the first, without a
        duration.
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
            self.steps += 1
            self.fastest = max(self.fastest, float(np.hypot(*step[:2])) / seconds)
            self.speeds = step[0] * 1e9 / duration_ns, step[2] * 1e9 / duration_ns

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
