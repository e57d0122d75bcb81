"""What a range-bearing sensor of the simulated world hands out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from team.config import Sensor

SHORTEST_READING_M = 0.05
"""A reading that the noise would make shorter is given as this: a sensor has no negative range."""


@dataclass(frozen=True)
class Visible:
    """V true range-bearing pairs, by step and then by point."""

    steps: Int64[np.ndarray, " V"]
    points: Int64[np.ndarray, " V"]
    ranges: Float[np.ndarray, " V"]
    bearings: Float[np.ndarray, " V"]


def visible(
    poses: Float[np.ndarray, "K 3"],
    points: Float[np.ndarray, "#K P 2"],
    nearest: float,
    farthest: float,
    field_of_view: float,
) -> Visible:
    """The points with a true range in [nearest, farthest] and a true bearing in the field of view.

    points: P positions, the same in all steps or K × P.
    """
    dx = points[..., 0] - poses[:, :1]
    dy = points[..., 1] - poses[:, 1:2]
    ranges = np.hypot(dx, dy)
    steps, seen = np.nonzero((ranges >= nearest) & (ranges <= farthest))
    bearings = on_circle(np.arctan2(dy[steps, seen], dx[steps, seen]) - poses[steps, 2])
    inside = np.abs(bearings) <= 0.5 * field_of_view
    steps, seen = steps[inside], seen[inside]
    return Visible(steps, seen, ranges[steps, seen], bearings[inside])


def readings(
    seen: Visible, sensor: Sensor, normals: Float[np.ndarray, "V 2"]
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Ranges [m] and bearings [rad] as the sensor reads them, from standard normal numbers.

    range = range_scale · (r + σ(r) n₁) + range_offset with σ(r)² = range_sigma² +
    (range_sigma_per_m r)²; bearing = b + bearing_sigma n₂ + bearing_offset.
    """
    sigma = np.hypot(sensor.range_sigma, sensor.range_sigma_per_m * seen.ranges)
    ranges = sensor.range_scale * (seen.ranges + sigma * normals[:, 0]) + sensor.range_offset
    bearings = seen.bearings + sensor.bearing_sigma * normals[:, 1] + sensor.bearing_offset
    return np.maximum(ranges, SHORTEST_READING_M), on_circle(bearings)


def on_circle(angles: Float[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
    """The angles in (−π, π]."""
    turned = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return np.where(turned == -np.pi, np.pi, turned)
