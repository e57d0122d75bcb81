"""Moment matching: a mixture of particles becomes one Gaussian, headings on the circle.

Poses after a way with an uncertain heading lie on a bent strip. The mean of their coordinates lies
inside of its bend, short of where the robot went, and the centre, which solves for each submap's
pose again, would find each way too short. A submap's poses have their mean and scatter on SE(2),
where the strip is straight: pose = μ ∘ Exp(ξ) with ξ of mean zero, as odometry has its noise (Long,
Wolfe, Mashner and Chirikjian 2012, The banana distribution is Gaussian).
"""

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.gaussian import factor_or_fault
from team.estimation.geometry import half_cotangent, wrapped
from team.estimation.placing import put, put_block
from team.estimation.summing import total

POSE_JITTER = (1e-6, 1e-6, 1e-8)
"""Added to each pose's variances [m², m², rad²]: motion noise of rank 2 leaves P singular."""
POSE_DEGREES = 5.0
"""q + 2 of a pose's q = 3 numbers; see `sample_factor`."""
MOST_SQUARE = 0.1
"""Σ wᵢ² of ten particles of equal weight; see `sample_factor`."""


@compiled
def mean_direction(angles: Float[np.ndarray, " M"], weights: Float[np.ndarray, " M"]) -> float:
    """The direction of Σ wᵢ (cos aᵢ, sin aᵢ)."""
    near, sines, cosines = np.empty(len(angles)), np.empty(len(angles)), np.empty(len(angles))
    for i in range(len(angles)):
        near[i] = elementary.near(angles[i])
    for i in range(len(near)):
        sines[i], cosines[i] = elementary.sin_and_cos_near(near[i])
    sine, cosine = 0.0, 0.0
    for i in range(len(near)):
        sine += weights[i] * sines[i]
        cosine += weights[i] * cosines[i]
    return elementary.atan2(sine, cosine)


@compiled
def mean_path(
    paths: Float[np.ndarray, "K M 3"], weights: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "K 3"]:
    """The weighted mean of the particles' poses at each of K keyframes, headings on the circle."""
    means = np.zeros((len(paths), 3))
    for k in range(len(paths)):
        for i in range(len(weights)):
            means[k, 0] += weights[i] * paths[k, i, 0]
            means[k, 1] += weights[i] * paths[k, i, 1]
        means[k, 2] = mean_direction(paths[k, :, 2], weights)
    return means


@compiled
def sample_factor(weights: Float[np.ndarray, " M"]) -> float:
    """What the scatter of particles is to be taken times for its inverse to be right on average.

    N = 1/Σ wᵢ² particles estimate their own mean, and the inverse of the covariance of such a
    sample of q-dimensional normals is too large by ν/(ν − q − 1), ν = N − 1 (Anderson 2003, section
    7.7): the factor is N/(N − q − 2), with the q = 3 numbers of a pose, the directions in which no
    particle has a covariance of its own. Fewer than ten particles are taken for ten.
    """
    return 1.0 / (1.0 - POSE_DEGREES * min(total(weights * weights), MOST_SQUARE))


@compiled
def on_group(
    poses: Float[np.ndarray, "M 3"], weights: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "M 3"]]:
    """The mean pose μ on SE(2), and each pose's deviation from it in (x, y, theta).

    μ's heading is the mean direction, its position the one with Σ wᵢ ξᵢ = 0 for the translations of
    ξᵢ = Log(μ⁻¹ ∘ poseᵢ). With Log(x, y, φ) = V(φ)⁻¹ (x, y), V(φ)⁻¹ = [[a, φ/2], [−φ/2, a]] and
    a = (φ/2) cot(φ/2), that is linear: Σ wᵢ V(φᵢ)⁻¹ R(μ)ᵀ (pᵢ − p) = 0. A deviation is ξᵢ turned by
    μ's heading.
    """
    count = len(poses)
    heading = mean_direction(poses[:, 2], weights)
    s, c = elementary.sin_and_cos(heading)
    offs, turns, cotangents = np.empty((count, 3)), np.empty(count), np.empty(count)
    for i in range(count):
        turns[i] = wrapped(poses[i, 2] - heading)
    for i in range(count):
        cotangents[i] = half_cotangent(turns[i])
    near, half, x, y = 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        a, b = cotangents[i], 0.5 * turns[i]
        ahead, left = c * poses[i, 0] + s * poses[i, 1], c * poses[i, 1] - s * poses[i, 0]
        offs[i, 0], offs[i, 1], offs[i, 2] = a * ahead + b * left, a * left - b * ahead, turns[i]
        near += weights[i] * a
        half += weights[i] * b
        x += weights[i] * offs[i, 0]
        y += weights[i] * offs[i, 1]
    square = near * near + half * half
    ahead, left = (near * x - half * y) / square, (near * y + half * x) / square
    for i in range(count):
        a, b = cotangents[i], 0.5 * turns[i]
        along = offs[i, 0] - (a * ahead + b * left)
        across = offs[i, 1] - (a * left - b * ahead)
        offs[i, 0], offs[i, 1] = c * along - s * across, s * along + c * across
    return np.array([c * ahead - s * left, s * ahead + c * left, heading]), offs


