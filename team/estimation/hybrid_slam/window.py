"""One window of Hybrid-SLAM: particles that start at zero, and the one Gaussian they become.

The front end runs FastSLAM in the frame of the window's start. Its particles at any time are one
submap by moment matching, after each landmark of each particle is solved again over the window's
readings along that particle's path: an EKF is linearised at the first, noisiest reading, and that
bias is common to many submaps. Brooks and Bailey 2009, HybridSLAM.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.config import FrontEnd, Sensor
from team.estimation.compiled import compiled
from team.estimation.gaussian import NotACovarianceError, cholesky_factor
from team.estimation.geometry import wrapped
from team.estimation.hybrid_slam import fastslam
from team.estimation.hybrid_slam.fastslam import Particles
from team.estimation.hybrid_slam.innovation import NOTHING, Innovation, innovation
from team.estimation.hybrid_slam.sensitivity import Motion, Noise, columns
from team.estimation.models import NEAREST_M, Increment
from team.estimation.submap import NO_NODES, LocalMap

STILL = np.zeros(3)
POSE_JITTER = (1e-6, 1e-6, 1e-8)
"""Added to each pose's variances [m², m², rad²]: motion noise of rank 2 leaves P singular."""

POSE_DEGREES = 5.0
"""q + 2 of a pose's q = 3 numbers; see `sample_factor`."""
MOST_SQUARE = 0.1
"""Σ wᵢ² of ten particles of equal weight; see `sample_factor`."""

SOLVED = 1e-6
"""A Gauss-Newton step of squared Mahalanobis length below this changes nothing that matters."""


@dataclass(frozen=True)
class Window:
    """Particles since the window's start, their paths, and the readings that they have used.

    paths:    the pose of each particle's line of descent at each of the K observation epochs.
    epochs:   the epoch of each of the N readings, in [0, K).
    ids:      the landmark of each reading.
    readings: (range [m], bearing [rad]) with the sensor's calibration applied.
    node_stamps, node_epochs: team time [ns] of the pose nodes, and the epoch that each is.
    innovation: of all readings so far that were predicted.
    motions:  up to each epoch, and after the last one; kept where biases are asked for.
    """

    front_end: FrontEnd
    sensor: Sensor
    particles: Particles
    paths: Float[np.ndarray, "K M 3"]
    epochs: Int64[np.ndarray, " N"]
    ids: UInt32[np.ndarray, " N"]
    readings: Float[np.ndarray, "N 2"]
    node_stamps: Int64[np.ndarray, " nodes"]
    node_epochs: Int64[np.ndarray, " nodes"]
    innovation: Innovation = NOTHING
    motions: tuple[Motion, ...] = ()


def opened(front_end: FrontEnd, sensor: Sensor) -> Window:
    """A window at its start: every particle exactly at zero, no landmark, no reading."""
    return Window(
        front_end,
        sensor,
        fastslam.at_poses(np.zeros((front_end.particles, 3))),
        np.empty((0, front_end.particles, 3)),
        np.empty(0, np.int64),
        np.empty(0, np.uint32),
        np.empty((0, 2)),
        NO_NODES,
        NO_NODES,
    )


def advanced(
    window: Window,
    increment: Increment,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    generator: np.random.Generator,
    forward: Float[np.ndarray, "3"] = STILL,
) -> Window:
    """One observation epoch: the motion since the last one, then its readings (there may be none).

    The readings are accepted and corrected already (`models.acceptable`, `models.corrected`).
    forward: the motion's shift by an error of the scale of speed (`sensitivity.forward_column`).
    """
    expected = NOTHING
    with suppress(NotACovarianceError):  # then it is not known how well they were predicted
        expected = innovation(window.particles, increment, window.sensor, ids, ranges, bearings)
    particles, info = fastslam.propagated_and_updated(
        window.particles,
        increment,
        window.sensor,
        ids,
        ranges,
        bearings,
        window.front_end.proposal,
        window.front_end.resample_below,
        generator,
    )
    paths = window.paths if info.parents is None else window.paths[:, info.parents]
    epoch = np.full(len(ids), len(paths))
    return replace(
        window,
        particles=particles,
        paths=np.concatenate((paths, particles.poses[None])),
        epochs=np.concatenate((window.epochs, epoch)),
        ids=np.concatenate((window.ids, ids)),
        readings=np.concatenate((window.readings, np.column_stack((ranges, bearings)))),
        innovation=window.innovation.plus(expected),
        motions=_with_motion(window, increment, forward),
    )


