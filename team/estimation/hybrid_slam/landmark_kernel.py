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
from team.estimation.geometry import Point, Pose, wrapped
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


@compiled
def predicted(pose: Pose, landmark: Point) -> tuple[float, float]:
    """Predict range [m] and bearing [rad] of a point landmark from a pose, both in the map frame.

    range = max(‖landmark − (x, y)‖, NEAREST_M), bearing = atan2(Δy, Δx) − theta in (−π, π].
    """
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    distance = max(math.sqrt(dx * dx + dy * dy), NEAREST_M)
    return distance, wrapped(elementary.atan2(dy, dx) - pose[2])


@compiled
def pose_jacobian(distance: float, bearing: float) -> Float[np.ndarray, "2 3"]:
    """Compute ∂z/∂xi of h(pose ∘ Exp(xi), landmark) at xi = 0, from the predicted (range,
    bearing).
    """
    s, c = elementary.sin_and_cos(bearing)
    return np.array([[-c, -s, 0.0], [s / distance, -c / distance, -1.0]])


@compiled
def landmark_jacobian(distance: float, direction: float) -> Float[np.ndarray, "2 2"]:
    """Compute ∂z/∂landmark, from the predicted range and the direction = theta + bearing in the
    map.
    """
    s, c = elementary.sin_and_cos(direction)
    return np.array([[c, s], [-s / distance, c / distance]])