@compiled
def moments(
    poses: Float[np.ndarray, "M p"],
    weights: Float[np.ndarray, " M"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    between: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Mean and covariance of the mixture Σ wᵢ N(μᵢ, blkdiag(0, Σ₁, …, Σ_L)), n = p + 2L.

    Each particle has p/3 poses (x, y, theta), one behind the other. The scatter between the
    particles is taken times `between`: 1 for the mixture itself, see `sample_factor`.
    """
    count, p = poses.shape
    mean, deviations = _of_points(weights, means, p)
    for j in range(p):
        for i in range(count):
            mean[j] += weights[i] * poses[i, j]
    for heading in range(2, p, 3):
        mean[heading] = mean_direction(poses[:, heading], weights)
    for i in range(count):
        for j in range(p):
            deviations[i, j] = poses[i, j] - mean[j]
        for heading in range(2, p, 3):
            deviations[i, heading] = wrapped(deviations[i, heading])
    return mean, _covariance(deviations, weights, covariances, between)


@compiled
def _of_points(
    weights: Float[np.ndarray, " M"], means: Float[np.ndarray, "M L 2"], p: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "M n"]]:
    """The mean of the points' coordinates, and each particle's deviations from it, behind p numbers
    of the poses, which are still zero.
    """
    points = np.ascontiguousarray(means).reshape(len(means), 2 * means.shape[1])
    mean, deviations = np.zeros(p + points.shape[1]), np.zeros((len(means), p + points.shape[1]))
    for i in range(len(points)):
        for j in range(points.shape[1]):
            mean[p + j] += weights[i] * points[i, j]
    for i in range(len(points)):
        for j in range(points.shape[1]):
            deviations[i, p + j] = points[i, j] - mean[p + j]
    return mean, deviations


@compiled
def _covariance(
    deviations: Float[np.ndarray, "M n"],
    weights: Float[np.ndarray, " M"],
    covariances: Float[np.ndarray, "M L 3"],
    between: float,
) -> Float[np.ndarray, "n n"]:
    """`between` times the scatter of the deviations, and the mean of the landmarks' own
    covariances.
    """
    count, n = deviations.shape
    p = n - 2 * covariances.shape[1]
    P = np.zeros((n, n))
    for i in range(count):
        for j in range(n):
            scaled = between * weights[i] * deviations[i, j]
            for k in range(j + 1):
                P[j, k] += scaled * deviations[i, k]
        for landmark in range(covariances.shape[1]):
            j = p + 2 * landmark
            P[j, j] += weights[i] * covariances[i, landmark, 0]
            P[j + 1, j] += weights[i] * covariances[i, landmark, 1]
            P[j + 1, j + 1] += weights[i] * covariances[i, landmark, 2]
    for j in range(n):
        for k in range(j):
            P[k, j] = P[j, k]
    return P


@compiled
def submap_moments(
    poses: Float[np.ndarray, "M p"],
    log_weights: Float[np.ndarray, " M"],
    ids: UInt32[np.ndarray, " L"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
) -> tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, " n"], Float[np.ndarray, "n n"], int]:
    """`moments` by ascending id with the poses' mean and deviations `on_group`, the scatter times
    `sample_factor`, and POSE_JITTER on each pose; and the index in `gaussian.FAULTS` of why they
    are no Gaussian.
    """
    weights = np.empty(len(log_weights))
    for i in range(len(weights)):
        weights[i] = elementary.exp(log_weights[i])
    between = sample_factor(weights)
    ids, means, covariances = by_landmark(ids, means, covariances)
    mean, deviations = _of_points(weights, means, poses.shape[1])
    for pose in range(0, poses.shape[1], 3):
        at, off = on_group(np.ascontiguousarray(poses[:, pose : pose + 3]), weights)
        put(mean, pose, at)
        put_block(deviations, 0, pose, off)
    P = _covariance(deviations, weights, covariances, between)
    for i in range(poses.shape[1]):
        P[i, i] += POSE_JITTER[i % 3]
    _, fault = factor_or_fault(P)
    return ids, mean, P, fault


@compiled
def by_landmark(
    ids: UInt32[np.ndarray, " L"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
) -> tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, "M L 2"], Float[np.ndarray, "M L 3"]]:
    """The particles' landmarks by ascending id."""
    order = np.argsort(ids)
    sorted_means, sorted_covariances = np.empty_like(means), np.empty_like(covariances)
    for i in range(len(means)):
        for k in range(len(order)):
            for j in range(2):
                sorted_means[i, k, j] = means[i, order[k], j]
            for j in range(3):
                sorted_covariances[i, k, j] = covariances[i, order[k], j]
    return ids[order], sorted_means, sorted_covariances


@compiled
def by_slot(
    ids: UInt32[np.ndarray, " L"], seen: UInt32[np.ndarray, " N"]
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L+1"]]:
    """The measurements by the place of their landmark in the ascending `ids`, those of one in their
    order; and where those of each begin.
    """
    slots = np.searchsorted(ids, seen)
    bounds = np.zeros(len(ids) + 1, np.int64)
    for slot in slots:
        bounds[slot + 1] += 1
    for slot in range(len(ids)):
        bounds[slot + 1] += bounds[slot]
    behind, order = bounds[:-1].copy(), np.empty(len(slots), np.int64)
    for k in range(len(slots)):
        order[behind[slots[k]]] = k
        behind[slots[k]] += 1
    return order, bounds
