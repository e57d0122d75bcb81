"""The motion of one interval as a Gaussian on SE(2), and the range-bearing sensor.

Both are textbook models (Thrun, Burgard and Fox 2005, sections 5.3 and 6.6) with the motion noise
in the tangent space of the motion's end, so that motions compose.
"""

import math
from functools import lru_cache
from typing import NamedTuple, Self

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from team.config import Alphas, MotionModel, MotionNoise, Sensor
from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import Point, Pose, adjoint, inverse, swept, wrapped

NEAREST_M = 1e-3
"""Least range [m]: a nearer point has no bearing."""
OFF_AXIS = 0.17364817766693041
"""Least cosine of the angle to the optical axis at which a depth determines a range."""


class Increment(msgspec.Struct, frozen=True, gc=False):
    """b_from_b': truth = mean ∘ Exp(xi), xi ~ N(0, covariance) in (forward, left, turn).

    mean:       (x [m], y [m], theta [rad]).
    covariance: symmetric positive semi-definite, of any rank, [m², m·rad, rad²].
    """

    mean: Pose
    covariance: Float[np.ndarray, "3 3"]

    @classmethod
    def identity(cls) -> Self:
        """Standing still, exactly."""
        return cls(np.zeros(3), np.zeros((3, 3)))

    def then(self, other: "Increment") -> "Increment":
        """mean₁ ∘ mean₂ with covariance Ad C₁ Adᵀ + C₂, Ad = Ad(mean₂⁻¹)."""
        return Increment(
            *composed(self.mean, self.covariance, other.mean, other.covariance),
        )


@compiled
def composed(
    mean: Pose, covariance: Float[np.ndarray, "3 3"], then: Pose, added: Float[np.ndarray, "3 3"]
) -> tuple[Pose, Float[np.ndarray, "3 3"]]:
    """T₁Exp(ξ₁)T₂Exp(ξ₂) = T₁T₂Exp(Ad(T₂⁻¹)ξ₁)Exp(ξ₂), to first order in the noise."""
    after, total = mean.copy(), covariance.copy()
    carry(after, total, then, added, adjoint(inverse(then)), np.empty((3, 3)))
    return after, total


@compiled
def carry(
    mean: Pose,
    covariance: Float[np.ndarray, "3 3"],
    then: Pose,
    added: Float[np.ndarray, "3 3"],
    Ad: Float[np.ndarray, "3 3"],
    half: Float[np.ndarray, "3 3"],
) -> None:
    """`composed` in place; Ad: of then⁻¹, half: scratch."""
    for i in range(3):
        for j in range(3):
            half[i, j] = (
                Ad[i, 0] * covariance[0, j]
                + Ad[i, 1] * covariance[1, j]
                + Ad[i, 2] * covariance[2, j]
            )
    for i in range(3):
        for j in range(i, 3):
            covariance[i, j] = added[i, j] + (
                half[i, 0] * Ad[j, 0] + half[i, 1] * Ad[j, 1] + half[i, 2] * Ad[j, 2]
            )
            covariance[j, i] = covariance[i, j]
    go(mean, then)


@compiled
def go(pose: Pose, then: Pose) -> None:
    """`geometry.compose` in place."""
    s, c = elementary.sin_and_cos(pose[2])
    pose[0], pose[1] = (
        pose[0] + c * then[0] - s * then[1],
        pose[1] + s * then[0] + c * then[1],
    )
    pose[2] = wrapped(pose[2] + then[2])


class CourseModel(NamedTuple):
    """The parameters of a `MotionModel` for the kernels (`model_of`).

    Densities are (per_s, per_m, per_rad). An absent part of a model has its flag down; an absent
    limit is infinite, as is the range of speeds whose scale is known.
    """

    turns_first: bool
    forward: tuple[float, float, float]
    turn: tuple[float, float, float]
    final_turn: tuple[float, float, float]
    lateral: tuple[float, float, float]
    forward_scale: float
    yaw_scale: float
    yaw_rate_limit: float
    turn_drag: float
    veer: float
    slow_below: float
    slow_scale: float
    calibrated_speed: tuple[float, float]
    has_alphas: bool
    alphas: tuple[float, float, float, float, float, float]
    alpha_interval_s: float
    has_wheels: bool
    wheels: tuple[float, float, float]
    has_shares: bool
    shares: tuple[float, float, float]
    shares_interval_s: float


