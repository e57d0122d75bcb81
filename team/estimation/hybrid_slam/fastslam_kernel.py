"""Compiled kernel of the FastSLAM step of all particles, sixteen at once (`blocks`).

Arrays by particle: poses (M, 3), landmark means (M, L, 2), landmark covariances as (xx, xy, yy) in
(M, L, 3). The kernel writes into arrays that its caller has just allocated.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt32

from team.estimation import elementary
from team.estimation.compiled import compiled, inlined
from team.estimation.geometry import wrapped
from team.estimation.hybrid_slam.blocks import (
    BB,
    COSINE,
    DISTANCE,
    EX,
    EY,
    HEADING,
    LANES,
    LOG_WEIGHT,
    OF_BEARING,
    OF_RANGE,
    OWN,
    RB,
    RR,
    SINE,
    XX,
    XY,
    YY,
    Block,
    Measured,
    U,
    V,
    X,
    Y,
    condition_landmark,
    drive,
    load_landmark,
    load_poses,
    place,
    predict,
    store_landmark,
)
from team.estimation.hybrid_slam.landmark_kernel import Triple
from team.estimation.placing import put

Ids = UInt32[np.ndarray, " L"]
Square = tuple[float, float, float, float, float, float, float, float, float]

(
    # The pose at the mean of the motion, its heading by sine and cosine.
    AT_X, AT_Y, AT_HEADING, AT_SINE, AT_COSINE,
    # Mean m and root A of the motion's noise, and the normal numbers of its draw.
    M0, M1, M2, A00, A01, A02, A10, A11, A12, A20, A21, A22, N0, N1, N2,
    END,
) = range(OWN, OWN + 21 * LANES, LANES)  # fmt: skip


@compiled
def slots_of(
    known: Ids, observed: UInt32[np.ndarray, " n"]
) -> tuple[Ids, Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The ids after the measurements, each measurement's slot in them, and whether its landmark is
    new.
    """
    ids = np.empty(len(known) + len(observed), np.uint32)
    put(ids, 0, known)
    count = len(known)
    slots = np.empty(len(observed), np.int64)
    first = np.zeros(len(observed), np.bool_)
    for k in range(len(observed)):
        slot = 0
        while slot < count and ids[slot] != observed[k]:
            slot += 1
        if slot == count:
            ids[count] = observed[k]
            count += 1
            first[k] = True
        slots[k] = slot
    return ids[:count].copy(), slots, first


SMALLEST_VARIANCE = 1e-200
"""A variance of motion below this is taken as zero [m², rad²]."""


