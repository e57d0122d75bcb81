"""One landmark of one particle: its first sight, and its EKF update at a known pose.

A landmark is a mean (x, y) [m] and a covariance (xx, xy, yy) [m²], both written in place. A sensor
is (σ_range², σ_range_per_m², σ_bearing²); the noise of a range is that of the predicted range.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped
from team.estimation.models import NEAREST_M

Triple = tuple[float, float, float]


@compiled
def seen(pose: Triple, mean: Float[np.ndarray, "2"]) -> Triple:
    """Distance and the unit vector (ex, ey) from the pose to the landmark."""
    dx, dy = mean[0] - pose[0], mean[1] - pose[1]
    distance = math.sqrt(dx * dx + dy * dy)
    if distance < NEAREST_M:
        return NEAREST_M, math.cos(pose[2]), math.sin(pose[2])
    return distance, dx / distance, dy / distance


@compiled
def _condition_on_scalar(
    mean: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "3"],
    hx: float,
    hy: float,
    innovation: float,
    variance: float,
) -> float:
    """A landmark given one scalar measurement of row h = (hx, hy), in place; log N(innovation; 0,
    s).

    For 2 × 2, Σ − Σhhᵀ Σ/s = (R Σ + |Σ| h⊥h⊥ᵀ)/s with s = hᵀΣh + R: a sum of positive terms, so
    the covariance stays positive definite.
    """
    xx, xy, yy = covariance[0], covariance[1], covariance[2]
    wx, wy = xx * hx + xy * hy, xy * hx + yy * hy
    total: float = hx * wx + hy * wy + variance
    shrunk, across = variance / total, (xx * yy - xy * xy) / total
    mean[0] += wx / total * innovation
    mean[1] += wy / total * innovation
    covariance[0] = shrunk * xx + across * hy * hy
    covariance[1] = shrunk * xy - across * hx * hy
    covariance[2] = shrunk * yy + across * hx * hx
    return -0.5 * (innovation * innovation / total + math.log(2.0 * math.pi * total))


@compiled
def condition_on_measurement(
    mean: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "3"],
    pose: Triple,
    measurement: Float[np.ndarray, "2"],
    sensor: Triple,
) -> float:
    """The EKF update of one landmark at a known pose, in place; log p(z | pose, landmark).

    R is diagonal, so the two rows of Hₗ, linearised once, are taken one after the other.
    """
    distance, ex, ey = seen(pose, mean)
    before_x, before_y = mean[0], mean[1]
    of_range = measurement[0] - distance
    of_bearing = wrapped(measurement[1] + pose[2] - math.atan2(ey, ex))
    log_likelihood = _condition_on_scalar(
        mean, covariance, ex, ey, of_range, sensor[0] + sensor[1] * distance * distance
    )
    hx, hy = -ey / distance, ex / distance
    of_bearing -= hx * (mean[0] - before_x) + hy * (mean[1] - before_y)
    return log_likelihood + _condition_on_scalar(mean, covariance, hx, hy, of_bearing, sensor[2])


@compiled
def place(
    mean: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "3"],
    pose: Triple,
    measurement: Float[np.ndarray, "2"],
    sensor: Triple,
) -> None:
    """A landmark at first sight, in place: the inverse model g and Σ = G R Gᵀ, G = ∂g/∂z."""
    distance, direction = max(measurement[0], NEAREST_M), pose[2] + measurement[1]
    ex, ey = math.cos(direction), math.sin(direction)
    along = sensor[0] + sensor[1] * distance * distance
    across = sensor[2] * distance * distance
    mean[0], mean[1] = pose[0] + distance * ex, pose[1] + distance * ey
    covariance[0] = along * ex * ex + across * ey * ey
    covariance[1] = (along - across) * ex * ey
    covariance[2] = along * ey * ey + across * ex * ex
