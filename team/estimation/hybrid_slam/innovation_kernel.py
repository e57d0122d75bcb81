"""Compiled kernel of the NIS: the moments of what all particles predict of a scan.

Of each block of particles (`blocks`) and each component, a range or a bearing, there are eight rows
of what is added up. A sum over particles goes by lanes, which are added in pairs at the end.
"""

import math

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.gaussian import EPSILON
from team.estimation.geometry import wrapped
from team.estimation.hybrid_slam.blocks import (
    BB,
    COSINE_OFF,
    DISTANCE,
    EX,
    EY,
    IS_POINT,
    LANES,
    OF_BEARING,
    OF_RANGE,
    OWN,
    RB,
    RR,
    SINE_OFF,
    XX,
    XY,
    YY,
    Block,
    Measured,
    U,
    V,
    drive,
    load_landmark,
    load_poses,
    measured,
    predict,
)
from team.estimation.hybrid_slam.fastslam_kernel import semidefinite_factor, slots_of
from team.estimation.hybrid_slam.landmark_kernel import Triple

WEIGHT, ROOT, END = range(OWN, OWN + 3 * LANES, LANES)
"""A particle's weight, and its root."""
MOTION, DEVIATION, LANDMARK, SPREAD, ROWS = 0, 3 * LANES, 4 * LANES, 6 * LANES, 8 * LANES
"""Rows of a component, times the root of the weight: three of Hₓ L, one of d, two of Hₗ, two of
Σ Hₗᵀ. Before the mean is known the row of d holds the innovation itself.
"""
OF_RR, OF_RB, OF_BB, OF_RANGES, OF_BEARINGS, OF_SINES, OF_COSINES, SUMS = range(0, 8 * LANES, LANES)
"""Weighted sums of a measurement: its noise, its innovations, the direction of its bearing's."""
Lanes = Float[np.ndarray, " rows_lanes"]


@compiled
def _summed(lanes: Lanes, row: int) -> float:
    """The sum of a row's lanes, in pairs; in place."""
    half = LANES // 2
    while half:
        for j in range(row, row + half):
            lanes[j] += lanes[j + half]
        half //= 2
    return float(lanes[row])


@compiled
def _store_rows(
    block: Block, L: Float[np.ndarray, "3 3"], of_range: Lanes, of_bearing: Lanes
) -> None:
    """The rows of both components of what one block predicts of a measurement."""
    l00, l10, l11, l20, l21, l22 = L[0, 0], L[1, 0], L[1, 1], L[2, 0], L[2, 1], L[2, 2]
    for j in range(LANES):
        root, per = block[ROOT + j], 1.0 / block[DISTANCE + j]
        u, v = root * block[U + j], root * block[V + j]
        of_range[MOTION + j], of_range[MOTION + LANES + j] = -u * l00 - v * l10, -v * l11
        of_range[MOTION + 2 * LANES + j] = 0.0
        of_bearing[MOTION + j] = (v * l00 - u * l10) * per - root * l20
        of_bearing[MOTION + LANES + j] = -u * l11 * per - root * l21
        of_bearing[MOTION + 2 * LANES + j] = -root * l22
        of_range[DEVIATION + j] = block[OF_RANGE + j]
        of_bearing[DEVIATION + j] = block[OF_BEARING + j]
    for j in range(LANES):
        root, per = block[ROOT + j], 1.0 / block[DISTANCE + j]
        xx, xy, yy = block[XX + j], block[XY + j], block[YY + j]
        x, y = root * block[EX + j], root * block[EY + j]
        of_range[LANDMARK + j], of_range[LANDMARK + LANES + j] = x, y
        of_range[SPREAD + j] = xx * x + xy * y
        of_range[SPREAD + LANES + j] = xy * x + yy * y
        x, y = -y * per, x * per
        of_bearing[LANDMARK + j], of_bearing[LANDMARK + LANES + j] = x, y
        of_bearing[SPREAD + j] = xx * x + xy * y
        of_bearing[SPREAD + LANES + j] = xy * x + yy * y


@compiled
def _add_sums(block: Block, sums: Lanes) -> None:
    """Adds a block's weighted noise and innovations of a measurement to its sums."""
    for j in range(LANES):
        weight = block[WEIGHT + j]
        sums[OF_RR + j] += weight * block[RR + j]
        sums[OF_RB + j] += weight * block[RB + j]
        sums[OF_BB + j] += weight * block[BB + j]
        sums[OF_RANGES + j] += weight * block[OF_RANGE + j]
        sums[OF_BEARINGS + j] += weight * block[OF_BEARING + j]
        sums[OF_SINES + j] += weight * block[SINE_OFF + j]
        sums[OF_COSINES + j] += weight * block[COSINE_OFF + j]


@compiled
def _deviate(rows: Lanes, roots: Lanes, mean: float) -> None:
    """D √w of one block in place of a component's innovations; of what is no angle."""
    for j in range(LANES):
        rows[DEVIATION + j] = (rows[DEVIATION + j] - mean) * roots[j]


@compiled
def _deviate_around(rows: Lanes, roots: Lanes, mean: float) -> None:
    """As `_deviate`, of angles, the shorter way round."""
    for j in range(LANES):
        rows[DEVIATION + j] = wrapped(rows[DEVIATION + j] - mean) * roots[j]


