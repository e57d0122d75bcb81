"""Compiled kernels of `consensus`: compare the measurements of one window with each other.

Poses are K keyframes, the first at zero; a measurement is (range [m], bearing [rad]); all variances
of a measurement are its whole ones, since the persistent part of its error is nearly constant
within a window.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import (
    adjoint,
    between,
    compose,
    exponential,
    inverse,
    logarithm,
    wrapped,
)
from team.estimation.hybrid_slam.landmark_kernel import (
    innovation_of,
    landmark_jacobian,
    pose_jacobian,
    predicted,
)
from team.estimation.models import NEAREST_M
from team.estimation.placing import put_block

Sensor3 = tuple[float, float, float]
"""(σ_range² [m²], σ_range_per_m², σ_bearing² [rad²])."""


@compiled
def relative_motions(
    means: Float[np.ndarray, "K 3"], covariances: Float[np.ndarray, "K 3 3"]
) -> tuple[Float[np.ndarray, "K K 3"], Float[np.ndarray, "K K 3 3"]]:
    """b_from_a for every pair of keyframes a, b, and its covariance in the tangent space of b.

    Motion k leads from keyframe k − 1 to k. Backwards (T Exp ξ)⁻¹ = T⁻¹ Exp(−Ad(T) ξ).
    """
    count = len(means)
    poses, spread = np.zeros((count, count, 3)), np.zeros((count, count, 3, 3))
    for a in range(count):
        for b in range(a + 1, count):
            Ad = adjoint(inverse(means[b]))
            poses[a, b] = compose(poses[a, b - 1], means[b])
            spread[a, b] = _sandwiched(Ad, spread[a, b - 1]) + covariances[b]
            poses[b, a] = inverse(poses[a, b])
            spread[b, a] = _sandwiched(adjoint(poses[a, b]), spread[a, b])
    return poses, spread


@compiled
def _sandwiched(
    A: Float[np.ndarray, "p 3"], C: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "p p"]:
    """A C Aᵀ, summed in a fixed order."""
    rows = len(A)
    half, total = np.zeros((rows, 3)), np.zeros((rows, rows))
    for i in range(rows):
        for j in range(3):
            for k in range(3):
                half[i, j] += A[i, k] * C[k, j]
    for i in range(rows):
        for j in range(rows):
            for k in range(3):
                total[i, j] += half[i, k] * A[j, k]
    return total


@compiled
def _log_density(e0: float, e1: float, s00: float, s01: float, s11: float) -> float:
    """Log N(e; 0, S) of two numbers."""
    determinant = s00 * s11 - s01 * s01
    squared = (s11 * e0 * e0 - 2.0 * s01 * e0 * e1 + s00 * e1 * e1) / determinant
    return -0.5 * (squared + elementary.log(determinant)) - elementary.log(2.0 * math.pi)


@compiled
def _prediction(
    pose: Float[np.ndarray, "3"],
    spread: Float[np.ndarray, "3 3"],
    seen: Float[np.ndarray, "2"],
    measurement: Float[np.ndarray, "2"],
    sensor: Sensor3,
    seen_own: Float[np.ndarray, " own"],
    own: Float[np.ndarray, " own"],
) -> float:
    """The log p(measurement | another one of the landmark, `seen` from where `pose` is relative
    to).

    The landmark is where `seen` places it, with its noise, and is looked at after the odometry,
    with its noise and the measurement's: S = R + Hₓ C Hₓᵀ + Hₗ Σ Hₗᵀ.
    """
    distance, bearing = max(seen[0], NEAREST_M), seen[1]
    s, c = elementary.sin_and_cos(bearing)
    along = sensor[0] + sensor[1] * distance * distance
    across = sensor[2] * distance * distance
    both = 0.0
    if len(seen_own) and seen_own[3] >= 0.0:
        along, both = seen_own[0], seen_own[1] * distance
        across = seen_own[2] * distance * distance
    xx = along * c * c + across * s * s - 2.0 * both * c * s
    xy = (along - across) * c * s + both * (c * c - s * s)
    yy = along * s * s + across * c * c + 2.0 * both * c * s
    r, b = predicted(pose, np.array([distance * c, distance * s]))
    S = _sandwiched(pose_jacobian(r, b), spread)
    H = landmark_jacobian(r, pose[2] + b)
    for p in range(2):
        for q in range(2):
            S[p, q] += H[p, 0] * (xx * H[q, 0] + xy * H[q, 1])
            S[p, q] += H[p, 1] * (xy * H[q, 0] + yy * H[q, 1])
    e0, e1, rr, rb, bb = innovation_of(measurement, own, sensor, r, wrapped(measurement[1] - b))
    S[0, 0] += rr
    S[0, 1] += rb
    S[1, 1] += bb
    return _log_density(e0, e1, S[0, 0], S[0, 1], S[1, 1])


@compiled
def agreement(
    poses: Float[np.ndarray, "K K 3"],
    spread: Float[np.ndarray, "K K 3 3"],
    keyframes: Int64[np.ndarray, " N"],
    slots: Int64[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Float[np.ndarray, "N own"],
    sensor: Sensor3,
    landmarks: int,
    odds: tuple[float, float],
) -> tuple[Bool[np.ndarray, " N"], Int64[np.ndarray, " L"]]:
    """The measurements that agree, and for each landmark the measurement that the others support
    best.

    Measurement j supports i with max(0, log p(j | i, odometry) + odds[0]); a landmark whose best
    measurement has support above odds[1] takes it and those that support it.
    """
    placed_by = np.full(landmarks, -1)
    support = np.full(landmarks, -1.0)
    for i in range(len(slots)):
        total = 0.0
        for j in range(len(slots)):
            if j != i and slots[j] == slots[i]:
                motion, noise = (
                    poses[keyframes[i], keyframes[j]],
                    spread[keyframes[i], keyframes[j]],
                )
                log = _prediction(
                    motion, noise, measurements[i], measurements[j], sensor, own[i], own[j]
                )
                total += max(0.0, log + odds[0])
        if total > support[slots[i]]:
            support[slots[i]] = total
            placed_by[slots[i]] = i
    taken = np.zeros(len(slots), np.bool_)
    for j in range(len(slots)):
        i = placed_by[slots[j]]
        if support[slots[j]] > odds[1]:
            motion, noise = poses[keyframes[i], keyframes[j]], spread[keyframes[i], keyframes[j]]
            log = _prediction(
                motion, noise, measurements[i], measurements[j], sensor, own[i], own[j]
            )
            taken[j] = j == i or log + odds[0] > 0.0
    return taken, placed_by


@compiled
def normal_equations(
    path: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
    means: Float[np.ndarray, "K 3"],
    metrics: Float[np.ndarray, "K 3 3"],
    keyframes: Int64[np.ndarray, " N"],
    slots: Int64[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Float[np.ndarray, "N own"],
    used: Bool[np.ndarray, " N"],
    sensor: Sensor3,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
    """(H, g) of the smoother over poses 1 … K − 1 (tangent at their ends) and landmarks.

    Odometry residual log(mean⁻¹ ∘ x_{k−1}⁻¹ ∘ x_k) in the metric C⁻¹, measurements z − h in R⁻¹.
    The first three rows and columns are those of the first pose, which is fixed: they stand apart.
    """
    size = 3 * len(path) + 2 * len(landmarks)
    H, g = np.zeros((size, size)), np.zeros(size)
    J, at = np.zeros((3, 6)), np.empty(6, np.int64)
    for k in range(1, len(path)):
        put_block(J, 0, 0, -adjoint(between(path[k], path[k - 1])))
        for i in range(3):
            J[i, 3 + i] = 1.0
            at[i], at[3 + i] = 3 * (k - 1) + i, 3 * k + i
        residual = logarithm(between(means[k], between(path[k - 1], path[k])))
        _added(H, g, at, J, metrics[k], -residual)
    metric = np.zeros((2, 2))
    for n in range(len(keyframes)):
        if used[n]:
            J2, at2, innovation, variances = _row(
                path, landmarks, keyframes[n], slots[n], measurements[n], own[n], sensor
            )
            r0, both, r1 = variances
            metric[0, 0], metric[1, 1] = 1.0 / r0, 1.0 / r1
            metric[0, 1] = metric[1, 0] = 0.0
            if both != 0.0:
                determinant = r0 * r1 - both * both
                metric[0, 0], metric[1, 1] = r1 / determinant, r0 / determinant
                metric[0, 1] = metric[1, 0] = -both / determinant
            _added(H, g, at2, J2, metric, innovation)
    return H[3:, 3:].copy(), g[3:].copy()


@compiled
def _added(
    H: Float[np.ndarray, "n n"],
    g: Float[np.ndarray, " n"],
    at: Int64[np.ndarray, " p"],
    J: Float[np.ndarray, "m p"],
    metric: Float[np.ndarray, "m m"],
    residual: Float[np.ndarray, " m"],
) -> None:
    """Add Jᵀ W J and Jᵀ W residual at these rows, in place."""
    for p in range(len(at)):
        for i in range(len(residual)):
            weighted = 0.0
            for j in range(len(residual)):
                weighted += J[j, p] * metric[j, i]
            g[at[p]] += weighted * residual[i]
            for q in range(len(at)):
                H[at[p], at[q]] += weighted * J[i, q]


@compiled
def _row(
    path: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
    keyframe: int,
    slot: int,
    measurement: Float[np.ndarray, "2"],
    own: Float[np.ndarray, " own"],
    sensor: Sensor3,
) -> tuple[Float[np.ndarray, "2 5"], Int64[np.ndarray, "5"], Float[np.ndarray, "2"], Sensor3]:
    """∂h/∂(pose, landmark), its columns' place in the state, z − h and R (rr, rb, bb)."""
    r, b = predicted(path[keyframe], landmarks[slot])
    J, at = np.empty((2, 5)), np.empty(5, np.int64)
    put_block(J, 0, 0, pose_jacobian(r, b))
    put_block(J, 0, 3, landmark_jacobian(r, path[keyframe, 2] + b))
    for i in range(3):
        at[i] = 3 * keyframe + i
    at[3] = 3 * len(path) + 2 * slot
    at[4] = at[3] + 1
    of_range, of_bearing, rr, rb, bb = innovation_of(
        measurement, own, sensor, r, wrapped(measurement[1] - b)
    )
    return J, at, np.array([of_range, of_bearing]), (rr, rb, bb)