Densities = tuple[float, float, float]
Course = tuple[float, float, float, float, float, float, float]


def model_of(motion: MotionModel) -> CourseModel:
    """Convert a motion model to the kernels' parameters."""
    alphas, shares, base = motion.alphas, motion.shares, motion.wheel_base
    speeds = motion.calibrated_speed
    return CourseModel(
        turns_first=motion.kind == "turn-then-drive",
        forward=_densities(motion.forward),
        turn=_densities(motion.turn),
        final_turn=_densities(motion.final_turn),
        lateral=_densities(motion.lateral),
        forward_scale=motion.forward_scale,
        yaw_scale=motion.yaw_scale,
        yaw_rate_limit=math.inf if motion.yaw_rate_limit is None else motion.yaw_rate_limit,
        turn_drag=motion.turn_drag,
        veer=motion.veer,
        slow_below=motion.slow_below,
        slow_scale=motion.slow_scale,
        calibrated_speed=(-math.inf, math.inf) if speeds is None else speeds,
        has_alphas=alphas is not None,
        alphas=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) if alphas is None else alphas,
        alpha_interval_s=motion.alpha_interval_s,
        has_wheels=base is not None,
        wheels=(1.0 if base is None else base, motion.left_wheel, motion.right_wheel),
        has_shares=shares is not None,
        shares=(0.0, 0.0, 0.0) if shares is None else shares,
        shares_interval_s=motion.shares_interval_s,
    )


def _densities(noise: MotionNoise) -> Densities:
    return float(noise.per_s), float(noise.per_m), float(noise.per_rad)


@lru_cache(maxsize=256)
def known_model(motion: MotionModel) -> CourseModel:
    """Convert a motion model as `model_of`, cached."""
    return model_of(motion)


def increment_of(
    motion: MotionModel, duration_s: float, forward: float, yaw_rate: float
) -> Increment:
    """Compute the motion of one odometry interval: `forward` [m/s] and `yaw_rate` [rad/s] held for
    `duration_s`.

    The motion of `course_of`, with its noise in the tangent space of its end.
    """
    model = known_model(motion)
    kernel = turn_then_drive if model.turns_first else arc
    return Increment(*kernel(*course_of(model, duration_s, forward, yaw_rate)))


@compiled
def course_of(model: CourseModel, duration_s: float, forward: float, yaw_rate: float) -> Course:
    """Compute the path length [m] and turn [rad] of an interval, and their `_variances`.

    With v = forward_scale·forward (slow_scale·forward where |forward| < slow_below),
    ω = clip(yaw_scale·yaw_rate, ±yaw_rate_limit), the path length
    d = sign(v) max(|v| − turn_drag·|ω|, 0)·t, the turn φ = ω t + veer·d and the noises a (forward,
    on d), b (turn, on φ), c (final turn), l (lateral), the motion is

    - "turn-then-drive": turn φ + b, drive d + a, then (0, l, c): the thesis, section 4.3.1;
    - all others: Exp(d + a, 0, φ + b), then (0, l, c): the arc of Thrun et al. table 5.3 and Ma &
      Ma eq. 1-4, with its limit φ → 0.

    Each variance is the density's per_s² t + per_m² |d| + per_rad² |φ|, plus the terms of
    `_of_alphas`, `_of_wheels` and the shares; only the wheels correlate a and b.
    """
    rate = _clipped(model.yaw_scale * yaw_rate, model.yaw_rate_limit)
    lost = model.turn_drag * abs(rate) * duration_s
    scale = model.slow_scale if abs(forward) < model.slow_below else model.forward_scale
    logged = scale * forward * duration_s
    left = abs(logged) - lost
    distance = math.copysign(0.0 if left < 0.0 else left, logged)
    turn = rate * duration_s + model.veer * distance
    forward_var, turn_var, both, final, lateral = _variances(model, duration_s, distance, turn)
    return distance, turn, forward_var, turn_var, both, final, lateral


@compiled
def _clipped(rate: float, limit: float) -> float:
    if rate < -limit:
        return -limit
    return limit if rate > limit else rate


def motion_variances(
    motion: MotionModel, duration_s: float, distance: float, turn: float
) -> tuple[float, float, float, float, float]:
    """Compute the `_variances` of a motion model over a path length [m] and a turn [rad]."""
    return _variances(known_model(motion), duration_s, distance, turn)


