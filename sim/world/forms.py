"""Odometry and further forms of simulated measurements, without the filter's formulas."""

import numpy as np

from teamslam.sim.world.sensing import Visible
from teamslam.team import core
from teamslam.team.config import MotionModel, MotionNoise, Sensor
from teamslam.team.shapes import Float

Column = Float[np.ndarray, " K"]


def _deviation(noise: MotionNoise, seconds: Column, steps: Float[np.ndarray, "K 2"]) -> Column:
    """σ = √(per_s² t + per_m² |distance| + per_rad² |rotation|) of one noise in each step."""
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

    Forward and turn noise are added to translation d and rotation φ; wheel noise to each wheel's
    path. The noisy d and φ give ω and v by φ = ω t + veer·d and |d| = (|v| − turn_drag·|ω|)·t; they
    are divided by the scales.
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

    Errors of v, ω, γ are constant over an interval T, in which the translation errs by ε T with var
    ε = α₁v² + α₂ω². A step of t has t/T such intervals: var = (α₁v² + α₂ω²) T² t/T.
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
    """σ of forward, lateral and heading errors proportional to the path, constant over a time T.

    A step of t has t/T such intervals: σ² = (share · path in T)² t/T.
    """
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
    """Errors [m] of the left and right wheel's path: σ = noise √|path| of each wheel."""
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

    with a constant twist in the frame of the measured end; f, l and φ have the deviations of the
    model's forward, lateral and turn; l and φ are correlated.
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
    """Wheel speed [m/s] and steering angle [rad] of a car.

    The base turns about a point forward/yaw_rate to its left, on the line of the rear axle.
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