def _with_motion(
    window: Window, increment: Increment, forward: Float[np.ndarray, "3"]
) -> tuple[Motion, ...]:
    if not window.front_end.biases:
        return ()
    return (*window.motions, Motion(increment.covariance, forward))


def marked(window: Window, stamp_ns: int) -> Window:
    """The particles' poses of the last epoch become a pose node at this team time."""
    return replace(
        window,
        node_stamps=np.append(window.node_stamps, stamp_ns),
        node_epochs=np.append(window.node_epochs, len(window.paths) - 1),
    )


def moved(
    window: Window,
    increment: Increment,
    generator: np.random.Generator,
    forward: Float[np.ndarray, "3"] = STILL,
) -> Window:
    """Motion without an observation epoch, as from the last one to the window's end.

    It never resamples: the weights of the last readings stay as they are.
    """
    particles = fastslam.propagated(window.particles, increment, generator)
    return replace(window, particles=particles, motions=_with_motion(window, increment, forward))


def gaussian(window: Window, *, running: bool = False) -> LocalMap:
    """The window so far as one Gaussian over (end pose, pose nodes, landmarks by ascending id).

    With w and (poses, landmarks) of each particle, μ = Σ wᵢ μᵢ and P = Σ wᵢ (Pᵢ + dᵢ dᵢᵀ), where
    Pᵢ = blkdiag(0, Σ₁, …, Σ_L), dᵢ = μᵢ − μ, headings on the circle (Xu, eq. 4.5-4.6), plus
    POSE_JITTER. The landmarks given a path come from `landmarks_along_paths`, the derivatives by
    the biases from `sensitivity.columns`.
    running: for a pose within the window, which is not fused. Where all of the sensor's errors are
    white the landmarks are then those that the particles hold: to solve them again at every epoch
    moves that pose by a hundredth and costs a third of all. Of a landmark's constant error the
    particles know nothing.
    Raises NotACovarianceError if P is not finite or not positive definite.
    """
    particles = window.particles
    order = np.argsort(particles.ids)
    ids = particles.ids[order]
    slots = np.searchsorted(ids, window.ids)
    by_slot = np.argsort(slots, kind="stable")
    noise = Noise(
        window.sensor.range_sigma**2,
        window.sensor.range_sigma_per_m**2,
        window.sensor.range_white,
        window.sensor.bearing_sigma**2,
        window.sensor.bearing_white,
    )
    means, covariances = particles.means[:, order], particles.covariances[:, order]
    white = window.sensor.range_white == window.sensor.bearing_white == 1.0
    if not (running and white):
        means, covariances = landmarks_along_paths(
            means,
            covariances,
            window.paths,
            np.searchsorted(slots[by_slot], np.arange(len(ids) + 1)),
            window.epochs[by_slot],
            window.readings[by_slot],
            noise,
        )
    poses = np.concatenate((particles.poses, *window.paths[window.node_epochs]), axis=1)
    weights = np.exp(particles.log_weights)
    mean, covariance = moments(poses, weights, means, covariances, sample_factor(weights))
    numbers = np.arange(poses.shape[1])
    covariance[numbers, numbers] += np.tile(POSE_JITTER, len(numbers) // 3)
    cholesky_factor(covariance, "the submap of a window")
    local = LocalMap(ids, mean, covariance, window.node_stamps)
    return _with_sensitivity(window, local, slots, noise) if window.front_end.biases else local


def _with_sensitivity(
    window: Window, local: LocalMap, slots: Int64[np.ndarray, " N"], noise: Noise
) -> LocalMap:
    """The Gaussian with its derivatives by the biases.

    That by `forward_scale` is left out where all of the window's motion is calibrated.
    """
    uncalibrated = any(motion.forward.any() for motion in window.motions)
    biases = tuple(b for b in window.front_end.biases if b != "forward_scale" or uncalibrated)
    weights = np.exp(window.particles.log_weights)
    path = np.array([*(_mean_pose(poses, weights) for poses in window.paths), local.end_pose])
    path = path[: len(window.motions)]
    poses, landmarks = columns(
        biases, path, window.motions, local.landmarks, (window.epochs, slots), noise
    )
    end = poses[:, -1:] if len(path) else np.zeros((len(biases), 1, 3))
    kept = np.concatenate((end, poses[:, window.node_epochs]), axis=1)
    rows = (kept.reshape(len(biases), -1), landmarks.reshape(len(biases), -1))
    return replace(local, biases=biases, sensitivity=np.concatenate(rows, axis=1))


def _mean_pose(
    poses: Float[np.ndarray, "M 3"], weights: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "3"]:
    return np.array([*(weights @ poses[:, :2]), _mean_direction(poses[:, 2], weights)])


@compiled
def landmarks_along_paths(
    starts: Float[np.ndarray, "M L 2"],
    start_covariances: Float[np.ndarray, "M L 3"],
    paths: Float[np.ndarray, "K M 3"],
    bounds: Int64[np.ndarray, " L+1"],
    epochs: Int64[np.ndarray, " N"],
    readings: Float[np.ndarray, "N 2"],
    noise: Noise,
) -> tuple[Float[np.ndarray, "M L 2"], Float[np.ndarray, "M L 3"]]:
    """Each landmark of each particle by Gauss-Newton over its readings, given the particle's path.

    Minimises Σ ‖z − h(path, landmark) − b‖² in R⁻¹ plus ‖b‖² in B⁻¹ from the EKF's mean with at
    most three steps, each kept only if the cost falls. R is the white part of the noise, of the
    range predicted at the start; b ~ N(0, B) is the landmark's constant error, B the rest of the
    variances (of the last reading's range), eliminated by Schur's complement: with D = Σ R⁻¹ + B⁻¹
    and C = Σ Hᵀ R⁻¹ the covariance is (Σ Hᵀ R⁻¹ H − C D⁻¹ Cᵀ)⁻¹ at the result, (xx, xy, yy).
    Readings bounds[l] to bounds[l + 1] belong to landmark l. Where no evaluation is finite the
    EKF's mean and covariance stay.
    """
    means, covariances = starts.copy(), start_covariances.copy()
    range_information = np.empty(len(readings))
    for i in range(means.shape[0]):
        for landmark in range(means.shape[1]):
            x, y = starts[i, landmark]
            least = np.inf
            for iteration in range(4):
                cost, gx, gy, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                rx, ry, bx, by = 0.0, 0.0, 0.0, 0.0
                range_sum, bearing_sum, range_weight, bearing_weight = 0.0, 0.0, 0.0, 0.0
                total = 0.0
                for k in range(bounds[landmark], bounds[landmark + 1]):
                    pose = paths[epochs[k], i]
                    dx, dy = x - pose[0], y - pose[1]
                    distance = max(math.sqrt(dx * dx + dy * dy), NEAREST_M)
                    total = noise.range_variance + noise.range_per_m2 * distance * distance
                    if iteration == 0:
                        range_information[k] = 1.0 / (noise.range_white * total)
                    ex, ey = dx / distance, dy / distance
                    of_range = readings[k, 0] - distance
                    of_bearing = wrapped(readings[k, 1] + pose[2] - math.atan2(dy, dx))
                    wr = range_information[k]
                    wb = 1.0 / (noise.bearing_white * noise.bearing_variance)
                    cost += wr * of_range * of_range + wb * of_bearing * of_bearing
                    wr_r, wb_b = wr * of_range, wb * of_bearing / distance
                    gx += wr_r * ex - wb_b * ey
                    gy += wr_r * ey + wb_b * ex
                    wt = wb / (distance * distance)
                    xx += wr * ex * ex + wt * ey * ey
                    xy += (wr - wt) * ex * ey
                    yy += wr * ey * ey + wt * ex * ex
                    rx, ry = rx + wr * ex, ry + wr * ey
                    bx, by = bx - wb * ey / distance, by + wb * ex / distance
                    range_sum, range_weight = range_sum + wr_r, range_weight + wr
                    bearing_sum, bearing_weight = bearing_sum + wb * of_bearing, bearing_weight + wb
                if noise.range_white < 1.0:
                    share = 1.0 / (range_weight + 1.0 / ((1.0 - noise.range_white) * total))
                    cost -= share * range_sum * range_sum
                    gx, gy = gx - share * range_sum * rx, gy - share * range_sum * ry
                    xx, xy, yy = xx - share * rx * rx, xy - share * rx * ry, yy - share * ry * ry
                if noise.bearing_white < 1.0:
                    constant = (1.0 - noise.bearing_white) * noise.bearing_variance
                    share = 1.0 / (bearing_weight + 1.0 / constant)
                    cost -= share * bearing_sum * bearing_sum
                    gx, gy = gx - share * bearing_sum * bx, gy - share * bearing_sum * by
                    xx, xy, yy = xx - share * bx * bx, xy - share * bx * by, yy - share * by * by
                determinant = xx * yy - xy * xy
                if not (cost < least and determinant > 0.0):
                    break
                least = cost
                step_x, step_y = (
                    (yy * gx - xy * gy) / determinant,
                    (xx * gy - xy * gx) / determinant,
                )
                means[i, landmark, 0], means[i, landmark, 1] = x, y
                covariances[i, landmark, 0] = yy / determinant
                covariances[i, landmark, 1] = -xy / determinant
                covariances[i, landmark, 2] = xx / determinant
                if step_x * gx + step_y * gy < SOLVED:
                    break
                x, y = x + step_x, y + step_y
    return means, covariances


@compiled
def _mean_direction(angles: Float[np.ndarray, " M"], weights: Float[np.ndarray, " M"]) -> float:
    """The direction of Σ wᵢ (cos aᵢ, sin aᵢ)."""
    sine, cosine = 0.0, 0.0
    for i in range(len(angles)):
        sine += weights[i] * math.sin(angles[i])
        cosine += weights[i] * math.cos(angles[i])
    return math.atan2(sine, cosine)


def sample_factor(weights: Float[np.ndarray, " M"]) -> float:
    """What the scatter of particles is to be taken times for its inverse to be right on average.

    N = 1/Σ wᵢ² particles estimate their own mean, and the inverse of the covariance of such a
    sample of q-dimensional normals is too large by ν/(ν − q − 1), ν = N − 1 (Anderson 2003, section
    7.7): the factor is N/(N − q − 2), with the q = 3 numbers of a pose, the directions in which no
    particle has a covariance of its own. Fewer than ten particles are taken for ten.
    """
    return 1.0 / (1.0 - POSE_DEGREES * min(float(np.sum(weights * weights)), MOST_SQUARE))


@compiled
def moments(
    poses: Float[np.ndarray, "M p"],
    weights: Float[np.ndarray, " M"],
    means: Float[np.ndarray, "M L 2"],
    covariances: Float[np.ndarray, "M L 3"],
    between: float = 1.0,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Mean and covariance of the mixture Σ wᵢ N(μᵢ, blkdiag(0, Σ₁, …, Σ_L)), n = p + 2L.

    Each particle has p/3 poses (x, y, theta), one behind the other. The scatter between the
    particles is taken times `between`: 1 for the mixture itself, see `sample_factor`.
    """
    count, p = poses.shape
    n = p + 2 * means.shape[1]
    deviations = np.empty((count, n))
    deviations[:, :p] = poses
    deviations[:, p::2] = means[:, :, 0]
    deviations[:, p + 1 :: 2] = means[:, :, 1]
    mean = np.zeros(n)
    for i in range(count):
        for j in range(n):
            mean[j] += weights[i] * deviations[i, j]
    for heading in range(2, p, 3):
        mean[heading] = _mean_direction(poses[:, heading], weights)
    P = np.zeros((n, n))
    for i in range(count):
        for j in range(n):
            deviations[i, j] -= mean[j]
        for heading in range(2, p, 3):
            deviations[i, heading] = wrapped(deviations[i, heading])
        for j in range(n):
            scaled = between * weights[i] * deviations[i, j]
            for k in range(j + 1):
                P[j, k] += scaled * deviations[i, k]
        for landmark in range(means.shape[1]):
            j = p + 2 * landmark
            P[j, j] += weights[i] * covariances[i, landmark, 0]
            P[j + 1, j] += weights[i] * covariances[i, landmark, 1]
            P[j + 1, j + 1] += weights[i] * covariances[i, landmark, 2]
    for j in range(n):
        for k in range(j):
            P[k, j] = P[j, k]
    return mean, P
