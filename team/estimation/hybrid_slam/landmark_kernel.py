"""One landmark of one particle: its first sight, and its EKF update at a known pose.

A landmark is a mean (x, y) [m] and a covariance (xx, xy, yy) [m²], both written in place. A sensor
is (σ_range², σ_range_per_m², σ_bearing²); the noise of a range is that of the predicted range.
`own` is a row of `team.estimation.scans`: a measurement's own covariance, if it has one.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation import elementary
from team.estimation.compiled import compiled, inlined
from team.estimation.geometry import wrapped
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


@inlined
def innovation_of(
    measurement: Float[np.ndarray, "2"],
    own: Float[np.ndarray, " own"],
    sensor: Triple,
    distance: float,
    of_bearing: float,
) -> tuple[float, float, float, float, float]:
    """Innovation and noise (ν_range, ν_bearing, rr, rb, bb) of a measurement.

    distance: the predicted range d; of_bearing: the bearing's innovation δ. Of a measured point,
    whose noise is Gaussian in the plane, they are the point's: with its error (r cos δ − d, r sin
    δ) along and across the predicted direction and S, its covariance turned there, (e₀, e₁/d) and
    diag(1, 1/d) S diag(1, 1/d). That is a linear map of both, so whatever follows is what it were
    for the point itself.
    """
    if len(own) == 0 or own[3] < 0.0:
        total = sensor[0] + sensor[1] * distance * distance
        return measurement[0] - distance, of_bearing, total, 0.0, sensor[2]
    rr, rb, bb = own[0], own[1], own[2]
    if own[3] == 0.0:
        return measurement[0] - distance, of_bearing, rr, rb, bb
    reach = max(measurement[0], NEAREST_M)
    s, c = elementary.sin_and_cos(of_bearing)
    rb, bb = rb * reach, bb * reach * reach
    along = c * c * rr - 2.0 * c * s * rb + s * s * bb
    both = c * s * (rr - bb) + (c * c - s * s) * rb
    across = s * s * rr + 2.0 * c * s * rb + c * c * bb
    return (
        reach * c - distance,
        reach * s / distance,
        along,
        both / distance,
        across / (distance * distance),
    )


@inlined
def _condition_on_scalar(
    mean: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "3"],
    hx: float,
    hy: float,
    innovation: float,
    variance: float,
) -> tuple[float, float]:
    """A landmark given one scalar measurement of row h = (hx, hy), in place; (innovation²/s, s).

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
    return innovation * innovation / total, total


@inlined
def condition_on_measurement(
    mean: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "3"],
    pose: Triple,
    measurement: Float[np.ndarray, "2"],
    sensor: Triple,
    own: Float[np.ndarray, " own"],
) -> tuple[float, float]:
    """The EKF update of one landmark at a known pose, in place.

    Returns χ² and V with log p(z | pose, landmark) = −½ (χ² + log V).

    The two rows of Hₗ, linearised once, are taken one after the other: the range, then the bearing
    less its regression on the range, since what is left of its error is independent of the range's.
    """
    distance, ex, ey = seen(pose, mean)
    before_x, before_y = mean[0], mean[1]
    of_range, of_bearing, rr, rb, bb = innovation_of(
        measurement,
        own,
        sensor,
        distance,
        wrapped(measurement[1] + pose[2] - elementary.atan2(ey, ex)),
    )
    slope = rb / rr
    chi2_range, s_range = _condition_on_scalar(mean, covariance, ex, ey, of_range, rr)
    hx, hy = -ey / distance - slope * ex, ex / distance - slope * ey
    of_bearing -= slope * of_range
    of_bearing -= hx * (mean[0] - before_x) + hy * (mean[1] - before_y)
    chi2_bearing, s_bearing = _condition_on_scalar(
        mean, covariance, hx, hy, of_bearing, bb - slope * rb
    )
    return chi2_range + chi2_bearing, (2.0 * math.pi * s_range) * (2.0 * math.pi * s_bearing)


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
