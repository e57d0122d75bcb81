"""Redraw a closed window's paths from the smoothed window, and weigh them.

Resampling leaves few lines of descent: after forty keyframes all particles may share one path
through the first thirty, whose error their scatter does not show. Once associated, the window is a
smoothing problem. M paths x are drawn from the Gaussian q of its solution, and weigh

    w ∝ p(x) Π_l ∫ p(z_l | x, l) dl / q(x),

with the integral over each landmark l by Laplace's method: importance sampling from the Laplace
approximation (Geweke 1989, Econometrica 57(6)).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.scans import Scans, points_of
from teamslam.team.estimation.association.smoothing import JITTER, SmoothedWindow, smooth_window
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import Window
from teamslam.team.estimation.models import POINT, Own, noise_of, variances
from teamslam.team.estimation.se2 import adjoint, between, inverse, wrapped
from teamslam.team.shapes import Float, Int64

Paths = Float[np.ndarray, "K M 3"]
FEW = 10.0
"""Effective number of lines of descent below which the scatter of paths does not estimate their
uncertainty (as `pipeline.DEPLETED` of particles).
"""


class _Measured(NamedTuple):
    """The measurements that the window has used: as points, and as ranges and bearings.

    slots: landmark of each. variances: (rr, rb, bb). own: claimed noises.
    """

    scans: Scans
    slots: Int64[np.ndarray, " N"]
    measurements: Float[np.ndarray, "N 2"]
    variances: Float[np.ndarray, "N 3"]
    own: Own


def redraw_paths(window: Window, keyframes: Sequence[core.Keyframe], random: core.Random) -> None:
    """Redraw the window's paths if few lines of descent are left and the new paths are more.

    A sample counts by its effective size 1/Σ w², the particles by w summed over those of one pose
    at the first keyframe. Draws 3 K M normal numbers, if any. keyframes: those whose measurements
    the window has used.
    """
    particles = window.particles
    weights = core.exp(particles.log_weights)
    if not len(particles.ids) or (left := _lines_of_descent(window, weights)) >= FEW:
        return
    measured = _measured(window, particles, keyframes)
    means = np.ascontiguousarray(particles.means).reshape(len(weights), -1)
    landmarks = dense.product(weights, means).reshape(-1, 2)
    try:
        now = smooth_window(measured.scans, measured.slots, window.core.mean_path(), landmarks)
        paths, log_weights = _drawn(now, measured.scans, len(weights), random)
        solved = _landmarks(window.sensor, particles, paths, measured)
    except (np.linalg.LinAlgError, core.NotFiniteError):
        return
    log_weights += _likelihood(paths, *solved, measured)
    if not np.isfinite(log_weights).all():
        return
    log_weights, _ = core.normalise(log_weights)
    if core.effective_sample_size(log_weights) <= left:
        return
    window.core.replace(paths, log_weights, *solved)


def _lines_of_descent(window: Window, weights: Float[np.ndarray, " M"]) -> float:
    _, ancestor = np.unique(window.paths[0], axis=0, return_inverse=True)
    shares: Float[np.ndarray, " n"] = np.bincount(ancestor.ravel(), weights)
    return 1.0 / float(dense.product(shares, shares))


def _measured(
    window: Window, particles: Particles, keyframes: Sequence[core.Keyframe]
) -> _Measured:
    of, ids, measurements, own = window.core.measurements()
    order = np.argsort(particles.ids)
    ranges, bearings = measurements.T
    noise = variances(ranges, own, window.sensor)
    points, covariances = points_of(ranges, bearings, noise)
    scans = Scans(
        motions=np.array([each.motion[0] for each in keyframes]),
        motion_covariances=np.array([each.motion[1] for each in keyframes]),
        keyframes=of,
        points=points,
        covariances=covariances,
        names=ids.astype(np.int64),
    )
    slots = order[np.searchsorted(particles.ids[order], ids)]
    return _Measured(scans, slots, measurements, noise, own)


def _drawn(
    now: SmoothedWindow, scans: Scans, count: int, random: core.Random
) -> tuple[Paths, Float[np.ndarray, " M"]]:
    """Draw paths from the smoothed window's Gaussian; return log p(path)/q(path) + constant."""
    k = len(now.poses)
    normals = random.normals(count, 3 * k)
    L = dense.cholesky(now.covariance[: 3 * k, : 3 * k])
    xi = dense.product(normals, L.T).reshape(count, k, 3).transpose(1, 0, 2)
    paths = _composed(now.poses, xi)
    before = np.concatenate((np.zeros((1, count, 3)), paths[:-1]))
    went = _seen(before, paths[..., :2] - before[..., :2])
    motions = np.broadcast_to(scans.motions[:, None], paths.shape)
    error = np.empty_like(paths)
    error[..., :2] = _seen(motions, went - motions[..., :2])
    error[..., 2] = wrapped(paths[..., 2] - before[..., 2] - motions[..., 2])
    squared = _squared(error, scans.motion_covariances + JITTER)
    of_draw = _row_sums(core.squared(normals))
    return paths, 0.5 * (of_draw - squared)


