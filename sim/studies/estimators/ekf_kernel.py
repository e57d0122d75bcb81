"""EKF-SLAM step in one compiled pass: motion, measurements of known landmarks, new landmarks.

The state is (x, y, theta, x₁, y₁, …); `mean` and `P` have room for the new landmarks and are
written in place. A sensor is (σ_range², σ_range_per_m², σ_bearing²); range noise is at the
predicted range.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped
from team.estimation.hybrid_slam.landmark_kernel import Triple, place, seen


@compiled
def step(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    known: int,
    motion: Float[np.ndarray, "3"],
    Q: Float[np.ndarray, "3 3"],
    slots: Int64[np.ndarray, " k"],
    first: Bool[np.ndarray, " k"],
    measurements: Float[np.ndarray, "k 2"],
    sensor: Triple,
) -> bool:
    """Perform one step; before it only the pose and the first `known` landmarks are in mean and P.

    slots: landmark of each measurement in the state; first: first sight of it. Further measurements
    of a new landmark update it after its placement. False where the innovation covariance is not
    positive definite; mean and P are then invalid.
    """
    size = 3 + 2 * known
    before, P_before = mean[:size], P[:size, :size]
    _move(before, P_before, motion, Q)
    places = 3 + 2 * slots
    old = slots < known
    if not _condition(before, P_before, places[old], measurements[old], sensor):
        return False
    for k in range(len(slots)):
        if first[k]:
            _place(mean, P, places[k], measurements[k], sensor)
    again = ~old & ~first
    return _condition(mean, P, places[again], measurements[again], sensor)


@compiled
def _move(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    motion: Float[np.ndarray, "3"],
    Q: Float[np.ndarray, "3 3"],
) -> None:
    """Move: pose ← pose ∘ motion ∘ Exp(ξ), ξ ~ N(0, Q): P_pp ← F P_pp Fᵀ + G Q Gᵀ, P_pl ← F P_pl.

    F = ∂(pose ∘ motion)/∂pose = [[I, ∂R/∂θ t], [0, 1]], G = blkdiag(R(θ'), 1).
    """
    s, c = elementary.sin_and_cos(mean[2])
    of_x, of_y = -s * motion[0] - c * motion[1], c * motion[0] - s * motion[1]
    mean[0] += of_y
    mean[1] -= of_x
    mean[2] = wrapped(mean[2] + motion[2])
    P[0] += of_x * P[2]
    P[1] += of_y * P[2]
    P[:, 0] += of_x * P[:, 2]
    P[:, 1] += of_y * P[:, 2]
    s, c = elementary.sin_and_cos(mean[2])
    across_x, across_y = c * Q[0, 2] - s * Q[1, 2], s * Q[0, 2] + c * Q[1, 2]
    P[0, 0] += c * c * Q[0, 0] - 2.0 * c * s * Q[0, 1] + s * s * Q[1, 1]
    P[1, 1] += s * s * Q[0, 0] + 2.0 * c * s * Q[0, 1] + c * c * Q[1, 1]
    P[2, 2] += Q[2, 2]
    P[1, 0] += c * s * (Q[0, 0] - Q[1, 1]) + (c * c - s * s) * Q[0, 1]
    P[2, 0] += across_x
    P[2, 1] += across_y
    P[0, 1], P[0, 2], P[1, 2] = P[1, 0], P[2, 0], P[2, 1]


@compiled
def _place(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    at: int,
    measurement: Float[np.ndarray, "2"],
    sensor: Triple,
) -> None:
    """Place a new landmark in the entries `at` and at + 1 of the state.

    g = (x, y) + r (cos, sin)(theta + b): with G_p = ∂g/∂pose its rows are P_l· = G_p P_p· and P_ll
    = G_p P_pp G_pᵀ + G_z R G_zᵀ, so its error includes the pose's.
    """
    own = np.empty(3)
    pose = (mean[0], mean[1], mean[2])
    place(mean[at : at + 2], own, pose, measurement, sensor, np.empty(0))
    of_x, of_y = mean[1] - mean[at + 1], mean[at] - mean[0]
    for j in range(at):
        P[at, j] = P[0, j] + of_x * P[2, j]
        P[at + 1, j] = P[1, j] + of_y * P[2, j]
        P[j, at], P[j, at + 1] = P[at, j], P[at + 1, j]
    P[at, at] = P[at, 0] + of_x * P[at, 2] + own[0]
    P[at + 1, at] = P[at + 1, 0] + of_x * P[at + 1, 2] + own[1]
    P[at + 1, at + 1] = P[at + 1, 1] + of_y * P[at + 1, 2] + own[2]
    P[at, at + 1] = P[at + 1, at]


@compiled
def _applied(seen_at: Triple, at: int, vector: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """H v of one measurement: the rows (range, bearing) of a landmark with index `at` in the state.

    seen_at is (d, ex, ey): distance and unit vector to the landmark. With e⊥ = (−ey, ex) and δ the
    landmark's entries of v less the position's: (e·δ, e⊥·δ/d − v_theta).
    """
    distance, ex, ey = seen_at
    dx, dy = vector[at] - vector[0], vector[at + 1] - vector[1]
    return ex * dx + ey * dy, (ex * dy - ey * dx) / distance - vector[2]


@compiled
def _all_applied(
    sights: Float[np.ndarray, "t 3"],
    places: Int64[np.ndarray, " t"],
    vector: Float[np.ndarray, " n"],
    out: Float[np.ndarray, " m"],
) -> None:
    for i in range(len(places)):
        seen_at = (sights[i, 0], sights[i, 1], sights[i, 2])
        out[2 * i], out[2 * i + 1] = _applied(seen_at, places[i], vector)


@compiled
def _condition(
    mean: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n n"],
    places: Int64[np.ndarray, " t"],
    measurements: Float[np.ndarray, "t 2"],
    sensor: Triple,
) -> bool:
    """Update by measurements of the landmarks at `places`, all linearised at the state before them.

    S = H P Hᵀ + R, K = P Hᵀ S⁻¹, x ← x + K (z − h(x)), and P by `_joseph`. False where S is not
    positive definite.
    """
    m, n = 2 * len(places), len(mean)
    if m == 0:
        return True
    sights, innovation, R = np.empty((len(places), 3)), np.empty(m), np.empty(m)
    pose = (mean[0], mean[1], mean[2])
    for i in range(len(places)):
        distance, ex, ey = seen(pose, mean[places[i] : places[i] + 2])
        sights[i, 0], sights[i, 1], sights[i, 2] = distance, ex, ey
        innovation[2 * i] = measurements[i, 0] - distance
        innovation[2 * i + 1] = wrapped(measurements[i, 1] + pose[2] - elementary.atan2(ey, ex))
        R[2 * i], R[2 * i + 1] = sensor[0] + sensor[1] * distance * distance, sensor[2]
    HP, S, column = np.empty((m, n)), np.empty((m, m)), np.empty(m)
    for j in range(n):
        _all_applied(sights, places, P[j], column)
        for k in range(m):
            HP[k, j] = column[k]
    for k in range(m):
        _all_applied(sights, places, HP[k], S[k])
        S[k, k] += R[k]
    gains = HP.copy()
    if not _solve_in_place(S, gains):
        return False
    for k in range(m):
        _subtract(mean, -innovation[k], gains[k])
    mean[2] = wrapped(mean[2])
    _joseph(P, HP, gains, sights, places, R)
    return True


@compiled
def _joseph(
    P: Float[np.ndarray, "n n"],
    HP: Float[np.ndarray, "m n"],
    gains: Float[np.ndarray, "m n"],
    sights: Float[np.ndarray, "t 3"],
    places: Int64[np.ndarray, " t"],
    R: Float[np.ndarray, " m"],
) -> None:
    """P ← A P Aᵀ + K R Kᵀ with A = I − K H and Kᵀ = `gains`, row by row in place.

    Each row b of A P becomes b Aᵀ + (K R Kᵀ)_j = b − (b Hᵀ − K_j R) Kᵀ; H is five entries wide. The
    lower triangle is copied, so P stays exactly symmetric.
    """
    m, n = HP.shape
    left = np.empty(m)
    for j in range(n):
        row = P[j]
        for k in range(m):
            _subtract(row, gains[k, j], HP[k])
        _all_applied(sights, places, row, left)
        for k in range(m):
            _subtract(row[: j + 1], left[k] - gains[k, j] * R[k], gains[k])
        for i in range(j):
            P[i, j] = row[i]


@compiled
def _subtract(
    vector: Float[np.ndarray, " n"], factor: float, other: Float[np.ndarray, " k"]
) -> None:
    """Compute vector −= factor · other on its first entries, without a temporary array."""
    for i in range(len(vector)):
        vector[i] -= factor * other[i]


@compiled
def _solve_in_place(S: Float[np.ndarray, "m m"], B: Float[np.ndarray, "m n"]) -> bool:
    """B ← S⁻¹ B by Cholesky, S = L Lᵀ; the lower triangle of S becomes L.

    False where S is not positive definite.
    """
    m = len(S)
    for k in range(m):
        for j in range(k):
            for i in range(k, m):
                S[i, k] -= S[i, j] * S[k, j]
        if not S[k, k] > 0.0:
            return False
        S[k, k] = math.sqrt(S[k, k])
        for i in range(k + 1, m):
            S[i, k] /= S[k, k]
    for k in range(m):
        for i in range(k):
            _subtract(B[k], S[k, i], B[i])
        B[k] /= S[k, k]
    for k in range(m - 1, -1, -1):
        for i in range(k + 1, m):
            _subtract(B[k], S[i, k], B[i])
        B[k] /= S[k, k]
    return True
