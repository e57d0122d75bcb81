"""An interval of odometry, and any part of it, as a Gaussian on SE(2)."""

import math
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from teamslam.team import core
from teamslam.team.config import MotionModel
from teamslam.team.estimation.models import Increment, increment_of, model_of
from teamslam.team.estimation.se2 import Pose, logarithm
from teamslam.team.shapes import Float


class Moved(NamedTuple):
    """A measured motion Exp(twist), twist = (forward [m], left [m], turn [rad]).

    covariance: reported, of the error in the tangent space of the motion's end.
    """

    twist: Pose
    covariance: Float[np.ndarray, "3 3"] | None = None


class OdometryInterval(msgspec.Struct, frozen=True, gc=False):
    """An odometry interval until end_ns: mean forward speed [m/s] and yaw rate [rad/s].

    moved: a reported motion, whose twist gives the speeds.
    """

    end_ns: int
    duration_ns: int
    forward: float
    yaw_rate: float
    moved: Moved | None = None

    def part(self, motion: MotionModel, duration_ns: int, rest_ns: int) -> Increment:
        """Compute the motion of a part of the interval, rest_ns before its end."""
        if self.moved is None:
            return increment_of(motion, duration_ns * 1e-9, self.forward, self.yaw_rate)
        share, rest = duration_ns / self.duration_ns, rest_ns / self.duration_ns
        interval_s = self.duration_ns * 1e-9
        return Increment(*model_of(motion).part(*self.moved, interval_s, share, rest))

    def gone_on(self, end_ns: int, duration_ns: int) -> "OdometryInterval":
        """Extrapolate to a later interval at the same speeds."""
        if self.moved is None:
            return replace(self, end_ns=end_ns, duration_ns=duration_ns)
        twist = self.moved.twist * (duration_ns / self.duration_ns)
        return replace(self, end_ns=end_ns, duration_ns=duration_ns, moved=Moved(twist))

    @property
    def speed(self) -> float:
        """Magnitude of the velocity [m/s]; without a reported motion, signed."""
        if self.moved is None:
            return self.forward
        forward, left, _ = self.moved.twist.tolist()
        return core.hypot(float(forward), float(left)) / (self.duration_ns * 1e-9)


STANDING = OdometryInterval(0, 1, 0.0, 0.0)
"""The interval assumed before the first measurement."""


def steered(motion: MotionModel, wheel_speed: float, steering: float) -> tuple[float, float]:
    """Compute (forward [m/s], yaw rate [rad/s]) of a car from wheel and steering encoders.

    With s = steering + steering_offset, v = u/(1 − tan(s) h/L) and ω = v tan(s)/L: the wheel at (0,
    h) of a base that turns at ω moves at u = v − ω h (Nebot, Victoria Park). NaN where the model is
    not a car's, or the wheel is at the centre of the turn.
    """
    if motion.kind != "ackermann" or motion.wheel_base is None:
        return math.nan, math.nan
    slope = core.tan(steering + motion.steering_offset)
    share = 1.0 - slope * motion.wheel_offset / motion.wheel_base
    if not share > 0.0:
        return math.nan, math.nan
    forward = wheel_speed / share
    return forward, forward * slope / motion.wheel_base


def moved(increment: Pose, covariance: Float[np.ndarray, "3 3"] | None) -> Moved:
    """Convert a motion, given by its end in the frame of its start, |theta| ≤ π."""
    return Moved(logarithm(increment), covariance)
