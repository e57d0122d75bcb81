"""Odometry of a robot in the core's form, and the bounds of its stream."""

import math
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Bounds, MotionModel, Sensor
from teamslam.team.core import OdometryInterval
from teamslam.team.estimation.models import calibration_of, model_of
from teamslam.team.estimation.se2 import Pose, logarithm
from teamslam.team.shapes import Float

__all__ = ["LONGEST_NS", "Moved", "OdometryInterval", "moved", "nanoseconds", "segmenter_of",
           "steered", "stream_bounds"]  # fmt: skip

LONGEST_NS = 2**62  # bound of the difference of two stamps
_BOUNDS = Bounds()


def nanoseconds(seconds: float) -> int:
    """Convert a configured duration to ns, bounded by the span of stamps."""
    return min(round(seconds * 1e9), LONGEST_NS)


class Moved(NamedTuple):
    """A measured motion Exp(twist), twist = (forward [m], left [m], turn [rad]).

    covariance: as reported, in the tangent space of the motion's end.
    """

    twist: Pose
    covariance: Float[np.ndarray, "3 3"] | None = None


def segmenter_of(
    motion: MotionModel,
    sensor: Sensor,
    keyframe_s: float,
    window_s: float | None = None,
    bounds: Bounds = _BOUNDS,
) -> core.Segmenter:
    """Make the segmenter of a robot's stream; window_s: of a stream with windows."""
    return core.Segmenter(
        model_of(motion),
        np.array(sensor.mount) if sensor.is_mounted else None,
        calibration_of(sensor),
        sensor.covariance_factor,
        nanoseconds(keyframe_s),
        LONGEST_NS if window_s is None else nanoseconds(window_s),
        stream_bounds(bounds),
    )


def stream_bounds(bounds: Bounds) -> core.StreamBounds:
    """Convert the bounds of a sensor stream to the core's."""
    return core.StreamBounds(
        nanoseconds(bounds.jump_s),
        bounds.interval_s,
        bounds.speed_m_s,
        bounds.yaw_rate_rad_s,
        bounds.extent_m,
        bounds.sigma_m,
        bounds.sigma_rad,
    )


def steered(motion: MotionModel, wheel_speed: float, steering: float) -> tuple[float, float]:
    """Compute (forward [m/s], yaw rate [rad/s]) of a car from wheel and steering encoders.

    With s = steering + steering_offset, v = u/(1 − tan(s) h/L) and ω = v tan(s)/L: the wheel at (0,
    h) of a base that turns at ω moves at u = v − ω h (Nebot, Victoria Park). NaN for models other
    than a car's, or a wheel at the centre of the turn.
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
    """Convert a motion, given as the end pose in the start's frame with |theta| ≤ π."""
    return Moved(logarithm(increment), covariance)
