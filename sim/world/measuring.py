"""Measure simulated motions, landmarks and teammates, without the filter's formulas."""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.world.config import OutlierKind
from teamslam.sim.world.streams import Detections
from teamslam.team import core
from teamslam.team.config import MotionModel, MotionNoise, Sensor
from teamslam.team.shapes import Float, Int64, UInt32

SHORTEST_MEASUREMENT_M = 0.05  # least measured range [m]

SHORTEST_TIME_S = 1e-9  # least correlation time [s]; shorter means uncorrelated


@dataclass(frozen=True)
class Visible:
    """V true range-bearing pairs, by step, then point."""

    steps: Int64[np.ndarray, " V"]
    points: Int64[np.ndarray, " V"]
    ranges: Float[np.ndarray, " V"]
    bearings: Float[np.ndarray, " V"]


def visible_points(
    poses: Float[np.ndarray, "K 3"],
    points: Float[np.ndarray, "#K P 2"],
    nearest: float,
    farthest: float,
    field_of_view: float,
) -> Visible:
    """Points (P, constant or K × P) with true range in [nearest, farthest] in the field of view."""
    dx = points[..., 0] - poses[:, :1]
    dy = points[..., 1] - poses[:, 1:2]
    ranges = core.hypot(dx, dy)
    steps, seen = np.nonzero((ranges >= nearest) & (ranges <= farthest))
    bearings = on_circle(core.atan2(dy[steps, seen], dx[steps, seen]) - poses[steps, 2])
    inside = np.abs(bearings) <= 0.5 * field_of_view
    steps, seen = steps[inside], seen[inside]
    return Visible(steps, seen, ranges[steps, seen], bearings[inside])


def persistent_errors(
    seen: Visible, sensor: Sensor, step_s: float, normals: Float[np.ndarray, "V 4"]
) -> Float[np.ndarray, "V 2"]:
    """Errors of unit variance, partly correlated over time for each point.

    n = √white w + √(1 − white) g with white w and a first-order Gauss-Markov process g(t + τ) = ρ
    g(t) + √(1 − ρ²) n', ρ = exp(−τ/correlation time). normals: two columns of w, two of n'.
    """
    constant = normals[:, 2:].copy()
    times = np.array([sensor.range_correlation_s, sensor.bearing_correlation_s])
    order = np.lexsort((seen.steps, seen.points))
    repeated = np.flatnonzero(np.diff(seen.points[order]) == 0) + 1
    gaps = np.diff(seen.steps[order])[repeated - 1] * step_s
    correlation = core.exp(-gaps[:, np.newaxis] / np.maximum(times, SHORTEST_TIME_S))
    for row, rho in zip(repeated.tolist(), correlation, strict=True):
        before = constant[order[row - 1]]
        constant[order[row]] = rho * before + np.sqrt(1.0 - rho**2) * constant[order[row]]
    white = np.array([sensor.range_white, sensor.bearing_white])
    both: Float[np.ndarray, "V 2"] = np.sqrt(white) * normals[:, :2]
    both += np.sqrt(1.0 - white) * constant
    return both


LENS_ROUNDS = 20
"""Fixed-point rounds for a raw bearing; each multiplies the error by a lens's few per cent."""


