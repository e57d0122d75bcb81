"""One interval of odometry, and any part of it as a Gaussian on SE(2).

Odometry reports mean speeds (`models.increment_of`), a car's wheel speed and steering angle, or a
motion on SE(2) with a part to the left, with or without a covariance of its own.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from team.config import MotionModel
from team.estimation import dense, elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import Pose, adjoint, exponential, logarithm
from team.estimation.models import (
    Increment,
    increment_of,
    known_model,
    motion_variances,
    scale_column,
)


class Moved(NamedTuple):
    """A measured motion Exp(twist), twist = (forward [m], left [m], turn [rad]) of the interval.

    covariance: the source's own covariance of the error, in the tangent space of the motion's end.
    """

    twist: Pose
    covariance: Float[np.ndarray, "3 3"] | None = None


class OdometryInterval(NamedTuple):
    """One odometry interval that ends at end_ns: mean forward speed [m/s] and yaw rate [rad/s].

    moved: the motion, where the odometry reports one; the speeds are then those of its twist.
    """

    end_ns: int
    duration_ns: int
    forward: float
    yaw_rate: float
    moved: Moved | None = None

    def part(self, motion: MotionModel, duration_ns: int, rest_ns: int) -> Increment:
        """Compute the motion of a part of the interval, which is followed by rest_ns of it."""
        if self.moved is None:
            return increment_of(motion, duration_ns * 1e-9, self.forward, self.yaw_rate)
        share, rest = duration_ns / self.duration_ns, rest_ns / self.duration_ns
        return part_of(motion, self.moved, self.duration_ns * 1e-9, share, rest)

    def gone_on(self, end_ns: int, duration_ns: int) -> "OdometryInterval":
        """Extrapolate to a later interval at the same speeds."""
        if self.moved is None:
            return self._replace(end_ns=end_ns, duration_ns=duration_ns)
        twist = self.moved.twist * (duration_ns / self.duration_ns)
        return self._replace(end_ns=end_ns, duration_ns=duration_ns, moved=Moved(twist))

    @property
    def speed(self) -> float:
        """Magnitude of the velocity [m/s]; without a reported motion, the signed forward speed."""
        if self.moved is None:
            return self.forward
        return elementary.hypot(*self.moved.twist[:2]) / (self.duration_ns * 1e-9)

    def forward_column(self, motion: MotionModel, duration_ns: int) -> Float[np.ndarray, "3"]:
        """Compute `forward_column` of a part of the interval."""
        if self.moved is None:
            return forward_column(motion, duration_ns * 1e-9, self.forward, self.yaw_rate)
        column, speeds = np.zeros(3), motion.calibrated_speed
        if speeds is None or speeds[0] <= self.speed <= speeds[1]:
            return column
        share = duration_ns / self.duration_ns
        x, y, turn = share * calibrated(motion, self.moved.twist, self.duration_ns * 1e-9)
        s, c = elementary.sin_and_cos(0.5 * turn)
        column[0], column[1] = c * x + s * y, c * y - s * x
        return column


STANDING = OdometryInterval(0, 1, 0.0, 0.0)
"""The interval assumed before the first measurement."""


def forward_column(
    motion: MotionModel, duration_s: float, forward: float, yaw_rate: float
) -> Float[np.ndarray, "3"]:
    """Compute d/db at 0 of the interval's motion if the true path length is (1 + b) times the
    measured one.

    In the tangent space of its end; zero where |forward| lies in `calibrated_speed`, whose scale is
    known, and without such a range.
    """
    ahead, left = scale_column(known_model(motion), duration_s, forward, yaw_rate)
    return np.array([ahead, left, 0.0])


def steered(motion: MotionModel, wheel_speed: float, steering: float) -> tuple[float, float]:
    """Compute (forward [m/s], yaw rate [rad/s]) of a car from its wheel and steering encoders.

    With s = steering + steering_offset, v = u/(1 − tan(s) h/L) and ω = v tan(s)/L: the wheel at (0,
    h) of a base that turns at ω moves at u = v − ω h (Nebot, Victoria Park). Two NaN where the
    model is not a car's, or the wheel is at the centre of the turn.
    """
    if motion.kind != "ackermann" or motion.wheel_base is None:
        return math.nan, math.nan
    slope = elementary.tan(steering + motion.steering_offset)
    share = 1.0 - slope * motion.wheel_offset / motion.wheel_base
    if not share > 0.0:
        return math.nan, math.nan
    forward = wheel_speed / share
    return forward, forward * slope / motion.wheel_base


def moved(increment: Pose, covariance: Float[np.ndarray, "3 3"] | None) -> Moved:
    """Convert a motion whose end, seen in its start, is `increment` (x, y, theta), |theta| ≤ π."""
    return Moved(logarithm(increment), covariance)


def calibrated(motion: MotionModel, twist: Pose, duration_s: float) -> Pose:
    """Apply the model's scales, limit, drag and veer to a measured twist, as `increment_of`.

    The scales of speed apply to the path length in any direction; veer follows its forward part.
    """
    limit = math.inf if motion.yaw_rate_limit is None else motion.yaw_rate_limit
    turn = motion.yaw_scale * float(twist[2])
    turn = min(max(turn, -limit * duration_s), limit * duration_s)
    way = elementary.hypot(twist[0], twist[1])
    scale = motion.slow_scale if way < motion.slow_below * duration_s else motion.forward_scale
    effective = max(scale * way - motion.turn_drag * abs(turn), 0.0)
    share = effective / way if way > 0.0 else 0.0
    forward, left = share * float(twist[0]), share * float(twist[1])
    return np.array([forward, left, turn + motion.veer * forward])


def part_of(
    motion: MotionModel, whole: Moved, duration_s: float, share: float, rest: float
) -> Increment:
    """Compute a share of a measured motion at constant twist, followed by the share `rest`.

    Without the source's covariance the noise is the model's over this path length, turn and time.
    The source's covariance C is of the whole interval: a share f of it is f Ad C Adᵀ, with Ad of
    the motion that follows. Seen from the interval's end the error then grows evenly, so however
    the interval is split, its parts compose to C: Σ Ad⁻¹ (f Ad C Adᵀ) Ad⁻ᵀ = C.
    """
    twist = calibrated(motion, whole.twist, duration_s)
    xi = share * twist
    if whole.covariance is None:
        way = math.copysign(elementary.hypot(xi[0], xi[1]), xi[0])
        noises = motion_variances(motion, share * duration_s, way, float(xi[2]))
        return Increment(exponential(xi), _spread(xi, way, noises))
    Ad = adjoint(exponential(rest * twist))
    C = (
        motion.covariance_factor
        * share
        * (dense.product(dense.product(Ad, whole.covariance), Ad.T))
    )
    return Increment(exponential(xi), 0.5 * (C + C.T))


@compiled
def _spread(
    xi: Pose, way: float, noises: tuple[float, float, float, float, float]
) -> Float[np.ndarray, "3 3"]:
    """Compute the covariance at its end of Exp(ξ + (a u, b)), then l across the path and a final
    turn c.

    (ξ₀, ξ₁) = d u with the path length d, negative backwards; u stays the direction of motion in
    the moving frame. a and b act through Jr (u, 0) and the last column of SE(2)'s right Jacobian Jr
    at ξ (Solà et al., A micro Lie theory, eq. 163).
    """
    forward_var, turn_var, both, final, lateral = noises
    x, y, turn = xi[0], xi[1], xi[2]
    if abs(turn) < 1e-3:
        square = turn * turn
        sine = 1.0 - square / 6.0
        cosine = 0.5 - square / 24.0
        cubic = turn * (1.0 / 6.0 - square / 120.0)
    else:
        s = elementary.sin(turn)
        sine = s / turn
        cosine = 2.0 * (elementary.sin(0.5 * turn) / turn) ** 2
        cubic = (turn - s) / (turn * turn)
    ux, uy = (x / way, y / way) if way != 0.0 else (1.0, 0.0)
    ax, ay = sine * ux + turn * cosine * uy, -turn * cosine * ux + sine * uy
    bx, by = x * cubic - y * cosine, x * cosine + y * cubic
    C = np.empty((3, 3))
    C[0, 0] = forward_var * ax * ax + turn_var * bx * bx + 2.0 * both * ax * bx + lateral * uy * uy
    C[0, 1] = forward_var * ax * ay + turn_var * bx * by + both * (ax * by + ay * bx)
    C[0, 1] -= lateral * ux * uy
    C[1, 1] = forward_var * ay * ay + turn_var * by * by + 2.0 * both * ay * by + lateral * ux * ux
    C[0, 2] = turn_var * bx + both * ax
    C[1, 2] = turn_var * by + both * ay
    C[2, 2] = turn_var + final
    C[1, 0], C[2, 0], C[2, 1] = C[0, 1], C[0, 2], C[1, 2]
    return C