@compiled
def _variances(
    model: CourseModel, duration_s: float, distance: float, turn: float
) -> tuple[float, float, float, float, float]:
    """Variances of forward, turn, final-turn and lateral noise, with cov(forward, turn) before the
    last two, for a path length and a turn.
    """
    forward_var = _variance(model.forward, duration_s, distance, turn)
    turn_var = _variance(model.turn, duration_s, distance, turn)
    final = _variance(model.final_turn, duration_s, distance, turn)
    both = 0.0
    if model.has_alphas and duration_s > 0.0:
        added = _of_alphas(model.alphas, model.alpha_interval_s, duration_s, distance, turn)
        forward_var, turn_var, final = forward_var + added[0], turn_var + added[1], final + added[2]
    if model.has_wheels:
        base, left, right = model.wheels
        added = _of_wheels(base, left, right, distance, turn)
        forward_var, turn_var, both = forward_var + added[0], turn_var + added[1], added[2]
    lateral = _variance(model.lateral, duration_s, distance, turn)
    if model.has_shares and duration_s > 0.0:
        shared = distance * distance * model.shares_interval_s / duration_s
        along, across, heading = model.shares
        forward_var += along * along * shared
        lateral += across * across * shared
        turn_var += heading * heading * shared
    return forward_var, turn_var, both, final, lateral


@compiled
def _variance(noise: Densities, duration_s: float, distance: float, turn: float) -> float:
    per_s, per_m, per_rad = noise
    return (
        per_s * per_s * duration_s + per_m * per_m * abs(distance) + per_rad * per_rad * abs(turn)
    )


@compiled
def _of_alphas(
    alphas: Alphas, interval_s: float, duration_s: float, distance: float, turn: float
) -> tuple[float, float, float]:
    """Compute variances of (forward [m²], turn [rad²], final turn [rad²]) by Ma & Ma's α₁ … α₆.

    Their errors of v, ω and γ have the variances α₁v² + α₂ω², α₃v² + α₄ω², α₅v² + α₆ω² and are held
    for one interval T (eq. 2-4): times T² on the path and the turns. As a density that is T·t.
    """
    v, w = distance / duration_s, turn / duration_s
    v2, w2 = v * v, w * w
    spread = interval_s * duration_s
    a1, a2, a3, a4, a5, a6 = alphas
    return (
        (a1 * v2 + a2 * w2) * spread,
        (a3 * v2 + a4 * w2) * spread,
        (a5 * v2 + a6 * w2) * spread,
    )


@compiled
def _of_wheels(
    base: float, left: float, right: float, distance: float, turn: float
) -> tuple[float, float, float]:
    """Compute (var d, var φ, cov(d, φ)) of the wheels' errors: J diag(V_l, V_r) Jᵀ, V = noise²
    |way|.

    d = (s_r + s_l)/2 and φ = (s_r − s_l)/base (Downs eq. 2.3-2.4), so s = d ± φ base/2 and J =
    [[1/2, 1/2], [−1/base, 1/base]] for (s_l, s_r).
    """
    half = 0.5 * base * turn
    of_left, of_right = left * left * abs(distance - half), right * right * abs(distance + half)
    total = of_left + of_right
    return 0.25 * total, total / (base * base), 0.5 * (of_right - of_left) / base


@compiled
def scale_column(
    model: CourseModel, duration_s: float, forward: float, yaw_rate: float
) -> tuple[float, float]:
    """Compute d/db at 0 of the interval's motion (ahead, left) if the true path length is (1 + b)
    times the measured one, in the tangent space of its end: `odometry.forward_column`.
    """
    least, most = model.calibrated_speed
    if least <= abs(forward) <= most:
        return 0.0, 0.0
    way = model.forward_scale * forward * duration_s
    if model.turns_first:
        return way, 0.0
    turn = _clipped(model.yaw_scale * yaw_rate, model.yaw_rate_limit) * duration_s
    s, c = elementary.sin_and_cos(0.5 * turn)
    return way * c, -way * s


@compiled
def arc(
    distance: float,
    turn: float,
    forward_var: float,
    turn_var: float,
    both: float,
    final: float,
    lateral: float,
) -> tuple[Pose, Float[np.ndarray, "3 3"]]:
    """Return the motion of `drive_arc`."""
    step, covariance = np.empty(3), np.empty((3, 3))
    course = distance, turn, forward_var, turn_var, both, final, lateral
    drive_arc(course, step, covariance)
    return step, covariance


