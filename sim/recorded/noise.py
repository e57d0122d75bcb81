"""Scale the noise that robots assume for their odometry or sensor."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import cast

import msgspec

from teamslam.team.config import Alphas, MotionModel, MotionNoise, RobotConfig, Sensor

KINDS: Mapping[str, str] = MappingProxyType(
    {
        "odometry": "every noise of motion",
        "range": "the range's standard deviation",
        "bearing": "the bearing's standard deviation",
    }
)
"""Kinds of noise, and the scaled parameters."""


def with_noise(robot: RobotConfig, factors: Mapping[str, float]) -> RobotConfig:
    """Scale the robot's standard deviations by the factor of their kind (see KINDS)."""
    motion = _motion(robot.motion, factors.get("odometry", 1.0))
    by_range = factors.get("range", 1.0)
    sensor: Sensor = msgspec.structs.replace(
        robot.sensor,
        range_sigma=robot.sensor.range_sigma * by_range,
        range_sigma_per_m=robot.sensor.range_sigma_per_m * by_range,
        bearing_sigma=robot.sensor.bearing_sigma * factors.get("bearing", 1.0),
    )
    return msgspec.structs.replace(robot, motion=motion, sensor=sensor)


def _motion(motion: MotionModel, factor: float) -> MotionModel:
    """Scale the motion noise: the α are variances, all else is a standard deviation."""

    def scaled(noise: MotionNoise) -> MotionNoise:
        return MotionNoise(noise.per_s * factor, noise.per_m * factor, noise.per_rad * factor)

    alphas = motion.alphas
    if alphas is not None:
        alphas = cast("Alphas", tuple(alpha * factor * factor for alpha in alphas))
    return msgspec.structs.replace(
        motion,
        forward=scaled(motion.forward),
        turn=scaled(motion.turn),
        final_turn=scaled(motion.final_turn),
        lateral=scaled(motion.lateral),
        alphas=alphas,
        left_wheel=motion.left_wheel * factor,
        right_wheel=motion.right_wheel * factor,
    )
