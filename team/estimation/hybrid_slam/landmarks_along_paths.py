"""The landmarks of a window solved again: by Gauss-Newton, given each particle's path."""

import math

import numpy as np
from jaxtyping import Float, Int64

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped
from team.estimation.hybrid_slam.landmark_kernel import innovation_of
from team.estimation.hybrid_slam.sensitivity_kernel import Noise
from team.estimation.models import NEAREST_M

SOLVED = 1e-6
"""A Gauss-Newton step of squared Mahalanobis length below this changes nothing that matters."""


NO_SENSOR = (0.0, 0.0, 0.0)


@compiled
def _information(rr: float, rb: float, bb: float, noise: Noise) -> tuple[float, float, float]:
    """The inverse of the white part of a measurement's own covariance, as (rr, rb, bb)."""
    rb *= math.sqrt(noise.range_white * noise.bearing_white)
    rr, bb = noise.range_white * rr, noise.bearing_white * bb
    determinant = rr * bb - rb * rb
    return bb / determinant, -rb / determinant, rr / determinant


@compiled
def landmarks_along_paths(
    starts: Float[np.ndarray, "M L 2"],
    start_covariances: Float[np.ndarray, "M L 3"],
    paths: Float[np.ndarray, "K M 3"],
    bounds: Int64[np.ndarray, " L+1"],
    keyframes: Int64[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Float[np.ndarray, "N own"],
    noise: Noise,
) -> tuple[Float[np.ndarray, "M L 2"], Float[np.ndarray, "M L 3"]]:
    """Each landmark of each particle by Gauss-Newton over its measurements, given the particle's
    path.

    Minimises Σ ‖z − h(path, landmark) − b‖² in R⁻¹ plus ‖b‖² in B⁻¹ from the EKF's mean with at
    most three steps, each kept only if the cost falls. R is the white part of the noise, of the
    range predicted at the start; b ~ N(0, B) is the landmark's constant error, B the rest of the
    variances (of the last measurement's range), eliminated by Schur's complement: with D = Σ R⁻¹ +
    B⁻¹ and C = Σ Hᵀ R⁻¹ the covariance is (Σ Hᵀ R⁻¹ H − C D⁻¹ Cᵀ)⁻¹ at the result, (xx, xy, yy).
    A measurement with a covariance of its own (`team.estimation.scans`) has W = R⁻¹ with the term
    between range and bearing; both constant errors are eliminated one after the other.
    Measurements bounds[l] to bounds[l + 1] belong to landmark l. Where no evaluation is finite the
    EKF's mean and covariance stay.
    """
    means, covariances = starts.copy(), start_covariances.copy()
    range_information = np.empty(len(measurements))
    for i in range(means.shape[0]):
        for landmark in range(means.shape[1]):
            x, y = starts[i, landmark]
            least = np.inf
            for iteration in range(4):
                cost, gx, gy, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                rx, ry, bx, by = 0.0, 0.0, 0.0, 0.0
                range_sum, bearing_sum, range_weight, bearing_weight = 0.0, 0.0, 0.0, 0.0
                total, bearing_total, cross = 0.0, noise.bearing_variance, 0.0
                for k in range(bounds[landmark], bounds[landmark + 1]):
                    pose = paths[keyframes[k], i]
                    dx, dy = x - pose[0], y - pose[1]
                    distance = max(math.sqrt(dx * dx + dy * dy), NEAREST_M)
                    ex, ey = dx / distance, dy / distance
                    of_bearing = wrapped(measurements[k, 1] + pose[2] - elementary.atan2(dy, dx))
                    if own.shape[1] and own[k, 3] >= 0.0:
                        of_range, of_bearing, total, between, bearing_total = innovation_of(
                            measurements[k], own[k], NO_SENSOR, distance, of_bearing
                        )
                        wr, w, wb = _information(total, between, bearing_total, noise)
                        along, across = w * of_bearing, w * of_range
                        cost += 2.0 * along * of_range
                        gx += along * ex - across * ey / distance
                        gy += along * ey + across * ex / distance
                        xx -= 2.0 * w * ex * ey / distance
                        xy += w * (ex * ex - ey * ey) / distance
                        yy += 2.0 * w * ex * ey / distance
                        rx, ry = rx - w * ey / distance, ry + w * ex / distance
                        bx, by = bx + w * ex, by + w * ey
                        range_sum, bearing_sum = range_sum + along, bearing_sum + across
                        cross += w
                        range_information[k] = wr
                    else:
                        total = noise.range_variance + noise.range_per_m2 * distance * distance
                        if iteration == 0:
                            range_information[k] = 1.0 / (noise.range_white * total)
                        of_range = measurements[k, 0] - distance
                        wb = 1.0 / (noise.bearing_white * noise.bearing_variance)
                        bearing_total = noise.bearing_variance
                    wr = range_information[k]
                    cost += wr * of_range * of_range + wb * of_bearing * of_bearing
                    wr_r, wb_b = wr * of_range, wb * of_bearing / distance
                    gx += wr_r * ex - wb_b * ey
                    gy += wr_r * ey + wb_b * ex
                    wt = wb / (distance * distance)
                    xx += wr * ex * ex + wt * ey * ey
                    xy += (wr - wt) * ex * ey
                    yy += wr * ey * ey + wt * ex * ex
                    rx, ry = rx + wr * ex, ry + wr * ey
                    bx, by = bx - wb * ey / distance, by + wb * ex / distance
                    range_sum, range_weight = range_sum + wr_r, range_weight + wr
                    bearing_sum, bearing_weight = bearing_sum + wb * of_bearing, bearing_weight + wb
                if noise.range_white < 1.0:
                    share = 1.0 / (range_weight + 1.0 / ((1.0 - noise.range_white) * total))
                    cost -= share * range_sum * range_sum
                    gx, gy = gx - share * range_sum * rx, gy - share * range_sum * ry
                    xx, xy, yy = xx - share * rx * rx, xy - share * rx * ry, yy - share * ry * ry
                    bearing_sum -= share * cross * range_sum
                    bx, by = bx - share * cross * rx, by - share * cross * ry
                    bearing_weight -= share * cross * cross
                if noise.bearing_white < 1.0:
                    constant = (1.0 - noise.bearing_white) * bearing_total
                    share = 1.0 / (bearing_weight + 1.0 / constant)
                    cost -= share * bearing_sum * bearing_sum
                    gx, gy = gx - share * bearing_sum * bx, gy - share * bearing_sum * by
                    xx, xy, yy = xx - share * bx * bx, xy - share * bx * by, yy - share * by * by
                determinant = xx * yy - xy * xy
                if not (cost < least and determinant > 0.0):
                    break
                least = cost
                step_x, step_y = (
                    (yy * gx - xy * gy) / determinant,
                    (xx * gy - xy * gx) / determinant,
                )
                means[i, landmark, 0], means[i, landmark, 1] = x, y
                covariances[i, landmark, 0] = yy / determinant
                covariances[i, landmark, 1] = -xy / determinant
                covariances[i, landmark, 2] = xx / determinant
                if step_x * gx + step_y * gy < SOLVED:
                    break
                x, y = x + step_x, y + step_y
    return means, covariances