@compiled
def drive_arc(course: Course, step: Pose, covariance: Float[np.ndarray, "3 3"]) -> None:
    """Write the motion of an arc and its noise, in place, by the two columns of SE(2)'s right
    Jacobian at (d, 0, φ) for the noises a and b.

    Jr₁ = (sin φ/φ, −(1 − cos φ)/φ, 0), Jr₃ = (d(φ − sin φ)/φ², d(1 − cos φ)/φ², 1); Solà et al., A
    micro Lie theory, eq. 163. Near φ = 0 the quotients are taken from their series. `both` is the
    covariance of a and b.
    """
    distance, turn, forward_var, turn_var, both, final, lateral = course
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
    ax, ay = sine, -turn * cosine
    bx, by = distance * cubic, distance * cosine
    covariance[0, 0] = forward_var * ax * ax + turn_var * bx * bx + 2.0 * both * ax * bx
    covariance[0, 1] = forward_var * ax * ay + turn_var * bx * by + both * (ax * by + ay * bx)
    covariance[1, 1] = forward_var * ay * ay + turn_var * by * by + 2.0 * both * ay * by + lateral
    covariance[0, 2] = turn_var * bx + both * ax
    covariance[1, 2] = turn_var * by + both * ay
    covariance[2, 2] = turn_var + final
    covariance[1, 0] = covariance[0, 1]
    covariance[2, 0] = covariance[0, 2]
    covariance[2, 1] = covariance[1, 2]
    step[0], step[1] = swept(distance, 0.0, turn)
    step[2] = wrapped(turn)


@compiled
def turn_then_drive(
    distance: float,
    turn: float,
    forward_var: float,
    turn_var: float,
    both: float,
    final: float,
    lateral: float,
) -> tuple[Pose, Float[np.ndarray, "3 3"]]:
    """Return the motion of `turn_and_drive`."""
    step, covariance = np.empty(3), np.empty((3, 3))
    course = distance, turn, forward_var, turn_var, both, final, lateral
    turn_and_drive(course, step, covariance)
    return step, covariance


@compiled
def turn_and_drive(course: Course, step: Pose, covariance: Float[np.ndarray, "3 3"]) -> None:
    """Write the motion of a turn and a straight path after it, and its noise, in place.

    The noises (a, b) reach the end's tangent space by J = [[1, 0], [0, d], [0, 1]].
    """
    distance, turn, forward_var, turn_var, both, final, lateral = course
    s, c = elementary.sin_and_cos(turn)
    covariance[0, 0] = forward_var
    covariance[0, 1] = covariance[1, 0] = both * distance
    covariance[0, 2] = covariance[2, 0] = both
    covariance[1, 1] = turn_var * distance * distance + lateral
    covariance[1, 2] = turn_var * distance
    covariance[2, 1] = turn_var * distance
    covariance[2, 2] = turn_var + final
    step[0], step[1], step[2] = distance * c, distance * s, wrapped(turn)


@compiled
def predicted(pose: Pose, landmark: Point) -> tuple[float, float]:
    """Predict range [m] and bearing [rad] of a point landmark from a pose, both in the map frame.

    range = max(‖landmark − (x, y)‖, NEAREST_M), bearing = atan2(Δy, Δx) − theta in (−π, π].
    """
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    distance = max(math.sqrt(dx * dx + dy * dy), NEAREST_M)
    return distance, wrapped(elementary.atan2(dy, dx) - pose[2])


@compiled
def pose_jacobian(distance: float, bearing: float) -> Float[np.ndarray, "2 3"]:
    """Compute ∂z/∂xi of h(pose ∘ Exp(xi), landmark) at xi = 0, from the predicted (range,
    bearing).
    """
    s, c = elementary.sin_and_cos(bearing)
    return np.array([[-c, -s, 0.0], [s / distance, -c / distance, -1.0]])


@compiled
def landmark_jacobian(distance: float, direction: float) -> Float[np.ndarray, "2 2"]:
    """Compute ∂z/∂landmark, from the predicted range and the direction = theta + bearing in the
    map.
    """
    s, c = elementary.sin_and_cos(direction)
    return np.array([[c, s], [-s / distance, c / distance]])


