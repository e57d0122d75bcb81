"""One landmark seen from one pose: distance and direction, innovation, first sight.

A landmark is a mean (x, y) [m] and a covariance (xx, xy, yy) [m²], both written in place. A sensor
is (σ_range², σ_range_per_m², σ_bearing²); the noise of a range is that of the predicted range.
`own` is a row of `team.estimation.scans`: a measurement's own covariance, if it has one.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation import elementary
from team.estimation.compiled import compiled, inlined
from team.estimation.models import NEAREST_M

Triple = tuple[float, float, float]


@inlined
def seen(pose: Triple, mean: Float[np.ndarray, "2"]) -> Triple:
    """Distance and the unit vector (ex, ey) from the pose to the landmark."""
    dx, dy = mean[0] - pose[0], mean[1] - pose[1]
    distance = math.sqrt(dx * dx + dy * dy)
    if distance < NEAREST_M:
        return NEAREST_M, elementary.cos(pose[2]), elementary.sin(pose[2])
    return distance, dx / distance, dy / distance


@compiled
def place(
    mean: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "3"],
    pose: Triple,
    measurement: Float[np.ndarray, "2"],
    sensor: Triple,
    own: Float[np.ndarray, " own"],
) -> None:
    """A landmark at first sight, in place: the inverse model g and Σ = G R Gᵀ, G = ∂g/∂z."""
    distance, direction = max(measurement[0], NEAREST_M), pose[2] + measurement[1]
    ey, ex = elementary.sin_and_cos(direction)
    along, both = sensor[0] + sensor[1] * distance * distance, 0.0
    across = sensor[2] * distance * distance
    if len(own) and own[3] >= 0.0:
        along, both, across = own[0], own[1] * distance, own[2] * distance * distance
    mean[0], mean[1] = pose[0] + distance * ex, pose[1] + distance * ey
    covariance[0] = along * ex * ex + across * ey * ey - 2.0 * both * ex * ey
    covariance[1] = (along - across) * ex * ey + both * (ex * ex - ey * ey)
    covariance[2] = along * ey * ey + across * ex * ex + 2.0 * both * ex * ey
