"""Sixteen particles side by side: what each predicts of a landmark, and its update.

A row of a block holds one quantity of sixteen particles, its lanes; what is done to rows is a loop
over the lanes without a branch, which the compiler turns into vector instructions. A block is one
flat array and its rows begin at constants, so the compiler sees that they do not overlap. No lane
knows another, so neither the width of a register nor a particle's place changes a bit. Lanes behind
the last particle repeat it.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation import elementary
from team.estimation.compiled import compiled, inlined
from team.estimation.geometry import wrapped
from team.estimation.hybrid_slam.landmark_kernel import Triple
from team.estimation.models import NEAREST_M

LANES = 16
LOG_2_PI = 1.8378770664093453
Block = Float[np.ndarray, " rows_lanes"]
Measured = Float[np.ndarray, "n 11"]

(
    # A pose, its heading as an angle and by sine and cosine.
    X, Y, HEADING, SINE, COSINE,
    # A landmark's mean and covariance.
    MEAN_X, MEAN_Y, XX, XY, YY,
    # Of a landmark seen from a pose: the distance, its direction in the map, its direction in the
    # robot, sine and cosine of the bearing's innovation, both innovations and their noise.
    DISTANCE, EX, EY, U, V, SINE_OFF, COSINE_OFF, OF_RANGE, OF_BEARING, RR, RB, BB,
    # What a step adds to the logarithm of the weight.
    LOG_WEIGHT,
    # Rows of a kernel's own.
    OWN,
) = range(0, 24 * LANES, LANES)  # fmt: skip

(
    READ,
    SINE_READ,
    COSINE_READ,
    ALONG,
    BOTH,
    ACROSS,
    RR_NEAR,
    RR_PER_M2,
    RB_READ,
    BB_READ,
    IS_POINT,
) = range(11)
"""A row of `measured`: the range, sine and cosine of the bearing; the covariance along and across
the bearing [m²]; the noise of a range r, RR_NEAR + RR_PER_M2 r², and that of the bearing.
"""


@compiled
def measured(
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    sensor: Triple,
    own: Float[np.ndarray, "n own"],
) -> Measured:
    """What is the same for all particles: a row for each (range, bearing), READ to IS_POINT.

    own: rows of `team.estimation.scans`; sensor: (σ_range², σ_range_per_m², σ_bearing²).
    """
    rows = np.zeros((len(ranges), 11))
    for k in range(len(ranges)):
        row, reach = rows[k], max(ranges[k], NEAREST_M)
        row[READ] = ranges[k]
        row[SINE_READ], row[COSINE_READ] = elementary.sin_and_cos(bearings[k])
        if own.shape[1] == 0 or own[k, 3] < 0.0:
            row[RR_NEAR], row[RR_PER_M2], row[BB_READ] = sensor
            row[ALONG] = sensor[0] + sensor[1] * reach * reach
        else:
            row[RR_NEAR], row[RB_READ], row[BB_READ] = own[k, 0], own[k, 1], own[k, 2]
            row[ALONG], row[IS_POINT] = own[k, 0], own[k, 3]
        row[BOTH], row[ACROSS] = row[RB_READ] * reach, row[BB_READ] * reach * reach
    return rows


@compiled
def load_poses(block: Block, poses: Float[np.ndarray, "M 3"], begin: int) -> None:
    """The particles from `begin` on."""
    last = len(poses) - 1
    for j in range(LANES):
        i = min(begin + j, last)
        block[X + j], block[Y + j], block[HEADING + j] = poses[i, 0], poses[i, 1], poses[i, 2]


@compiled
def load_landmark(
    block: Block,
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    slot: int,
    begin: int,
) -> None:
    """One landmark of the particles from `begin` on."""
    last = len(means) - 1
    for j in range(LANES):
        i = min(begin + j, last)
        block[MEAN_X + j], block[MEAN_Y + j] = means[i, slot, 0], means[i, slot, 1]
        block[XX + j], block[XY + j] = covariances[i, slot, 0], covariances[i, slot, 1]
        block[YY + j] = covariances[i, slot, 2]


@compiled
def drive(block: Block, motion: Float[np.ndarray, "3"]) -> None:
    """The poses after (forward, left, turn), given in them."""
    forward, left, turn = motion[0], motion[1], motion[2]
    of_turn, by_turn = elementary.sin_and_cos(turn)
    for j in range(LANES):
        s, c = elementary.sin_and_cos_near(block[HEADING + j])
        block[X + j] += c * forward - s * left
        block[Y + j] += s * forward + c * left
        block[HEADING + j] = wrapped(block[HEADING + j] + turn)
        block[SINE + j], block[COSINE + j] = s * by_turn + c * of_turn, c * by_turn - s * of_turn


@compiled
def predict(block: Block, row: Float[np.ndarray, "11"]) -> None:
    """The rows DISTANCE to BB of a measurement (a row of `measured`) of the landmark.

    The bearing's innovation is the angle between the direction that was read and the one that is
    predicted, by their vector and scalar products. Of a measured point, whose noise is Gaussian in
    the plane, all are the point's (`landmark_kernel.innovation_of`).
    """
    read, sine, cosine = row[READ], row[SINE_READ], row[COSINE_READ]
    rr, rr_per_m2, rb, bb = row[RR_NEAR], row[RR_PER_M2], row[RB_READ], row[BB_READ]
    for j in range(LANES):
        s, c = block[SINE + j], block[COSINE + j]
        dx, dy = block[MEAN_X + j] - block[X + j], block[MEAN_Y + j] - block[Y + j]
        apart = math.sqrt(dx * dx + dy * dy)
        here = apart < NEAREST_M
        distance = NEAREST_M if here else apart
        per = 1.0 / distance
        ex, ey = c if here else dx * per, s if here else dy * per
        u, v = c * ex + s * ey, c * ey - s * ex
        block[DISTANCE + j], block[EX + j], block[EY + j] = distance, ex, ey
        block[U + j], block[V + j] = u, v
        off, on = sine * u - cosine * v, cosine * u + sine * v
        block[SINE_OFF + j], block[COSINE_OFF + j] = off, on
        block[OF_RANGE + j] = read - distance
        block[OF_BEARING + j] = math.copysign(elementary.direction_near(abs(off), on), off)
        block[RR + j], block[RB + j], block[BB + j] = rr + rr_per_m2 * distance * distance, rb, bb
    if row[IS_POINT] > 0.0:
        _predict_point(block, row)


@compiled
def _predict_point(block: Block, row: Float[np.ndarray, "11"]) -> None:
    """The innovations and noise of a point: its error along and across the predicted direction."""
    reach = max(row[READ], NEAREST_M)
    rr, rb, bb = row[ALONG], row[BOTH], row[ACROSS]
    for j in range(LANES):
        s, c, distance = block[SINE_OFF + j], block[COSINE_OFF + j], block[DISTANCE + j]
        along = c * c * rr - 2.0 * c * s * rb + s * s * bb
        both = c * s * (rr - bb) + (c * c - s * s) * rb
        across = s * s * rr + 2.0 * c * s * rb + c * c * bb
        block[OF_RANGE + j], block[OF_BEARING + j] = reach * c - distance, reach * s / distance
        block[RR + j], block[RB + j] = along, both / distance
        block[BB + j] = across / (distance * distance)


@compiled
def place(block: Block, row: Float[np.ndarray, "11"]) -> None:
    """A landmark at first sight: the inverse model g and Σ = G R Gᵀ, G = ∂g/∂z."""
    distance, sine, cosine = max(row[READ], NEAREST_M), row[SINE_READ], row[COSINE_READ]
    along, both, across = row[ALONG], row[BOTH], row[ACROSS]
    for j in range(LANES):
        s, c = block[SINE + j], block[COSINE + j]
        ex, ey = c * cosine - s * sine, s * cosine + c * sine
        block[MEAN_X + j] = block[X + j] + distance * ex
        block[MEAN_Y + j] = block[Y + j] + distance * ey
        block[XX + j] = along * ex * ex + across * ey * ey - 2.0 * both * ex * ey
        block[XY + j] = (along - across) * ex * ey + both * (ex * ex - ey * ey)
        block[YY + j] = along * ey * ey + across * ex * ex + 2.0 * both * ex * ey


@inlined
def _landmark_given(
    covariance: Triple, hx: float, hy: float, variance: float
) -> tuple[float, float, Triple, float]:
    """A landmark given one scalar of row h = (hx, hy): its gain, its covariance, and 1/s.

    For 2 × 2, Σ − Σhhᵀ Σ/s = (R Σ + |Σ| h⊥h⊥ᵀ)/s with s = hᵀΣh + R: a sum of positive terms, so
    the covariance stays positive definite.
    """
    xx, xy, yy = covariance
    wx, wy = xx * hx + xy * hy, xy * hx + yy * hy
    per = 1.0 / (hx * wx + hy * wy + variance)
    shrunk, across = variance * per, (xx * yy - xy * xy) * per
    left = (
        shrunk * xx + across * hy * hy,
        shrunk * xy - across * hx * hy,
        shrunk * yy + across * hx * hx,
    )
    return wx * per, wy * per, left, per


@compiled
def condition_landmark(block: Block) -> None:
    """The EKF update of the landmark by what was predicted of it, and the weight of that.

    The two rows of Hₗ, linearised once, are taken one after the other: the range, then the bearing
    less its regression on the range, since what is left of its error is independent of the range's.
    """
    for j in range(LANES):
        ex, ey, per = block[EX + j], block[EY + j], 1.0 / block[DISTANCE + j]
        rr, rb, of_range = block[RR + j], block[RB + j], block[OF_RANGE + j]
        slope = rb / rr
        covariance = block[XX + j], block[XY + j], block[YY + j]
        gx, gy, covariance, per_range = _landmark_given(covariance, ex, ey, rr)
        dx, dy = gx * of_range, gy * of_range
        hx, hy = -ey * per - slope * ex, ex * per - slope * ey
        of_bearing = block[OF_BEARING + j] - slope * of_range - (hx * dx + hy * dy)
        gx, gy, covariance, per_bearing = _landmark_given(
            covariance, hx, hy, block[BB + j] - slope * rb
        )
        block[MEAN_X + j] += dx + gx * of_bearing
        block[MEAN_Y + j] += dy + gy * of_bearing
        block[XX + j], block[XY + j], block[YY + j] = covariance
        chi2 = of_range * of_range * per_range + of_bearing * of_bearing * per_bearing
        volume = elementary.log_of_normal(per_range * per_bearing) - 2.0 * LOG_2_PI
        block[LOG_WEIGHT + j] += 0.5 * (volume - chi2)


@compiled
def store_landmark(
    block: Block,
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    slot: int,
    begin: int,
) -> None:
    """The landmark's rows, in place, of the particles from `begin` on."""
    for j in range(min(LANES, len(means) - begin)):
        i = begin + j
        means[i, slot, 0], means[i, slot, 1] = block[MEAN_X + j], block[MEAN_Y + j]
        covariances[i, slot, 0], covariances[i, slot, 1] = block[XX + j], block[XY + j]
        covariances[i, slot, 2] = block[YY + j]
