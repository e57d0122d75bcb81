"""One window of Hybrid-SLAM: particles that start at zero, and the one Gaussian they become.

The front end runs FastSLAM in the frame of the window's start. Its particles at any time are one
submap by moment matching, after each landmark of each particle is solved again over the window's
measurements along that particle's path: an EKF is linearised at the first, noisiest measurement,
and that bias is common to many submaps. Brooks and Bailey 2009, HybridSLAM.
"""

import dataclasses
import math
from contextlib import suppress
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.config import Bias, FrontEnd, Sensor
from team.estimation import dense, elementary, elementwise
from team.estimation.gaussian import FAULTS, NotACovarianceError
from team.estimation.geometry import inverse, tangent
from team.estimation.hybrid_slam import fastslam
from team.estimation.hybrid_slam.fastslam import Particles, particles_of
from team.estimation.hybrid_slam.innovation import NOTHING, Innovation, innovation
from team.estimation.hybrid_slam.landmarks_along_paths import landmarks_of_window
from team.estimation.hybrid_slam.moments import (
    POSE_JITTER,
    submap_moments,
)
from team.estimation.hybrid_slam.sensitivity import (
    NO_MOTIONS,
    WindowMotions,
    WindowSights,
    columns,
    rows,
)
from team.estimation.hybrid_slam.sensitivity_kernel import Noise
from team.estimation.hybrid_slam.window_kernel import NO_RESAMPLING, advanced_by
from team.estimation.models import Increment, variances
from team.estimation.mount import base_covariances, base_points, base_poses, base_shifts
from team.estimation.scans import Own, unclaimed
from team.estimation.submap import NO_NODES, LocalMap

STILL = np.zeros(3)


class Window(msgspec.Struct, frozen=True, gc=False):
    """Particles since the window's start, their paths, and the measurements that they have used.

    paths:    the pose of each particle's line of descent at each of the K keyframes.
    keyframes:   the keyframe of each of the N measurements, in [0, K).
    ids:      the landmark of each measurement.
    measurements: (range [m], bearing [rad]) with the sensor's calibration applied; own: the noises
              that they claim (`team.estimation.scans`).
    Poses are the sensor's, in the frame of the window's start of the sensor.
    node_stamps, node_keyframes: team time [ns] of the pose nodes, and the keyframe that each is.
    innovation: of all measurements so far that were predicted.
    effective: number of effective particles after the last keyframe.
    motions:  up to each keyframe, and after the last one; kept where biases are asked for.
    """

    front_end: FrontEnd
    sensor: Sensor
    particles: Particles
    paths: Float[np.ndarray, "K M 3"]
    keyframes: Int64[np.ndarray, " N"]
    ids: UInt32[np.ndarray, " N"]
    measurements: Float[np.ndarray, "N 2"]
    node_stamps: Int64[np.ndarray, " nodes"]
    node_keyframes: Int64[np.ndarray, " nodes"]
    own: Own
    effective: float
    innovation: Innovation = NOTHING
    motions: WindowMotions = NO_MOTIONS


class ParticleLandmarks(NamedTuple):
    """The landmarks of each of M particles [m, m²]; covariances as (xx, xy, yy)."""

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "M L 2"]
    covariances: Float[np.ndarray, "M L 3"]


def noise_of(sensor: Sensor) -> Noise:
    """The variances of a sensor and their white shares, as the kernels take them."""
    return Noise(
        elementary.squared(sensor.range_sigma),
        elementary.squared(sensor.range_sigma_per_m),
        sensor.range_white,
        elementary.squared(sensor.bearing_sigma),
        sensor.bearing_white,
    )


def opened(front_end: FrontEnd, sensor: Sensor) -> Window:
    """Open a window: every particle exactly at zero, without landmarks or measurements."""
    particles = fastslam.at_poses(np.zeros((front_end.particles, 3)))
    return Window(
        front_end=front_end,
        sensor=sensor,
        particles=particles,
        effective=fastslam.effective_sample_size(particles.log_weights),
        paths=np.empty((0, front_end.particles, 3)),
        keyframes=np.empty(0, np.int64),
        ids=np.empty(0, np.uint32),
        measurements=np.empty((0, 2)),
        node_stamps=NO_NODES,
        node_keyframes=NO_NODES,
        own=unclaimed(0),
    )


