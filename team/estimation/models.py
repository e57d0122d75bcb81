"""Motion of one interval as a Gaussian on SE(2), a robot's segmenter, and the range-bearing sensor.

Thrun, Burgard and Fox 2005, sections 5.3 and 6.6, but with motion noise in the tangent space of the
motion's end, so that motions compose.

A measurement has its own covariance, or the sensor's. `Own` has no rows if no measurement has a
covariance, else a row (rr [m²], rb [m·rad], bb [rad²], form) for each. POLAR: of range and bearing.
POINT: of a point in the sensor's frame, to first order: diag(1, 1/r) S diag(1, 1/r), S along and
across the measured bearing. SENSOR: the sensor's noise, at the predicted range.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, Self

import msgspec
import numpy as np

from teamslam.team import core
from teamslam.team.config import Bounds, MotionModel, MotionNoise, Sensor
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Bool, Float

LONGEST_NS = 2**62  # bound of the difference of two stamps
UNSHIFTED = (0.0, 0.0, 0.0, 0.0)  # shift of a keyframe whose motion is calibrated
_BOUNDS = Bounds()
SENSOR, POLAR, POINT = -1.0, 0.0, 1.0
Own = Float[np.ndarray, "_ _"]


class Increment(msgspec.Struct, frozen=True, gc=False):
    """b_from_b': truth = mean ∘ Exp(xi), xi ~ N(0, covariance) in (forward, left, turn).

    mean: (x [m], y [m], theta [rad]). covariance: positive semi-definite, [m², m·rad, rad²].
    """

    mean: Pose
    covariance: Float[np.ndarray, "3 3"]

    @classmethod
    def identity(cls) -> Self:
        """Stand still, exactly."""
        return cls(np.zeros(3), np.zeros((3, 3)))

    def then(self, other: "Increment") -> "Increment":
        """Compose: mean₁ ∘ mean₂ with covariance Ad C₁ Adᵀ + C₂, Ad = Ad(mean₂⁻¹)."""
        return Increment(
            *core.compose_motions(self.mean, self.covariance, other.mean, other.covariance)
        )

    def keyframe(
        self, scan: core.Scan | None = None, shift: Sequence[float] = UNSHIFTED
    ) -> core.Keyframe:
        """Make a keyframe of this motion and the measurements at its end; shift: as there."""
        return core.Keyframe(0, (self.mean, self.covariance), scan, shift=shift)


@lru_cache(maxsize=256)
def model_of(motion: MotionModel) -> core.MotionModel:
    """Convert a motion model to the core's, cached."""
    base, limit = motion.wheel_base, motion.yaw_rate_limit
    return core.MotionModel(
        turns_first=motion.kind == "turn-then-drive",
        forward=_densities(motion.forward),
        turn=_densities(motion.turn),
        final_turn=_densities(motion.final_turn),
        lateral=_densities(motion.lateral),
        forward_scale=motion.forward_scale,
        yaw_scale=motion.yaw_scale,
        yaw_rate_limit=math.inf if limit is None else limit,
        turn_drag=motion.turn_drag,
        veer=motion.veer,
        slow_below=motion.slow_below,
        slow_scale=motion.slow_scale,
        covariance_factor=motion.covariance_factor,
        calibrated_speed=motion.calibrated_speed,
        alphas=motion.alphas,
        alpha_interval_s=motion.alpha_interval_s,
        wheels=None if base is None else (base, motion.left_wheel, motion.right_wheel),
        shares=motion.shares,
        shares_interval_s=motion.shares_interval_s,
    )


def _densities(noise: MotionNoise) -> tuple[float, float, float]:
    return noise.per_s, noise.per_m, noise.per_rad


def increment_of(
    motion: MotionModel, duration_s: float, forward: float, yaw_rate: float
) -> Increment:
    """Compute the motion of speeds [m/s, rad/s] held for `duration_s`."""
    return Increment(*model_of(motion).increment(duration_s, forward, yaw_rate))


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


def noise(sensor: Sensor, predicted_range: float) -> tuple[float, float]:
    """σ_range² [m²], σ_bearing² [rad²] at a range: σ_r² = range_sigma² + (per_m r)²."""
    slope = sensor.range_sigma_per_m * predicted_range
    return core.squared(sensor.range_sigma) + slope * slope, core.squared(sensor.bearing_sigma)


@lru_cache(maxsize=256)
def calibration_of(sensor: Sensor) -> core.Calibration:
    """Convert a sensor's calibration to the core's, cached."""
    lens = sensor.bearing_lens
    return core.Calibration(
        range_offset=sensor.range_offset,
        range_scale=sensor.range_scale,
        bearing_offset=sensor.bearing_offset,
        lens=None if lens.is_ideal else (lens.linear, lens.square, lens.cubic),
        optical_axis=sensor.optical_axis if sensor.range_is_depth else None,
        ranges=(sensor.min_range, sensor.max_range),
        half_field=0.5 * sensor.field_of_view,
    )


Scanned = tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]


def scanned(
    sensor: Sensor, ranges: Float[np.ndarray, " n"], bearings: Float[np.ndarray, " n"]
) -> Scanned:
    """Correct raw measurements; mark those in [min_range, max_range] and the field of view.

    Unmarked: not finite, a corrected range not positive, depths beyond OFF_AXIS.
    """
    return calibration_of(sensor).correct(ranges, bearings)


def corrected(
    sensor: Sensor, ranges: Float[np.ndarray, " n"], bearings: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Apply the calibration: ((r − range_offset)/range_scale, b − bearing_offset − lens(b)).

    A depth is also divided by cos(b − optical_axis); NaN where below OFF_AXIS.
    """
    return scanned(sensor, ranges, bearings)[1:]


class Noise(NamedTuple):
    """Variances of a measurement, and the white share of each; the rest is constant."""

    range_variance: float
    range_per_m2: float
    range_white: float
    bearing_variance: float
    bearing_white: float


@lru_cache(maxsize=256)
def noise_of(sensor: Sensor) -> Noise:
    """Return the variances of a sensor and their white shares, cached."""
    return Noise(
        core.squared(sensor.range_sigma),
        core.squared(sensor.range_sigma_per_m),
        sensor.range_white,
        core.squared(sensor.bearing_sigma),
        sensor.bearing_white,
    )


def unclaimed(count: int) -> Own:
    """Make the rows of measurements without covariances."""
    return np.empty((count, 0))


def variances(
    ranges: Float[np.ndarray, " n"], own: Own, sensor: Sensor
) -> Float[np.ndarray, "n 3"]:
    """Return (rr, rb, bb) of each measurement: claimed, or the sensor's at its range."""
    of_sensor = np.column_stack(
        (
            core.squared(sensor.range_sigma) + core.squared(sensor.range_sigma_per_m * ranges),
            np.zeros(len(ranges)),
            np.full(len(ranges), core.squared(sensor.bearing_sigma)),
        )
    )
    if not own.size:
        return of_sensor
    claims = own[:, 3] != SENSOR
    return np.where(claims[:, None], own[:, :3], of_sensor)


def nanoseconds(seconds: float) -> int:
    """Convert a configured duration to ns, bounded by the span of stamps."""
    return min(round(seconds * 1e9), LONGEST_NS)


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