@compiled
def semidefinite_factor(covariance: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Lower L with L Lᵀ = covariance, of any rank; NaN where the matrix is indefinite.

    A pivot within 1e-9 of its diagonal entry is taken for rounding of zero: its column is zero, and
    rounding grows by 1e9 at the most until the next pivot. So is one below SMALLEST_VARIANCE, whose
    quotients would not be finite. A pivot below −1e-6 of its diagonal entry means that the matrix
    is indefinite.
    """
    L = np.zeros((3, 3))
    for j in range(3):
        pivot = covariance[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if not pivot >= -1e-6 * abs(covariance[j, j]):
            L[j, j] = np.nan
        elif pivot > max(1e-9 * covariance[j, j], SMALLEST_VARIANCE):
            L[j, j] = math.sqrt(pivot)
            for i in range(j + 1, 3):
                rest = covariance[i, j]
                for k in range(j):
                    rest -= L[i, k] * L[j, k]
                L[i, j] = rest / L[j, j]
    return L


@compiled
def _begin(
    block: Block,
    start: Float[np.ndarray, "M 3"],
    motion: Float[np.ndarray, "3"],
    normals: Float[np.ndarray, "M 3"],
    begin: int,
) -> None:
    """The particles from `begin` on at start ∘ motion; the noise is N(0, I)."""
    load_poses(block, start, begin)
    drive(block, motion)
    last = len(start) - 1
    for j in range(LANES):
        i = min(begin + j, last)
        block[N0 + j], block[N1 + j], block[N2 + j] = normals[i, 0], normals[i, 1], normals[i, 2]
    for j in range(LANES):
        block[AT_X + j], block[AT_Y + j] = block[X + j], block[Y + j]
        block[AT_HEADING + j] = block[HEADING + j]
        block[AT_SINE + j], block[AT_COSINE + j] = block[SINE + j], block[COSINE + j]
        block[M0 + j], block[M1 + j], block[M2 + j] = 0.0, 0.0, 0.0
        block[A00 + j], block[A01 + j], block[A02 + j] = 1.0, 0.0, 0.0
        block[A10 + j], block[A11 + j], block[A12 + j] = 0.0, 1.0, 0.0
        block[A20 + j], block[A21 + j], block[A22 + j] = 0.0, 0.0, 1.0
        block[LOG_WEIGHT + j] = 0.0


@compiled
def _move_by_noise(block: Block, L: Float[np.ndarray, "3 3"]) -> None:
    """The poses after Exp(L m), of the mean m of the noise (`geometry.swept`)."""
    l00, l10, l11, l20, l21, l22 = L[0, 0], L[1, 0], L[1, 1], L[2, 0], L[2, 1], L[2, 2]
    for j in range(LANES):
        m0, m1, m2 = block[M0 + j], block[M1 + j], block[M2 + j]
        forward, left, turn = l00 * m0, l10 * m0 + l11 * m1, l20 * m0 + l21 * m1 + l22 * m2
        turn = min(max(turn, -elementary.FARTHEST), elementary.FARTHEST)
        of_turn, by_turn = elementary.sin_and_cos_near(turn)
        small, square = abs(turn) < 1e-4, turn * turn
        per = 1.0 / (1.0 if small else turn)
        along = 1.0 - square * (1.0 / 6.0) if small else of_turn * per
        across = turn * (0.5 - square * (1.0 / 24.0)) if small else (1.0 - by_turn) * per
        forward, left = along * forward - across * left, across * forward + along * left
        s, c = block[AT_SINE + j], block[AT_COSINE + j]
        block[X + j] = block[AT_X + j] + c * forward - s * left
        block[Y + j] = block[AT_Y + j] + s * forward + c * left
        block[HEADING + j] = wrapped(block[AT_HEADING + j] + turn)
        block[SINE + j], block[COSINE + j] = s * by_turn + c * of_turn, c * by_turn - s * of_turn


@inlined
def _conditioned(
    mean: Triple, root: Square, row: Triple, innovation: float, variance: float
) -> tuple[Triple, Square, float]:
    """N(m, A Aᵀ) given row·ε + v = row·m + innovation, v ~ N(0, variance): m, A and a quotient.

    Potter's square-root update: the covariance can not lose its sign. The quotient is that by which
    |det A|² is multiplied. Maybeck 1979, section 7.3.
    """
    a00, a01, a02, a10, a11, a12, a20, a21, a22 = root
    p0 = a00 * row[0] + a10 * row[1] + a20 * row[2]
    p1 = a01 * row[0] + a11 * row[1] + a21 * row[2]
    p2 = a02 * row[0] + a12 * row[1] + a22 * row[2]
    total = p0 * p0 + p1 * p1 + p2 * p2 + variance
    per = 1.0 / total
    left = variance * per
    share = 1.0 / (1.0 + math.sqrt(left))
    g0 = (a00 * p0 + a01 * p1 + a02 * p2) * per
    g1 = (a10 * p0 + a11 * p1 + a12 * p2) * per
    g2 = (a20 * p0 + a21 * p1 + a22 * p2) * per
    mean = mean[0] + g0 * innovation, mean[1] + g1 * innovation, mean[2] + g2 * innovation
    g0, g1, g2 = share * g0, share * g1, share * g2
    root = (
        a00 - g0 * p0, a01 - g0 * p1, a02 - g0 * p2,
        a10 - g1 * p0, a11 - g1 * p1, a12 - g1 * p2,
        a20 - g2 * p0, a21 - g2 * p1, a22 - g2 * p2,
    )  # fmt: skip
    return mean, root, left


@compiled
def _condition_noise(block: Block, L: Float[np.ndarray, "3 3"]) -> None:
    """The motion's noise ε given what was predicted of one known landmark at ε = m, in place.

    There z = h + H L (ε − m) + v with the joint covariance S = Hₗ Σ Hₗᵀ + R of v. The range is
    taken first, then the bearing less its regression on the range, so each is scalar. The logarithm
    of |det A| is added to that of the weight.
    """
    l00, l10, l11, l20, l21, l22 = L[0, 0], L[1, 0], L[1, 1], L[2, 0], L[2, 1], L[2, 2]
    for j in range(LANES):
        ex, ey, per = block[EX + j], block[EY + j], 1.0 / block[DISTANCE + j]
        xx, xy, yy = block[XX + j], block[XY + j], block[YY + j]
        S_rr = xx * ex * ex + 2.0 * xy * ex * ey + yy * ey * ey + block[RR + j]
        S_rb = (xy * (ex * ex - ey * ey) + (yy - xx) * ex * ey) * per + block[RB + j]
        S_bb = (xx * ey * ey - 2.0 * xy * ex * ey + yy * ex * ex) * (per * per) + block[BB + j]
        slope = S_rb / S_rr
        u, v = block[U + j], block[V + j]
        r0, r1 = -u * l00 - v * l10, -v * l11
        b0 = (v * l00 - u * l10) * per - l20 - slope * r0
        b1, b2 = -u * l11 * per - l21 - slope * r1, -l22
        m0, m1, m2 = block[M0 + j], block[M1 + j], block[M2 + j]
        root = (
            block[A00 + j], block[A01 + j], block[A02 + j],
            block[A10 + j], block[A11 + j], block[A12 + j],
            block[A20 + j], block[A21 + j], block[A22 + j],
        )  # fmt: skip
        of_range = block[OF_RANGE + j]
        of_bearing = block[OF_BEARING + j] - slope * of_range
        mean, root, left = _conditioned((m0, m1, m2), root, (r0, r1, 0.0), of_range, S_rr)
        of_bearing -= b0 * (mean[0] - m0) + b1 * (mean[1] - m1) + b2 * (mean[2] - m2)
        mean, root, lower = _conditioned(mean, root, (b0, b1, b2), of_bearing, S_bb - slope * S_rb)
        block[M0 + j], block[M1 + j], block[M2 + j] = mean
        block[A00 + j], block[A01 + j], block[A02 + j] = root[0], root[1], root[2]
        block[A10 + j], block[A11 + j], block[A12 + j] = root[3], root[4], root[5]
        block[A20 + j], block[A21 + j], block[A22 + j] = root[6], root[7], root[8]
        block[LOG_WEIGHT + j] += 0.5 * elementary.log_of_normal(left * lower)


@compiled
def _draw(block: Block) -> None:
    """The noise m + A n in place of its mean; log N(ε; 0, I) − log N(ε; m, A Aᵀ) but for |det A|.

    Both are of the weight's logarithm.
    """
    for j in range(LANES):
        n0, n1, n2 = block[N0 + j], block[N1 + j], block[N2 + j]
        e0 = block[M0 + j] + block[A00 + j] * n0 + block[A01 + j] * n1 + block[A02 + j] * n2
        e1 = block[M1 + j] + block[A10 + j] * n0 + block[A11 + j] * n1 + block[A12 + j] * n2
        e2 = block[M2 + j] + block[A20 + j] * n0 + block[A21 + j] * n1 + block[A22 + j] * n2
        block[M0 + j], block[M1 + j], block[M2 + j] = e0, e1, e2
        before = n0 * n0 + n1 * n1 + n2 * n2
        block[LOG_WEIGHT + j] += 0.5 * before - 0.5 * (e0 * e0 + e1 * e1 + e2 * e2)


@compiled
def step(
    start: Float[np.ndarray, "M 3"],
    motion: Float[np.ndarray, "3"],
    L: Float[np.ndarray, "3 3"],
    normals: Float[np.ndarray, "M 3"],
    known: int,
    slots: Int64[np.ndarray, " n"],
    first: Bool[np.ndarray, " n"],
    rows: Measured,
    improved: bool,
    poses: Float[np.ndarray, "M 3"],
    log_weights: Float[np.ndarray, " M"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
) -> None:
    """Poses start ∘ motion ∘ Exp(L ε), then every landmark of the measurements given them.

    ε is drawn from the prior N(0, I) (FastSLAM 1.0) or, `improved`, from N(m, A Aᵀ): the prior
    conditioned on the measurements of known landmarks, one after another, each linearised where the
    ones before it have brought m (FastSLAM 2.0 in the space of the motion's noise: no covariance
    of motion is inverted, so it may be singular). Added to `log_weights`, at the sampled pose:

        log p(z | pose, landmarks marginalised) + log N(ε; 0, I) − log N(ε; m, A Aᵀ).

    Slots below `known` hold landmarks of earlier steps. A first sight has a flat prior and adds
    nothing; a second measurement of it in the same step updates it, but has no part in the
    proposal. rows: the measurements (`blocks.measured`). The last four arrays are written in place.
    Thrun et al. 2005, section 13.5-13.8; Montemerlo 2003, chapter 4.
    """
    block = np.empty(END)
    for begin in range(0, len(start), LANES):
        _begin(block, start, motion, normals, begin)
        for k in range(len(slots) if improved else 0):
            if slots[k] < known:
                _move_by_noise(block, L)
                load_landmark(block, means, covariances, slots[k], begin)
                predict(block, rows[k])
                _condition_noise(block, L)
        _draw(block)
        _move_by_noise(block, L)
        for k in range(len(slots)):
            if first[k]:
                place(block, rows[k])
            else:
                load_landmark(block, means, covariances, slots[k], begin)
                predict(block, rows[k])
                condition_landmark(block)
            store_landmark(block, means, covariances, slots[k], begin)
        for j in range(min(LANES, len(start) - begin)):
            i = begin + j
            poses[i, 0], poses[i, 1], poses[i, 2] = block[X + j], block[Y + j], block[HEADING + j]
            log_weights[i] += block[LOG_WEIGHT + j]
