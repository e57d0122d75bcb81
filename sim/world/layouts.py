"""Ambiguous landmark layouts: twins, and rooms with one pattern."""

import numpy as np

from teamslam.sim.world.config import SimulatedWorld
from teamslam.team import core
from teamslam.team.shapes import Float

INNER = 0.1
"""Least wall distance of a landmark, as a share of a room's side."""


def laid_out(world: SimulatedWorld, rng: np.random.Generator) -> Float[np.ndarray, "L 2"]:
    """Draw landmark_count points of the square, rounded down to equal rooms."""
    if world.layout == "twins":
        return _twins(world, rng)
    side = world.size_m / world.rooms
    each = max(world.landmark_count // world.rooms**2, 1)
    pattern = side * rng.uniform(INNER, 1.0 - INNER, (each, 2))
    corners = side * np.stack(np.divmod(np.arange(world.rooms**2), world.rooms), axis=1)
    return np.asarray((corners[:, None] + pattern[None]).reshape(-1, 2))


def _twins(world: SimulatedWorld, rng: np.random.Generator) -> Float[np.ndarray, "L 2"]:
    count = world.landmark_count
    first = rng.uniform(0.0, world.size_m, ((count + 1) // 2, 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(first))
    second = first + world.twin_m * np.column_stack((core.cos(angle), core.sin(angle)))
    return np.asarray(np.concatenate((first, second))[:count])