def measurements(
    seen: Visible, sensor: Sensor, errors: Float[np.ndarray, "V 2"]
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Measured ranges [m] and bearings [rad], from errors n of unit variance.

    range = range_scale · (r + σ(r) n₁) + range_offset, σ(r)² = range_sigma² + (range_sigma_per_m
    r)²; bearing = raw + bearing_sigma n₂, raw = b + bearing_offset + lens(raw). With range_is_depth
    r + σ(r) n₁ is projected on the optical axis.
    """
    raw = seen.bearings + sensor.bearing_offset
    lens = sensor.bearing_lens
    if not lens.is_ideal:
        straight = raw
        for _ in range(LENS_ROUNDS):
            raw = straight + raw * (lens.linear + raw * (lens.square + raw * lens.cubic))
    sigma = core.hypot(sensor.range_sigma, sensor.range_sigma_per_m * seen.ranges)
    distances = seen.ranges + sigma * errors[:, 0]
    if sensor.range_is_depth:
        distances = distances * core.cos(raw - sensor.optical_axis)
    ranges = sensor.range_scale * distances + sensor.range_offset
    bearings = raw + sensor.bearing_sigma * errors[:, 1]
    return np.maximum(ranges, SHORTEST_MEASUREMENT_M), on_circle(bearings)


def on_circle(angles: Float[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
    """Wrap angles to (−π, π]."""
    turned = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return np.where(turned == -np.pi, np.pi, turned)


def add_outliers(
    seen: Detections,
    share: float,
    kind: OutlierKind,
    span: tuple[float, float],
    field_of_view: float,
    landmarks: int,
    uniforms: Float[np.ndarray, "R 3"],
) -> Detections:
    """Replace a share of the measurements by outliers, from uniform numbers in [0, 1).

    The first number selects the row. "measurement": the others are a range in `span` [m] and a
    bearing. "identity": the second selects another landmark. "drop": omitted.
    """
    chosen = uniforms[:, 0] < share
    if kind == "drop":
        return seen.where(~chosen)
    if kind == "identity":
        others = _others(seen.ids, landmarks, uniforms[:, 1])
        return replace(seen, ids=np.where(chosen, others, seen.ids))
    nearest, farthest = span
    ranges = nearest + (farthest - nearest) * uniforms[:, 1]
    bearings = field_of_view * (0.5 - uniforms[:, 2])
    return replace(
        seen,
        ranges=np.where(chosen, ranges, seen.ranges),
        bearings=np.where(chosen, bearings, seen.bearings),
    )


def _others(
    ids: UInt32[np.ndarray, " R"], landmarks: int, uniform: Float[np.ndarray, " R"]
) -> UInt32[np.ndarray, " R"]:
    ahead = 1 + np.floor(uniform * max(landmarks - 1, 1)).astype(np.int64)
    others: UInt32[np.ndarray, " R"] = (ids - 1 + ahead) % landmarks + 1
    return others.astype(np.uint32)


Column = Float[np.ndarray, " K"]


def _deviation(noise: MotionNoise, seconds: Column, steps: Float[np.ndarray, "K 2"]) -> Column:
    """σ = √(per_s² t + per_m² |distance| + per_rad² |rotation|) of each step."""
    distance, turn = np.abs(steps).T
    per_s, per_m, per_rad = noise.per_s, noise.per_m, noise.per_rad
    variance = per_s**2 * seconds + per_m**2 * distance + per_rad**2 * turn
    sigma: Column = np.sqrt(variance)
    return sigma


def measured_speeds(
    motion: MotionModel,
    steps: Float[np.ndarray, "K 2"],
    seconds: Column,
    normals: Float[np.ndarray, "K 2"],
    wheel_normals: Float[np.ndarray, "K 2"],
) -> tuple[Column, Column]:
    """Measured forward speed [m/s] and yaw rate [rad/s].

    Forward and turn noise are added to translation d and rotation φ, wheel noise to each wheel's
    path; ω and v follow from φ = ω t + veer·d and |d| = (|v| − turn_drag·|ω|)·t, divided by the
    scales.
    """
    of_way, of_turn, _ = _interval_deviations(motion, steps, seconds)
    forward = core.hypot(_deviation(motion.forward, seconds, steps), of_way)
    turn = core.hypot(_deviation(motion.turn, seconds, steps), of_turn)
    if motion.shares is not None:
        along, _, heading = _of_the_way(motion, steps, seconds)
        forward, turn = core.hypot(forward, along), core.hypot(turn, heading)
    way = steps[:, 0] + forward * normals[:, 0]
    turned = steps[:, 1] + turn * normals[:, 1]
    if motion.wheel_base is not None:
        left, right = _wheel_errors(motion, motion.wheel_base, steps, wheel_normals)
        way = way + 0.5 * (right + left)
        turned = turned + (right - left) / motion.wheel_base
    yaw_rate = (turned - motion.veer * way) / seconds
    speed = way / seconds
    speed = speed + np.copysign(motion.turn_drag * np.abs(yaw_rate), speed)
    return speed / motion.forward_scale, yaw_rate / motion.yaw_scale


def slip(
    motion: MotionModel, step: tuple[float, float], seconds: float, normals: Float[np.ndarray, "2"]
) -> tuple[float, float]:
    """Final rotation [rad] and left slip [m], which odometry does not measure."""
    steps, duration = np.array([step]), np.array([seconds])
    _, _, of_turn = _interval_deviations(motion, steps, duration)
    turn = core.hypot(_deviation(motion.final_turn, duration, steps), of_turn) * normals[0]
    left = _deviation(motion.lateral, duration, steps) * normals[1]
    if motion.shares is not None:
        sigma = core.hypot(
            _deviation(motion.lateral, duration, steps), _of_the_way(motion, steps, duration)[1]
        )
        left = sigma * normals[1]
    return turn.item(), left.item()


def _interval_deviations(
    motion: MotionModel, steps: Float[np.ndarray, "K 2"], seconds: Column
) -> tuple[Column, Column, Column]:
    """σ of translation, rotation and final rotation by Ma & Ma's α.

    Errors of v, ω, γ are constant over an interval T: a step of t has t/T of them, so var = (α₁v² +
    α₂ω²) T² t/T.
    """
    if motion.alphas is None:
        return (np.zeros(len(steps)),) * 3
    v, w = steps.T / seconds
    intervals = seconds / motion.alpha_interval_s
    first, second, third = (
        motion.alpha_interval_s * np.sqrt((a * v**2 + b * w**2) * intervals)
        for a, b in zip(motion.alphas[::2], motion.alphas[1::2], strict=True)
    )
    return first, second, third


def _of_the_way(
    motion: MotionModel, steps: Float[np.ndarray, "K 2"], seconds: Column
) -> tuple[Column, Column, Column]:
    """σ of forward, lateral and heading errors, constant over T: σ² = (share · path in T)² t/T."""
    assert motion.shares is not None
    in_interval = np.abs(steps[:, 0]) / seconds * motion.shares_interval_s
    count = np.sqrt(seconds / motion.shares_interval_s)
    first, second, third = (share * in_interval * count for share in motion.shares)
    return first, second, third


def _wheel_errors(
    motion: MotionModel,
    base: float,
    steps: Float[np.ndarray, "K 2"],
    normals: Float[np.ndarray, "K 2"],
) -> tuple[Column, Column]:
    """Errors [m] of the left and right wheel's path: σ = noise √|path|."""
    distance, turn = steps.T
    left, right = distance - 0.5 * base * turn, distance + 0.5 * base * turn
    return (
        motion.left_wheel * np.sqrt(np.abs(left)) * normals[:, 0],
        motion.right_wheel * np.sqrt(np.abs(right)) * normals[:, 1],
    )


Rows = Float[np.ndarray, "K 3"]

LARGEST_CORRELATION = 0.8  # largest absolute range-bearing correlation of a carried covariance


def seen_from(poses: Rows, mount: tuple[float, float, float]) -> Rows:
    """Sensor poses for base poses and a mount."""
    x, y, heading = mount
    c, s = core.cos(poses[:, 2]), core.sin(poses[:, 2])
    return np.column_stack([
        poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y, poses[:, 2] + heading
    ])  # fmt: skip


def _turn(xy: Float[np.ndarray, "K 2"], angle: Column) -> Float[np.ndarray, "K 2"]:
    c, s = core.cos(angle), core.sin(angle)
    return np.column_stack([c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]])


