"""Compiled kernel of the FastSLAM step of all particles.

Arrays by particle: poses (M, 3), landmark means (M, L, 2), landmark covariances as (xx, xy, yy) in
(M, L, 3). The kernel writes into arrays that its caller has just allocated.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt32

from team.estimation import elementary
from team.estimation.compiled import compiled, inlined
from team.estimation.geometry import swept, wrapped
from team.estimation.hybrid_slam.landmark_kernel import (
    Triple,
    condition_on_measurement,
    innovation_of,
    place,
    seen,
)

Ids = UInt32[np.ndarray, " L"]


@compiled
def slots_of(
    known: Ids, observed: UInt32[np.ndarray, " n"]
) -> tuple[Ids, Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The ids after the measurements, each measurement's slot in them, and whether its landmark is
    new.
    """
    ids = np.empty(len(known) + len(observed), np.uint32)
    ids[: len(known)] = known
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


WEAKEST = 1e-150
"""The logarithm of a product of densities is taken when the product is below this, or above its
inverse.
"""
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


@inlined
def _moved(pose: Triple, s: float, c: float, forward: float, left: float, turn: float) -> Triple:
    """The pose after (forward, left, turn), given in it; s, c are of its heading."""
    return (
        pose[0] + c * forward - s * left,
        pose[1] + s * forward + c * left,
        wrapped(pose[2] + turn),
    )


@inlined
def _moved_by_noise(
    pose: Triple, s: float, c: float, L: Float[np.ndarray, "3 3"], noise: Triple
) -> Triple:
    """The pose after Exp(L ε), for a lower triangular L; s, c are of its heading."""
    turn = L[2, 0] * noise[0] + L[2, 1] * noise[1] + L[2, 2] * noise[2]
    x, y = swept(L[0, 0] * noise[0], L[1, 0] * noise[0] + L[1, 1] * noise[1], turn)
    return _moved(pose, s, c, x, y, turn)


@inlined
def _condition_noise(
    noise_mean: Float[np.ndarray, "3"],
    root: Float[np.ndarray, "3 3"],
    row: Triple,
    innovation: float,
    variance: float,
) -> float:
    """N(m, A Aᵀ) given row·ε + v = row·m + innovation, v ~ N(0, variance); in place.

    Potter's square-root update: the covariance can not lose its sign. Returns by what |det A|² is
    multiplied. Maybeck 1979, section 7.3.
    """
    phi0 = root[0, 0] * row[0] + root[1, 0] * row[1] + root[2, 0] * row[2]
    phi1 = root[0, 1] * row[0] + root[1, 1] * row[1] + root[2, 1] * row[2]
    phi2 = root[0, 2] * row[0] + root[1, 2] * row[1] + root[2, 2] * row[2]
    total: float = phi0 * phi0 + phi1 * phi1 + phi2 * phi2 + variance
    share = 1.0 / (1.0 + math.sqrt(variance / total))
    for i in range(3):
        gain = (root[i, 0] * phi0 + root[i, 1] * phi1 + root[i, 2] * phi2) / total
        noise_mean[i] += gain * innovation
        root[i, 0] -= share * gain * phi0
        root[i, 1] -= share * gain * phi1
        root[i, 2] -= share * gain * phi2
    return variance / total


