"""The innovations of a window's measurements, and their normalised squares (NIS).

A filter's predictions are compared with its later measurements, so this consistency check needs no
ground truth. Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.config import Sensor
from team.estimation import dense, elementary, elementwise
from team.estimation.compiled import compiled
from team.estimation.gaussian import EPSILON, cholesky_factor, whitened
from team.estimation.geometry import compose, tangent, wrapped
from team.estimation.hybrid_slam.fastslam import Particles
from team.estimation.hybrid_slam.fastslam_kernel import semidefinite_factor, slots_of
from team.estimation.hybrid_slam.landmark_kernel import Triple, innovation_of, seen
from team.estimation.models import (
    Increment,
    landmark_jacobian,
    noise,
    pose_jacobian,
    predicted,
    variances,
)
from team.estimation.scans import Own, unclaimed


class Innovation(NamedTuple):
    """squared: Σ νᵀ S⁻¹ ν, χ² of `dof` degrees of freedom, two for each measurement that was
    predicted.

    Innovations of different keyframes are independent where the models are right, so both add up.
    """

    squared: float
    dof: int

    def plus(self, other: "Innovation") -> "Innovation":
        """The sum of both."""
        return Innovation(self.squared + other.squared, self.dof + other.dof)

    @property
    def per_dof(self) -> float | None:
        """About 1 where the models are right, larger where the noise is larger; None without
        measurements.
        """
        return self.squared / self.dof if self.dof else None


NOTHING = Innovation(0.0, 0)


def innovation(
    particles: Particles,
    increment: Increment,
    sensor: Sensor,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    own: Own | None = None,
) -> Innovation:
    """ν = z − ẑ of one keyframe's measurements in the metric of their joint predictive covariance
    S.

    The particles of the keyframe before predict the mixture Σ wᵢ N(ẑᵢ, Sᵢ) of all measurements of
    landmarks that they know; ẑ and S are its moments, bearings on the circle:

        ẑᵢ = h(poseᵢ ∘ mean, landmarks),  Sᵢ = Hₓ Q Hₓᵀ + Hₗ Σᵢ Hₗᵀ + R,
        S = Σ wᵢ (Sᵢ + dᵢ dᵢᵀ),  dᵢ = ẑᵢ − ẑ.

    It is the prediction before the measurements: FastSLAM 2.0 draws its particles from a proposal
    that has seen them, so after that step there is no innovation left to judge. A first sight has a
    flat prior and is left out. ranges [m] and bearings [rad] are accepted and corrected by the
    calibration, own are the noises that they claim. R is white, as in the particles' weights.
    Raises NotACovarianceError if S is not positive definite.
    """
    _, slots, _ = slots_of(particles.ids, ids)
    known = slots < len(particles.ids)
    if not known.any():
        return NOTHING
    error, S = _predictive(
        particles.poses,
        elementwise.exp(particles.log_weights),
        particles.means,
        particles.covariances,
        increment.mean,
        semidefinite_factor(increment.covariance),
        slots[known],
        np.column_stack((ranges, bearings))[known],
        variances(sensor),
        (unclaimed(len(ids)) if own is None else own)[known],
    )
    return _squared(error, S)


def joint_innovation(
    landmarks: UInt32[np.ndarray, " L"],
    mean: Float[np.ndarray, " N"],
    covariance: Float[np.ndarray, "N N"],
    increment: Increment,
    sensor: Sensor,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
) -> Innovation:
    """As `innovation`, of one Gaussian over the pose and the landmarks, such as that of an EKF.

        S = A P Aᵀ + Hₓ Q Hₓᵀ + R,  A = (Hₓ Gᵀ F, Hₗ),

    F = ∂(pose ∘ mean)/∂pose, and G = blkdiag(R(θ'), 1) turns the tangent of the predicted pose into
    (x, y, θ). mean: (x, y, θ) and the position of each of `landmarks`, N = 3 + 2 L.
    """
    _, at, _ = slots_of(landmarks, ids)
    known = at < len(landmarks)
    if not known.any():
        return NOTHING
    read, slots = np.unique(at[known], return_inverse=True)
    columns = np.concatenate((np.arange(3), (3 + 2 * read[:, None] + np.arange(2)).ravel()))
    places = mean[columns[3:]].reshape(-1, 2)
    pose = compose(mean[:3], increment.mean)
    dx, dy = pose[:2] - mean[:2]
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    to_own = dense.product(tangent(pose[2]).T, F)
    m = 2 * len(slots)
    error, A, H = np.empty(m), np.zeros((m, len(columns))), np.empty((m, 3))
    R = np.empty(m)
    measurements = np.column_stack((ranges, bearings))[known]
    for k, slot in enumerate(slots):
        rows = slice(2 * k, 2 * k + 2)
        distance, bearing = predicted(pose, places[slot])
        error[rows] = measurements[k, 0] - distance, wrapped(measurements[k, 1] - bearing)
        R[rows] = noise(sensor, distance)
        H[rows] = pose_jacobian(distance, bearing)
        A[rows, :3] = dense.product(H[rows], to_own)
        A[rows, 3 + 2 * slot : 5 + 2 * slot] = landmark_jacobian(distance, pose[2] + bearing)
    S = (
        dense.product(dense.product(A, covariance[np.ix_(columns, columns)]), A.T)
        + dense.product(dense.product(H, increment.covariance), H.T)
        + np.diag(R)
    )
    return _squared(error, S)


def _squared(error: Float[np.ndarray, " m"], S: Float[np.ndarray, "m m"]) -> Innovation:
    squared = _normalised_square(error, S)
    if not math.isfinite(squared):  # rank and finiteness are judged there
        white = whitened(cholesky_factor(S, "the prediction of measurements"), error)
        squared = float(dense.product(white, white))
    return Innovation(squared, len(error))


@compiled
def _normalised_square(error: Float[np.ndarray, " m"], S: Float[np.ndarray, "m m"]) -> float:
    """νᵀ S⁻¹ ν by the Cholesky factor of S; NaN where a pivot is not above rounding."""
    m = len(error)
    L, white = np.empty((m, m)), np.empty(m)
    total = 0.0
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
        total += white[j] * white[j]
    return total


@compiled
def _predictive(
    poses: Float[np.ndarray, "M 3"],
    weights: Float[np.ndarray, " M"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    motion: Float[np.ndarray, "3"],
    L: Float[np.ndarray, "3 3"],
    slots: Int64[np.ndarray, " n"],
    measurements: Float[np.ndarray, "n 2"],
    sensor: Triple,
    own: Float[np.ndarray, "n own"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """(z − ẑ, S) of n measurements as (range, bearing, range, …), m = 2n; L Lᵀ is the motion's Q.

    S = A Aᵀ + blocks: row j of A is √wᵢ (Hₓ L, dᵢ) of all particles, one behind the other.
    """
    count, m = len(poses), 2 * len(slots)
    # What was read less what each particle predicts lies near zero, where angles have a mean.
    errors = np.empty((m, count))
    A, of_landmark = np.empty((m, 4 * count)), np.empty((m, 2, count))
    S = np.zeros((m, m))
    for i in range(count):
        root = math.sqrt(weights[i])
        _predict(
            poses[i], motion, root, means[i], L, slots, measurements, errors[:, i],
            A[:, 4 * i : 4 * i + 3], of_landmark[:, :, i],
        )  # fmt: skip
        for k in range(len(slots)):
            r, b = 2 * k, 2 * k + 1
            distance = measurements[k, 0] - errors[r, i]
            of_range, of_bearing, rr, rb, bb = innovation_of(
                measurements[k], own[k], sensor, distance, errors[b, i]
            )
            if own.shape[1]:
                errors[r, i], errors[b, i] = of_range, of_bearing
            S[r, r] += weights[i] * rr
            S[b, b] += weights[i] * bb
            S[b, r] += weights[i] * rb
    mean = np.empty(m)
    for j in range(m):
        mean[j] = _centred(errors[j], weights, j % 2 == 1)
        A[j, 3::4] = np.sqrt(weights) * errors[j]
    for j in range(m):
        for k in range(j + 1):
            total = _inner(A[j], A[k])
            if slots[j // 2] == slots[k // 2]:
                for i in range(count):
                    xx, xy, yy = covariances[i, slots[j // 2]]
                    x, y = of_landmark[k, 0, i], of_landmark[k, 1, i]
                    along = of_landmark[j, 0, i] * (xx * x + xy * y)
                    total += weights[i] * (along + of_landmark[j, 1, i] * (xy * x + yy * y))
            S[j, k] += total
            S[k, j] = S[j, k]
    return mean, S


@compiled
def _inner(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> float:
    """Σ aᵢ bᵢ of a multiple of four terms, in four sums that do not wait for each other."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for i in range(0, len(a), 4):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
    total: float = (s0 + s1) + (s2 + s3)
    return total


@compiled
def _predict(
    start: Float[np.ndarray, "3"],
    motion: Float[np.ndarray, "3"],
    root: float,
    means: Float[np.ndarray, "L 2"],
    L: Float[np.ndarray, "3 3"],
    slots: Int64[np.ndarray, " n"],
    measurements: Float[np.ndarray, "n 2"],
    errors: Float[np.ndarray, " m"],
    of_motion: Float[np.ndarray, "m 3"],
    of_landmark: Float[np.ndarray, "m 2"],
) -> None:
    """One particle's z − ẑ at start ∘ motion, and the Jacobians Hₓ L √w and Hₗ of ẑ, all in place.

    root: √w of the particle's weight.
    """
    s, c = elementary.sin_and_cos(start[2])
    x = start[0] + c * motion[0] - s * motion[1]
    y = start[1] + s * motion[0] + c * motion[1]
    heading = start[2] + motion[2]
    s, c = elementary.sin_and_cos(heading)
    l00, l10, l11 = root * L[0, 0], root * L[1, 0], root * L[1, 1]
    l20, l21, l22 = root * L[2, 0], root * L[2, 1], root * L[2, 2]
    for k in range(len(slots)):
        r, b = 2 * k, 2 * k + 1
        distance, ex, ey = seen((x, y, heading), means[slots[k]])
        u, v = c * ex + s * ey, c * ey - s * ex
        errors[r] = measurements[k, 0] - distance
        errors[b] = wrapped(measurements[k, 1] - elementary.atan2(v, u))
        of_motion[r, 0] = -u * l00 - v * l10
        of_motion[r, 1] = -v * l11
        of_motion[r, 2] = 0.0
        of_motion[b, 0] = (v * l00 - u * l10) / distance - l20
        of_motion[b, 1] = -u * l11 / distance - l21
        of_motion[b, 2] = -l22
        of_landmark[r, 0], of_landmark[r, 1] = ex, ey
        of_landmark[b, 0], of_landmark[b, 1] = -ey / distance, ex / distance


@compiled
def _centred(
    values: Float[np.ndarray, " M"], weights: Float[np.ndarray, " M"], is_angle: bool
) -> float:
    """The weighted mean, of angles on the circle; the values become deviations from it."""
    mean, sine, cosine = 0.0, 0.0, 0.0
    for i in range(len(values)):
        if is_angle:
            s, c = elementary.sin_and_cos(values[i])
            sine += weights[i] * s
            cosine += weights[i] * c
        else:
            mean += weights[i] * values[i]
    if is_angle:
        mean = elementary.atan2(sine, cosine)
    for i in range(len(values)):
        values[i] -= mean
        if is_angle:
            values[i] = wrapped(values[i])
    return mean
