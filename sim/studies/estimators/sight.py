"""Distance and direction of landmarks, elementwise."""

import numpy as np

from teamslam.team import core
from teamslam.team.estimation.models import NEAREST_M
from teamslam.team.shapes import Float

Array = Float[np.ndarray, "..."]


def see(poses: Array, landmarks: Array) -> tuple[Array, Array, Array]:
    """Distance d ≥ NEAREST_M and unit vector (ex, ey) from each pose to its landmark."""
    dx, dy = landmarks[..., 0] - poses[..., 0], landmarks[..., 1] - poses[..., 1]
    distance = np.sqrt(dx * dx + dy * dy)
    near = distance < NEAREST_M
    if not near.any():
        return distance, dx / distance, dy / distance
    s, c = core.sin_and_cos(np.broadcast_to(poses[..., 2], near.shape))
    distance = np.where(near, 1.0, distance)
    ex, ey = np.where(near, c, dx / distance), np.where(near, s, dy / distance)
    return np.where(near, NEAREST_M, distance), ex, ey