@inlined
def _condition_noise_on_measurement(
    noise_mean: Float[np.ndarray, "3"],
    root: Float[np.ndarray, "3 3"],
    L: Float[np.ndarray, "3 3"],
    pose: Triple,
    measurement: Float[np.ndarray, "2"],
    sensor: Triple,
    own: Float[np.ndarray, " own"],
    mean: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "3"],
) -> float:
    """The motion's noise ε given one (range, bearing) of a known landmark, in place.

    `pose` is the particle's pose at ε = m; there z = h + H L (ε − m) + v with the joint covariance
    S = Hₗ Σ Hₗᵀ + R of v. The range is taken first, then the bearing less its regression on the
    range, so each is scalar. Returns by what |det A|² is multiplied.
    """
    distance, ex, ey = seen(pose, mean)
    s, c = elementary.sin_and_cos(pose[2])
    u, v = c * ex + s * ey, c * ey - s * ex
    xx, xy, yy = covariance[0], covariance[1], covariance[2]
    of_range, of_bearing, rr, rb, bb = innovation_of(
        measurement, own, sensor, distance, wrapped(measurement[1] - elementary.atan2(v, u))
    )
    S_rr = xx * ex * ex + 2.0 * xy * ex * ey + yy * ey * ey
    S_rr += rr
    S_rb = (xy * (ex * ex - ey * ey) + (yy - xx) * ex * ey) / distance + rb
    S_bb = (xx * ey * ey - 2.0 * xy * ex * ey + yy * ex * ex) / (distance * distance) + bb
    slope = S_rb / S_rr
    r0, r1 = -u * L[0, 0] - v * L[1, 0], -v * L[1, 1]
    b0 = (v * L[0, 0] - u * L[1, 0]) / distance - L[2, 0] - slope * r0
    b1 = -u * L[1, 1] / distance - L[2, 1] - slope * r1
    b2 = -L[2, 2]
    m0, m1, m2 = noise_mean[0], noise_mean[1], noise_mean[2]
    of_bearing -= slope * of_range
    by_range = _condition_noise(noise_mean, root, (r0, r1, 0.0), of_range, S_rr)
    of_bearing -= b0 * (noise_mean[0] - m0) + b1 * (noise_mean[1] - m1) + b2 * (noise_mean[2] - m2)
    by_bearing = _condition_noise(noise_mean, root, (b0, b1, b2), of_bearing, S_bb - slope * S_rb)
    return by_range * by_bearing


@compiled
def step(
    start: Float[np.ndarray, "M 3"],
    motion: Float[np.ndarray, "3"],
    L: Float[np.ndarray, "3 3"],
    normals: Float[np.ndarray, "M 3"],
    known: int,
    slots: Int64[np.ndarray, " n"],
    first: Bool[np.ndarray, " n"],
    measurements: Float[np.ndarray, "n 2"],
    sensor: Triple,
    own: Float[np.ndarray, "n own"],
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
    proposal. own: rows of `team.estimation.scans`. The last four arrays are written in place.
    Thrun et al. 2005, section 13.5-13.8; Montemerlo 2003, chapter 4.
    """
    noise_mean, root = np.empty(3), np.empty((3, 3))
    for i in range(len(start)):
        s, c = elementary.sin_and_cos(start[i, 2])
        begin = start[i, 0], start[i, 1], start[i, 2]
        origin = _moved(begin, s, c, motion[0], motion[1], motion[2])
        s, c = elementary.sin_and_cos(origin[2])
        noise_mean[:] = 0.0
        root[:] = 0.0
        root[0, 0] = root[1, 1] = root[2, 2] = 1.0
        log_weight, factor = 0.0, 1.0
        for k in range(len(slots) if improved else 0):
            if slots[k] < known:
                drawn = noise_mean[0], noise_mean[1], noise_mean[2]
                pose = _moved_by_noise(origin, s, c, L, drawn)
                factor *= _condition_noise_on_measurement(
                    noise_mean,
                    root,
                    L,
                    pose,
                    measurements[k],
                    sensor,
                    own[k],
                    means[i, slots[k]],
                    covariances[i, slots[k]],
                )
                if not WEAKEST < factor < 1.0 / WEAKEST:
                    log_weight, factor = log_weight + 0.5 * elementary.log(factor), 1.0
        n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
        e0 = noise_mean[0] + root[0, 0] * n0 + root[0, 1] * n1 + root[0, 2] * n2
        e1 = noise_mean[1] + root[1, 0] * n0 + root[1, 1] * n1 + root[1, 2] * n2
        e2 = noise_mean[2] + root[2, 0] * n0 + root[2, 1] * n1 + root[2, 2] * n2
        log_weight += 0.5 * (n0 * n0 + n1 * n1 + n2 * n2) - 0.5 * (e0 * e0 + e1 * e1 + e2 * e2)
        pose = _moved_by_noise(origin, s, c, L, (e0, e1, e2))
        poses[i, 0], poses[i, 1], poses[i, 2] = pose
        for k in range(len(slots)):
            mean, covariance = means[i, slots[k]], covariances[i, slots[k]]
            if first[k]:
                place(mean, covariance, pose, measurements[k], sensor, own[k])
            else:
                chi2, volume = condition_on_measurement(
                    mean, covariance, pose, measurements[k], sensor, own[k]
                )
                log_weight -= 0.5 * chi2
                factor /= volume
                if not WEAKEST < factor < 1.0 / WEAKEST:
                    log_weight, factor = log_weight + 0.5 * elementary.log(factor), 1.0
        log_weights[i] += log_weight + 0.5 * elementary.log(factor)