@compiled
def left_out(
    path: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
    covariance: Float[np.ndarray, "n n"],
    keyframes: Int64[np.ndarray, " N"],
    slots: Int64[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Float[np.ndarray, "N own"],
    used: Bool[np.ndarray, " N"],
    sensor: Sensor3,
) -> Float[np.ndarray, " N"]:
    """The log p(measurement | all other used measurements, odometry), linearised at the optimum.

    With M = J P Jᵀ a measurement that was not used has S = R + M; of one that was, D = R − M is the
    covariance of its residual e, and without it the residual is R D⁻¹ e with S = R D⁻¹ R.
    """
    logs = np.empty(len(keyframes))
    for n in range(len(keyframes)):
        J, at, e, variances = _row(
            path, landmarks, keyframes[n], slots[n], measurements[n], own[n], sensor
        )
        M = np.zeros((2, 2))
        for p in range(3 if keyframes[n] == 0 else 0, 5):
            for q in range(3 if keyframes[n] == 0 else 0, 5):
                P = covariance[at[p] - 3, at[q] - 3]
                for i in range(2):
                    for j in range(2):
                        M[i, j] += J[i, p] * P * J[j, q]
        r0, both, r1 = variances
        if not used[n]:
            logs[n] = _log_density(e[0], e[1], r0 + M[0, 0], both + M[0, 1], r1 + M[1, 1])
            continue
        d00, d01, d11 = r0 - M[0, 0], both - M[0, 1], r1 - M[1, 1]
        of_noise = r0 * r1 - both * both
        determinant = d00 * d11 - d01 * d01
        if not (d00 > 1e-9 * r0 and d11 > 1e-9 * r1 and determinant > 1e-12 * of_noise):
            logs[n] = -np.inf  # nothing else says where the landmark is
            continue
        logs[n] = _log_density(e[0], e[1], d00, d01, d11) + elementary.log(determinant / of_noise)
    return logs


@compiled
def filter_step(
    path: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
    step: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "L 2"]]:
    """Poses ∘ Exp(ξ), the first stays; landmarks plus their step."""
    poses, points = path.copy(), landmarks.copy()
    for k in range(1, len(path)):
        poses[k] = compose(path[k], exponential(step[3 * (k - 1) : 3 * k]))
    for slot in range(len(landmarks)):
        at = 3 * (len(path) - 1) + 2 * slot
        points[slot, 0] += step[at]
        points[slot, 1] += step[at + 1]
    return poses, points