def _composed(poses: Float[np.ndarray, "K 3"], xi: Float[np.ndarray, "K M 3"]) -> Paths:
    """Compose paths with the errors ξ (forward, left, turn) of their poses from their motions.

    The error of motion k, ξ_k − Ad(motion⁻¹) ξ_{k−1} (determinant 1), is small even for far poses,
    whose own errors would bend the path.
    """
    paths = np.empty_like(xi)
    pose, last, at = np.zeros(3), np.zeros(xi.shape[1:]), np.zeros(xi.shape[1:])
    for k, after in enumerate(poses):
        motion = between(pose, after)
        error = xi[k] - dense.product(last, adjoint(inverse(motion)).T)
        at = _moved(_moved(at, np.broadcast_to(motion, at.shape)), error)
        paths[k], pose, last = at, after, xi[k]
    return paths


def _moved(
    poses: Float[np.ndarray, "M 3"], by: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "M 3"]:
    return np.column_stack((_placed(poses, by[:, :2]), poses[:, 2] + by[:, 2]))


def _placed(
    poses: Float[np.ndarray, "*n 3"], points: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n 2"]:
    s, c = core.sin_and_cos(poses[..., 2])
    x, y = points[..., 0], points[..., 1]
    return np.stack((poses[..., 0] + c * x - s * y, poses[..., 1] + s * x + c * y), axis=-1)


def _landmarks(
    sensor: Sensor, particles: Particles, paths: Paths, measured: _Measured
) -> tuple[Float[np.ndarray, "M L 2"], Float[np.ndarray, "M L 3"]]:
    scans, slots = measured.scans, measured.slots
    points = np.broadcast_to(scans.points[:, None], (len(slots), paths.shape[1], 2))
    starts = np.zeros((len(particles.ids), paths.shape[1], 2))
    np.add.at(starts, slots, _placed(paths[scans.keyframes], points))
    starts /= np.bincount(slots, minlength=len(starts))[:, None, None]
    return core.landmarks_along_paths(
        particles.ids,
        starts.transpose(1, 0, 2),
        particles.covariances,
        paths,
        scans.keyframes,
        particles.ids[slots],
        measured.measurements,
        measured.own,
        noise_of(sensor)._replace(range_white=1.0, bearing_white=1.0),
    )


def _likelihood(
    paths: Paths,
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    measured: _Measured,
) -> Float[np.ndarray, " M"]:
    """Compute log p(measurements | path) + constant, landmarks integrated out by Laplace's method.

    The noise of a POINT is Gaussian in the plane, that of others in range and bearing.
    """
    scans, own = measured.scans, measured.own
    at = paths[scans.keyframes]
    seen = _seen(at, means.transpose(1, 0, 2)[measured.slots] - at[..., :2])
    noise = measured.variances[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    ranges, bearings = measured.measurements.T[..., None]
    error = np.empty_like(seen)
    error[..., 0] = core.hypot(seen[..., 0], seen[..., 1]) - ranges
    error[..., 1] = wrapped(core.atan2(seen[..., 1], seen[..., 0]) - bearings)
    if own.size:
        plane = own[:, 3] == POINT
        error[plane] = (seen - scans.points[:, None])[plane]
        noise[plane] = scans.covariances[plane]
    xx, xy, yy = covariances.transpose(2, 0, 1)
    spread = _row_sums(core.log(np.maximum(xx * yy - xy * xy, 1e-300)))
    found: Float[np.ndarray, " M"] = 0.5 * (spread - _squared(error, noise))
    return found


def _seen(
    poses: Float[np.ndarray, "K M 3"], apart: Float[np.ndarray, "K M 2"]
) -> Float[np.ndarray, "K M 2"]:
    s, c = core.sin_and_cos(poses[..., 2])
    x, y = apart[..., 0], apart[..., 1]
    return np.stack((c * x + s * y, c * y - s * x), axis=-1)


def _squared(
    error: Float[np.ndarray, "n M k"], covariances: Float[np.ndarray, "n k k"]
) -> Float[np.ndarray, " M"]:
    weighted = dense.product(error, dense.inverse(covariances)) * error
    n, count, k = error.shape
    total = dense.product(np.ones(n), weighted.reshape(n, -1))
    return _row_sums(total.reshape(count, k))


def _row_sums(values: Float[np.ndarray, "M k"]) -> Float[np.ndarray, " M"]:
    """Sum rows in index order."""
    sums: Float[np.ndarray, " M"] = dense.product(values, np.ones(values.shape[1]))
    return sums