def measured_increments(
    motion: MotionModel,
    poses: Float[np.ndarray, "K_plus_1 3"],
    steps: Float[np.ndarray, "K 2"],
    seconds: Column,
    normals: Rows,
    correlation: float,
) -> tuple[Rows, Float[np.ndarray, "K 3 3"]]:
    """Measure motions between true poses, with error covariances:

        true motion = measured motion ∘ Exp(f, l, φ)

    in the frame of the measured end, with the deviations of the model's forward, lateral and turn;
    l and φ are correlated.
    """
    before, after = poses[:-1], poses[1:]
    true_turn = after[:, 2] - before[:, 2]
    displacement = _turn(after[:, :2] - before[:, :2], -before[:, 2])
    kinds = (motion.forward, motion.lateral, motion.turn)
    sigmas = np.column_stack([_deviation(kind, seconds, steps) for kind in kinds])
    shares = np.sqrt(1.0 - correlation**2)
    ahead, left, turn = sigmas.T * normals.T
    left = correlation * sigmas[:, 1] * normals[:, 2] + shares * left
    half = 0.5 * turn
    chord = np.divide(core.sin(half), half, out=np.ones_like(half), where=half != 0.0)
    moved = chord[:, np.newaxis] * _turn(np.column_stack([ahead, left]), 0.5 * turn)
    measured_turn = true_turn - turn
    measured = displacement - _turn(moved, measured_turn)
    angle = np.mod(measured_turn + np.pi, 2.0 * np.pi) - np.pi
    C = np.zeros((len(turn), 3, 3))
    C[:, range(3), range(3)] = sigmas**2
    C[:, 1, 2] = C[:, 2, 1] = correlation * sigmas[:, 1] * sigmas[:, 2]
    return np.column_stack([measured, angle]), C


