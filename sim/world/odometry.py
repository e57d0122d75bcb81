"""Simulated odometry of a true step (distance [m], rotation [rad]), and its unmeasured slip.

Odometry is the true step with the robot's motion noise, converted back through its calibration. The
formulas follow the sources, not the filter.
"""

import numpy as np

from teamslam.team import core
from teamslam.team.config import MotionModel, MotionNoise
from teamslam.team.shapes import Float

Column = Float[np.ndarray, " K"]


def deviation(noise: MotionNoise, seconds: Column, steps: Float[np.ndarray, "K 2"]) -> Column:
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
    """Measured forward speed [m/s] and yaw rate [rad/s] of the true steps.

    Forward and turn noise are added to translation d and rotation φ; wheel noise to each wheel's
    path, from which d and φ are recomputed. The noisy d and φ give ω and v by φ = ω t + veer·d and
    |d| = (|v| − turn_drag·|ω|)·t; they are divided by the scales.
    """
    of_way, of_turn, _ = _interval_deviations(motion, steps, seconds)
    forward = core.hypot(deviation(motion.forward, seconds, steps), of_way)
    turn = core.hypot(deviation(motion.turn, seconds, steps), of_turn)
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
    """Final rotation [rad] and left slip [m] of a step, which odometry does not measure."""
    steps, duration = np.array([step]), np.array([seconds])
    _, _, of_turn = _interval_deviations(motion, steps, duration)
    turn = core.hypot(deviation(motion.final_turn, duration, steps), of_turn) * normals[0]
    left = deviation(motion.lateral, duration, steps) * normals[1]
    if motion.shares is not None:
        sigma = core.hypot(
            deviation(motion.lateral, duration, steps), _of_the_way(motion, steps, duration)[1]
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