@compiled
def _add_product(a: Lanes, b: Lanes, lanes: Lanes, same: bool) -> None:
    """Adds one block's Σ w (Hₓ Q Hₓᵀ + d dᵀ) of two components; of the `same` landmark also Σ w
    Hₗ Σ Hₗᵀ.
    """
    for j in range(LANES):
        of_motion = a[j] * b[j] + a[LANES + j] * b[LANES + j] + a[2 * LANES + j] * b[2 * LANES + j]
        lanes[j] += of_motion + a[DEVIATION + j] * b[DEVIATION + j]
    if same:
        for j in range(LANES):
            along = a[LANDMARK + j] * b[SPREAD + j]
            lanes[j] += along + a[LANDMARK + LANES + j] * b[SPREAD + LANES + j]


@compiled
def predictive(
    poses: Float[np.ndarray, "M 3"],
    log_weights: Float[np.ndarray, " M"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    motion: Float[np.ndarray, "3"],
    L: Float[np.ndarray, "3 3"],
    slots: Int64[np.ndarray, " n"],
    rows: Measured,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """(z − ẑ, S) of n measurements as (range, bearing, range, …), m = 2n; L Lᵀ is the motion's Q.

    What was read less what a particle predicts lies near zero, where angles have a mean.
    """
    n, m = len(slots), 2 * len(slots)
    blocks = (len(poses) + LANES - 1) // LANES
    block, sums, lanes = np.empty(END), np.zeros((n, SUMS)), np.empty(LANES)
    found, roots = np.empty((blocks, m, ROWS)), np.empty((blocks, LANES))
    for b in range(blocks):
        begin = b * LANES
        load_poses(block, poses, begin)
        for j in range(LANES):
            # Lanes behind the last particle weigh nothing.
            block[WEIGHT + j] = log_weights[begin + j] if begin + j < len(poses) else -math.inf
        for j in range(LANES):
            block[WEIGHT + j] = elementary.exp(block[WEIGHT + j])
            block[ROOT + j] = roots[b, j] = math.sqrt(block[WEIGHT + j])
        drive(block, motion)
        for k in range(n):
            load_landmark(block, means, covariances, slots[k], begin)
            predict(block, rows[k])
            _store_rows(block, L, found[b, 2 * k], found[b, 2 * k + 1])
            _add_sums(block, sums[k])
    mean, S = np.empty(m), np.zeros((m, m))
    for k in range(n):
        r, a = 2 * k, 2 * k + 1
        S[r, r], S[a, r] = _summed(sums[k], OF_RR), _summed(sums[k], OF_RB)
        S[a, a], mean[r] = _summed(sums[k], OF_BB), _summed(sums[k], OF_RANGES)
        if rows[k, IS_POINT] > 0.0:
            mean[a] = _summed(sums[k], OF_BEARINGS)
        else:
            mean[a] = elementary.atan2(_summed(sums[k], OF_SINES), _summed(sums[k], OF_COSINES))
        for b in range(blocks):
            _deviate(found[b, r], roots[b], mean[r])
            if rows[k, IS_POINT] > 0.0:
                _deviate(found[b, a], roots[b], mean[a])
            else:
                _deviate_around(found[b, a], roots[b], mean[a])
    for j in range(m):
        for k in range(j + 1):
            lanes[:] = 0.0
            for b in range(blocks):
                _add_product(found[b, j], found[b, k], lanes, slots[j // 2] == slots[k // 2])
            S[j, k] += _summed(lanes, 0)
            S[k, j] = S[j, k]
    return mean, S


@compiled
def predictive_of_known(
    poses: Float[np.ndarray, "M 3"],
    log_weights: Float[np.ndarray, " M"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    known: UInt32[np.ndarray, " L"],
    motion: Float[np.ndarray, "3"],
    motion_covariance: Float[np.ndarray, "3 3"],
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    sensor: Triple,
    own: Float[np.ndarray, "n own"],
) -> tuple[float, Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """`predictive` of those measurements whose landmark is known, and νᵀ S⁻¹ ν; NaN where a pivot
    of S is not above rounding.
    """
    _, slots, _ = slots_of(known, ids)
    chosen = slots < len(known)
    if not chosen.any():
        return 0.0, np.empty(0), np.empty((0, 0))
    rows = measured(ranges[chosen], bearings[chosen], sensor, own[chosen])
    L = semidefinite_factor(motion_covariance)
    error, S = predictive(poses, log_weights, means, covariances, motion, L, slots[chosen], rows)
    return normalised_square(error, S), error, S


@compiled
def normalised_square(error: Float[np.ndarray, " m"], S: Float[np.ndarray, "m m"]) -> float:
    """νᵀ S⁻¹ ν by the Cholesky factor of S; NaN where a pivot is not above rounding."""
    m = len(error)
    L, white = np.empty((m, m)), np.empty(m)
    squares = 0.0
    for j in range(m):
        for k in range(j):
            rest = S[j, k]
            for i in range(k):
                rest -= L[j, i] * L[k, i]
            L[j, k] = rest / L[k, k]
        pivot, rest = S[j, j], error[j]
        for i in range(j):
            pivot -= L[j, i] * L[j, i]
            rest -= L[j, i] * white[i]
        if not pivot > m * EPSILON * S[j, j]:
            return math.nan
        L[j, j] = math.sqrt(pivot)
        white[j] = rest / L[j, j]
        squares += white[j] * white[j]
    return squares