@compiled
def located(pose: Pose, distance: float, bearing: float) -> Point:
    """Invert the model: the point at (range, bearing) from pose, in the pose's map frame."""
    s, c = elementary.sin_and_cos(pose[2] + bearing)
    return np.array([pose[0] + distance * c, pose[1] + distance * s])


def noise(sensor: Sensor, predicted_range: float) -> tuple[float, float]:
    """Compute (σ_range² [m²], σ_bearing² [rad²]) at a range: σ_r² = range_sigma² + (per_m r)²."""
    slope = sensor.range_sigma_per_m * predicted_range
    return elementary.squared(sensor.range_sigma) + slope * slope, elementary.squared(
        sensor.bearing_sigma
    )


def variances(sensor: Sensor) -> tuple[float, float, float]:
    """Return (σ_range² [m²], σ_range_per_m², σ_bearing² [rad²]), the kernels' form of a sensor."""
    return (
        elementary.squared(sensor.range_sigma),
        elementary.squared(sensor.range_sigma_per_m),
        elementary.squared(sensor.bearing_sigma),
    )


class Calibration(NamedTuple):
    """The parameters of a `Sensor` that correct a raw measurement, or refuse it."""

    range_offset: float
    range_scale: float
    bearing_offset: float
    has_lens: bool
    lens: tuple[float, float, float]
    range_is_depth: bool
    optical_axis: float
    ranges: tuple[float, float]
    half_field: float


@lru_cache(maxsize=256)
def calibration_of(sensor: Sensor) -> Calibration:
    """Return the calibration of a sensor for the kernel."""
    lens = sensor.bearing_lens
    return Calibration(
        range_offset=float(sensor.range_offset),
        range_scale=float(sensor.range_scale),
        bearing_offset=float(sensor.bearing_offset),
        has_lens=not lens.is_ideal,
        lens=(float(lens.linear), float(lens.square), float(lens.cubic)),
        range_is_depth=sensor.range_is_depth,
        optical_axis=float(sensor.optical_axis),
        ranges=(float(sensor.min_range), float(sensor.max_range)),
        half_field=0.5 * sensor.field_of_view,
    )


Scanned = tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]


def scanned(
    sensor: Sensor, ranges: Float[np.ndarray, " n"], bearings: Float[np.ndarray, " n"]
) -> Scanned:
    """Compute `acceptable` and `corrected` of the same measurements, in one call."""
    raw = np.array(ranges, np.float64), np.array(bearings, np.float64)
    return _scanned(calibration_of(sensor), *raw)


def corrected(
    sensor: Sensor, ranges: Float[np.ndarray, " n"], bearings: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Apply the calibration: ((r − range_offset)/range_scale, b − bearing_offset − lens(b)).

    A depth is divided by cos(b − optical_axis) too; where that is below OFF_AXIS it is NaN.
    """
    return scanned(sensor, ranges, bearings)[1:]


def acceptable(
    sensor: Sensor, ranges: Float[np.ndarray, " n"], bearings: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Mark raw measurements in [min_range, max_range] and in the field of view.

    Not finite measurements, those whose corrected range is not positive, and depths beyond OFF_AXIS
    are not.
    """
    return scanned(sensor, ranges, bearings)[0]


@compiled
def _scanned(
    by: Calibration, ranges: Float[np.ndarray, " n"], bearings: Float[np.ndarray, " n"]
) -> Scanned:
    mask, n = np.empty(len(ranges), np.bool_), len(ranges)
    distances, turned = np.empty(n), np.empty(n)
    linear, square, cubic = by.lens
    least, most = by.ranges
    for k in range(len(ranges)):
        r, b = ranges[k], bearings[k]
        angle = b - by.bearing_offset
        if by.has_lens:
            angle = angle - b * (linear + b * (square + b * cubic))
        turns = np.floor((np.pi - angle) / (2.0 * np.pi))
        turned[k] = angle + 2.0 * np.pi * turns
        distance = (r - by.range_offset) / by.range_scale
        if by.range_is_depth:
            cosine = elementary.cos(b - by.optical_axis)
            distance = distance / cosine if cosine > OFF_AXIS else np.nan
        distances[k] = distance
        off_axis = abs(np.remainder(b + np.pi, 2.0 * np.pi) - np.pi)
        within = least <= r <= most and off_axis <= by.half_field
        mask[k] = within and distance > 0.0
    return mask, distances, turned