def advanced(
    window: Window,
    increment: Increment,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    generator: np.random.Generator,
    forward: Float[np.ndarray, "3"] = STILL,
    *,
    own: Own | None = None,
) -> Window:
    """One keyframe: the motion since the last one, then its measurements (there may be
    none).

    The measurements are accepted and corrected already (`models.scanned`).
    forward: the motion's shift by an error of the scale of speed (`odometry.forward_column`).
    own: the noises that the measurements claim (`team.estimation.scans`).
    """
    noises = unclaimed(len(ids)) if own is None else own
    front, particles = window.front_end, window.particles
    count = len(particles.poses)
    is_thin = window.effective < front.resample_below * count
    uniform = generator.random() if is_thin else NO_RESAMPLING
    after, paths, record, effective, squared, dof = advanced_by(
        particles.arrays,
        window.paths,
        (window.keyframes, window.ids, window.measurements, window.own),
        (increment.mean, increment.covariance),
        (ids, ranges, bearings, noises),
        (uniform, generator.standard_normal((count, 3))),
        (variances(window.sensor), front.proposal == "fastslam2"),
    )
    moved = particles_of(after)
    expected = Innovation(squared, dof)
    if not math.isfinite(squared):
        expected = NOTHING
        with suppress(NotACovarianceError):  # then it is not known how well they were predicted
            expected = innovation(
                particles, increment, window.sensor, ids, ranges, bearings, noises
            )
    keyframes, ids, measurements, owns = record
    return msgspec.structs.replace(
        window,
        particles=moved,
        paths=paths,
        keyframes=keyframes,
        ids=ids,
        measurements=measurements,
        own=owns,
        innovation=window.innovation.plus(expected),
        effective=effective,
        motions=_with_motion(window, increment, forward),
    )


def _with_motion(
    window: Window, increment: Increment, forward: Float[np.ndarray, "3"]
) -> WindowMotions:
    if not window.front_end.biases:
        return NO_MOTIONS
    return window.motions.then(increment.covariance, forward)


def marked(window: Window, stamp_ns: int) -> Window:
    """Make the particles' poses at the last keyframe a pose node at this team time."""
    return msgspec.structs.replace(
        window,
        node_stamps=np.append(window.node_stamps, stamp_ns),
        node_keyframes=np.append(window.node_keyframes, len(window.paths) - 1),
    )


def moved(
    window: Window,
    increment: Increment,
    generator: np.random.Generator,
    forward: Float[np.ndarray, "3"] = STILL,
) -> Window:
    """Move the particles without a keyframe, as from the last one to the window's end.

    It never resamples: the weights of the last measurements stay as they are.
    """
    particles = fastslam.propagated(window.particles, increment, generator)
    return msgspec.structs.replace(
        window, particles=particles, motions=_with_motion(window, increment, forward)
    )


def gaussian(window: Window, *, running: bool = False) -> LocalMap:
    """Make one Gaussian of the window so far: `landmarks_solved_again`, then `moments_matched`.

    running: for a pose within the window, which is not fused: without pose nodes.
    Raises NotACovarianceError if P is not finite or not positive definite.
    """
    landmarks = landmarks_solved_again(window, running=running)
    return moments_matched(window, landmarks, with_nodes=not running)


def landmarks_solved_again(window: Window, *, running: bool = False) -> ParticleLandmarks:
    """Solve each landmark of each particle over all the window's measurements, given the path.

    An EKF is linearised at the first, noisiest measurement, and that bias is common to many
    submaps: `landmarks_along_paths` starts from it. running: for a pose within the window, which is
    not fused; where all of the sensor's errors are white, the landmarks are then those that the
    particles hold, since solving them at every keyframe moves that pose by a
    hundredth and costs a third of the time. The particles do not model a landmark's constant error.
    """
    particles = window.particles
    # One layout, whatever the indexing left: each would be a form of the kernel of its own.
    estimates = (
        particles.ids,
        np.ascontiguousarray(particles.means),
        np.ascontiguousarray(particles.covariances),
    )
    if running and window.sensor.range_white == window.sensor.bearing_white == 1.0:
        return ParticleLandmarks(*estimates)
    found = landmarks_of_window(
        *estimates,
        np.ascontiguousarray(window.paths),
        window.ids,
        window.keyframes,
        window.measurements,
        own=window.own,
        noise=noise_of(window.sensor),
    )
    return ParticleLandmarks(*found)