def measured_steering(
    motion: MotionModel, forward: Column, yaw_rate: Column
) -> tuple[Column, Column]:
    """Wheel speed [m/s] and steering angle [rad] of a car, which turns about a point
    forward/yaw_rate to the left of its rear axle.
    """
    assert motion.wheel_base is not None
    moving = np.abs(forward) > 1e-9
    curvature = np.where(moving, yaw_rate / np.where(moving, forward, 1.0), 0.0)
    wheel = forward * (1.0 - curvature * motion.wheel_offset)
    return wheel, np.arctan(curvature * motion.wheel_base) - motion.steering_offset


def draw_covariances(
    seen: Visible,
    sensor: Sensor,
    sizes: tuple[float, float],
    uniform: Float[np.ndarray, "V 3"],
    *,
    points: bool,
) -> Float[np.ndarray, "V 3"]:
    """Draw covariances of individual size and direction.

    Standard deviations are the sensor's times factors between `sizes`: of range and bearing with
    random correlation; of points, range_sigma along two random orthogonal axes.
    """
    low, high = sizes
    first, second = (low + (high - low) * uniform[:, :2]).T
    if points:
        angle = np.pi * uniform[:, 2]
        a, b = (sensor.range_sigma * first) ** 2, (sensor.range_sigma * second) ** 2
        c, s = core.cos(angle), core.sin(angle)
        return np.column_stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c])
    a, b = sensor.range_sigma * first, sensor.bearing_sigma * second
    rho = LARGEST_CORRELATION * (2.0 * uniform[:, 2] - 1.0)
    return np.column_stack([a * a, rho * a * b, b * b])


def with_errors(
    true: Float[np.ndarray, "V 2"],
    covariances: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 2"],
) -> Float[np.ndarray, "V 2"]:
    """Add errors of these covariances."""
    xx, xy, yy = covariances.T
    first = np.sqrt(xx)
    across = xy / first
    second = across * normals[:, 0] + np.sqrt(yy - across**2) * normals[:, 1]
    found: Float[np.ndarray, "V 2"] = true + np.column_stack([first * normals[:, 0], second])
    return found
