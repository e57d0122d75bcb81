"""Sixteen particles side by side: what each predicts of a measurement.

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
from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped
from team.estimation.hybrid_slam.landmark_kernel import Triple
from team.estimation.models import NEAREST_M

LANES = 16
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
    # What a kernel has of its own.
    OWN,
) = range(0, 23 * LANES, LANES)  # fmt: skip

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