def moments_matched(
    window: Window, landmarks: ParticleLandmarks, *, with_nodes: bool = True
) -> LocalMap:
    """One Gaussian over (end pose, pose nodes, landmarks by ascending id).

    With w and (poses, landmarks) of each particle, μ = Σ wᵢ μᵢ and P = Σ wᵢ (Pᵢ + dᵢ dᵢᵀ), where
    Pᵢ = blkdiag(0, Σ₁, …, Σ_L), dᵢ = μᵢ − μ (Xu, eq. 4.5-4.6), the means and deviations of poses on
    SE(2) (`moments.on_group`), plus POSE_JITTER. Poses and landmarks are those of the base, in the
    frame of its start. The derivatives by the biases come from `sensitivity.columns`.
    Raises NotACovarianceError if P is not finite or not positive definite.
    """
    ids, means, covariances = landmarks
    particles = window.particles
    nodes = window.node_keyframes if with_nodes else NO_NODES
    of_nodes = window.paths[nodes] if len(nodes) else window.paths[:0]
    if window.sensor.is_mounted:
        mount = np.array(window.sensor.mount)
        means, covariances = base_points(means, mount), base_covariances(covariances, mount)
        particles = dataclasses.replace(particles, poses=base_poses(particles.poses, mount))
        of_nodes = base_poses(of_nodes, mount)
    poses = np.ascontiguousarray(particles.poses)
    if len(nodes):
        poses = np.concatenate((poses, *of_nodes), axis=1)
    ids, mean, covariance, fault = submap_moments(
        poses,
        particles.log_weights,
        ids,
        np.ascontiguousarray(means),
        np.ascontiguousarray(covariances),
    )
    if fault:
        raise NotACovarianceError("the submap of a window", FAULTS[fault])
    stamps = window.node_stamps[: len(nodes)]
    if not window.front_end.biases:
        return LocalMap(ids, mean, covariance, stamps)
    weights = elementwise.exp(particles.log_weights)
    biases, sensitivity = _sensitivity(window, weights, (ids, mean), nodes)
    return LocalMap(ids, mean, covariance, stamps, biases, sensitivity)


def of_base(window: Window) -> Window:
    """The window's particles and paths as those of the base, in the frame of the base's start
    pose.
    """
    if not window.sensor.is_mounted:
        return window
    mount, particles = np.array(window.sensor.mount), window.particles
    based = dataclasses.replace(
        particles,
        poses=base_poses(particles.poses, mount),
        means=base_points(particles.means, mount),
        covariances=base_covariances(particles.covariances, mount),
    )
    return msgspec.structs.replace(window, particles=based, paths=base_poses(window.paths, mount))


def motion_alone(motion: Increment) -> LocalMap:
    """The Gaussian of a window's odometry alone, in the window's frame."""
    G = tangent(motion.mean[2])
    covariance = dense.product(dense.product(G, motion.covariance), G.T) + np.diag(POSE_JITTER)
    return LocalMap(np.empty(0, np.uint32), motion.mean, 0.5 * (covariance + covariance.T))


def _sensitivity(
    window: Window,
    weights: Float[np.ndarray, " M"],
    submap: tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, " n"]],
    nodes: Int64[np.ndarray, " nodes"],
) -> tuple[tuple[Bias, ...], Float[np.ndarray, "b n"]]:
    """The biases, and the derivatives of a submap's mean by them; submap: its ids and its mean.

    That by `forward_scale` is left out where all of the window's motion is calibrated.
    """
    uncalibrated = bool(window.motions.shifts.any())
    biases = tuple(b for b in window.front_end.biases if b != "forward_scale" or uncalibrated)
    mount, is_mounted = np.array(window.sensor.mount), window.sensor.is_mounted
    ids, mean = submap
    end, points = mean[:3], mean[3 + 3 * len(nodes) :].reshape(-1, 2)
    if is_mounted:
        away = inverse(mount)
        end, points = base_poses(end[None], away)[0], base_points(points, away)
    path, poses, landmarks = columns(
        (window.paths, weights),
        end,
        window.motions,
        (ids, points),
        WindowSights(window.keyframes, window.ids, window.own),
        noise_of(window.sensor),
    )
    if is_mounted:
        poses = base_shifts(poses, path, mount)
        landmarks = base_points(landmarks, np.array([0.0, 0.0, mount[2]]))
    return biases, rows(biases, poses, landmarks, nodes)
