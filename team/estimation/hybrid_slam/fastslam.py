"""FastSLAM with known data association: particles over paths, an EKF for each landmark of each.

p(path, landmarks | z) = p(path | z) Π p(landmark | path, z): the first factor is the weighted
particles, the second the landmarks' 2 × 2 Gaussians. Montemerlo 2003; Thrun et al. 2005, ch. 13.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.config import Sensor
from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.gaussian import NotACovarianceError
from team.estimation.hybrid_slam.blocks import measured
from team.estimation.hybrid_slam.fastslam_kernel import semidefinite_factor, slots_of, step
from team.estimation.models import Increment, variances
from team.estimation.scans import Own, unclaimed

Proposal = Literal["fastslam2", "fastslam1"]
Arrays = tuple[
    Float[np.ndarray, "M 3"],
    Float[np.ndarray, " M"],
    UInt32[np.ndarray, " L"],
    Float[np.ndarray, "M L 2"],
    Float[np.ndarray, "M L 3"],
]
"""The fields of `Particles`, in their order."""
Seen = tuple[UInt32[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"], Own]
"""Ids, ranges [m], bearings [rad] and claimed noises of measurements."""


@dataclass(frozen=True)
class Particles:
    """M weighted poses, each with its own estimate of the L landmarks seen so far.

    poses:       (x [m], y [m], theta [rad]) in the frame of the window's start.
    log_weights: normalised, Σ exp = 1.
    ids:         the landmarks in order of first sight; means and covariances follow it.
    means:       landmark positions [m].
    covariances: (xx, xy, yy) of each landmark given the particle's path [m²].
    """

    poses: Float[np.ndarray, "M 3"]
    log_weights: Float[np.ndarray, " M"]
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "M L 2"]
    covariances: Float[np.ndarray, "M L 3"]

    @property
    def arrays(self) -> Arrays:
        """The fields, as kernels take them."""
        return self.poses, self.log_weights, self.ids, self.means, self.covariances


class StepInfo(msgspec.Struct, frozen=True, gc=False):
    """Statistics of one step.

    effective_sample_size: 1/Σ w² after the step, in [1, M].
    parents: the particle that each particle was copied from before the step, or None.
    log_evidence: log p(z | earlier z) by the particles; 0 without a re-observation.
    """

    effective_sample_size: float
    parents: Int64[np.ndarray, " M"] | None
    log_evidence: float


def at_poses(poses: Float[np.ndarray, "M 3"]) -> Particles:
    """Equal particles at these poses that know no landmark."""
    count = len(poses)
    return Particles(
        poses=poses,
        log_weights=np.full(count, -elementary.log(count)),
        ids=np.empty(0, np.uint32),
        means=np.empty((count, 0, 2)),
        covariances=np.empty((count, 0, 3)),
    )


@compiled
def effective_sample_size(log_weights: Float[np.ndarray, " M"]) -> float:
    """1/Σ w² of normalised log weights."""
    total = 0.0
    for log_weight in log_weights:
        total += elementary.exp(2.0 * log_weight)
    return 1.0 / total


@compiled
def normalised(log_weights: Float[np.ndarray, " M"]) -> tuple[Float[np.ndarray, " M"], float]:
    """(log w − log Σ w, log Σ w), with the largest weight factored out of the sum."""
    largest = log_weights.max()
    total = 0.0
    for log_weight in log_weights:
        total += elementary.exp(log_weight - largest)
    log_sum = largest + elementary.log(total)
    return log_weights - log_sum, log_sum


@compiled
def systematic_parents(
    log_weights: Float[np.ndarray, " M"], uniform: float
) -> Int64[np.ndarray, " M"]:
    """Systematic resampling: particle i is copied ⌊M w_i⌋ or ⌈M w_i⌉ times, M w_i on average.

    The M points (k + uniform)/M fall into the intervals of the cumulated weights; 0 ≤ uniform < 1.
    Kitagawa 1996; Thrun et al. 2005, table 4.4.
    """
    count = len(log_weights)
    parents = np.empty(count, np.int64)
    parent = 0
    cumulated = elementary.exp(log_weights[0])
    for k in range(count):
        while (k + uniform) / count >= cumulated and parent < count - 1:
            parent += 1
            cumulated += elementary.exp(log_weights[parent])
        parents[k] = parent
    return parents


@compiled
def copies_of(particles: Arrays, parents: Int64[np.ndarray, " M"]) -> Arrays:
    """The fields of equal particles, each a copy of its parent."""
    start, log_weights, ids, means, covariances = particles
    poses, equal = np.empty_like(start), np.empty_like(log_weights)
    placed, spread = np.empty_like(means), np.empty_like(covariances)
    of_each = -elementary.log(float(len(parents)))
    for i in range(len(parents)):
        parent, equal[i] = parents[i], of_each
        for j in range(3):
            poses[i, j] = start[parent, j]
        for k in range(means.shape[1]):
            placed[i, k, 0], placed[i, k, 1] = means[parent, k, 0], means[parent, k, 1]
            for j in range(3):
                spread[i, k, j] = covariances[parent, k, j]
    return poses, equal, ids, placed, spread


def resampled(
    particles: Particles, generator: np.random.Generator
) -> tuple[Particles, Int64[np.ndarray, " M"]]:
    """Equal weights again, each particle a copy of its parent; draws one uniform number."""
    parents = systematic_parents(particles.log_weights, generator.random())
    return Particles(*copies_of(particles.arrays, parents)), parents


def propagated_and_updated(
    particles: Particles,
    increment: Increment,
    sensor: Sensor,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    proposal: Proposal,
    resample_below: float,
    generator: np.random.Generator,
    own: Own | None = None,
) -> tuple[Particles, StepInfo]:
    """One step: resamples if the particles are thin, moves, then takes the measurements (`step`).

    Resampling comes first, when the effective sample size of the last step is below
    `resample_below`·M, so that the particles of a window's last step keep their weights. ranges [m]
    and bearings [rad] are corrected by the calibration, own are the measurements' own covariances
    (`team.estimation.scans`); an id may occur twice. Draws one uniform number if it resamples, and
    M × 3 normal ones.
    Raises NotACovarianceError if the motion's covariance is not positive semi-definite.
    """
    parents = None
    if effective_sample_size(particles.log_weights) < resample_below * len(particles.poses):
        particles, parents = resampled(particles, generator)
    moved, log_evidence = filter_step(
        particles, increment, sensor, ids, ranges, bearings, proposal, generator, own=own
    )
    return moved, StepInfo(effective_sample_size(moved.log_weights), parents, log_evidence)


def filter_step(
    particles: Particles,
    increment: Increment,
    sensor: Sensor,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    proposal: Proposal,
    generator: np.random.Generator,
    *,
    own: Own | None = None,
) -> tuple[Particles, float]:
    """As `propagated_and_updated` without resampling; returns also the log evidence."""
    noises = unclaimed(len(ids)) if own is None else own
    moved, log_evidence = particles_after(
        particles.arrays,
        (increment.mean, increment.covariance),
        generator.standard_normal((len(particles.poses), 3)),
        (ids, ranges, bearings, noises),
        variances(sensor),
        proposal == "fastslam2",
    )
    return particles_of(moved), log_evidence


def particles_of(arrays: Arrays) -> Particles:
    """The particles that a kernel returned.

    Raises NotACovarianceError where there are none, as of `particles_after`.
    """
    if not len(arrays[0]):
        raise NotACovarianceError("the motion", "not positive semi-definite")
    return Particles(*arrays)


@compiled
def particles_after(
    particles: Arrays,
    motion: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]],
    normals: Float[np.ndarray, "M 3"],
    seen: Seen,
    sensor: tuple[float, float, float],
    improved: bool,
) -> tuple[Arrays, float]:
    """The fields of the particles after a step, and its log evidence.

    motion: mean and covariance. No poses, where the covariance is not positive semi-definite.
    """
    start, log_weights, known, means, covariances = particles
    ids, ranges, bearings, own = seen
    L = semidefinite_factor(motion[1])
    if not np.isfinite(L).all():
        return (start[:0], log_weights[:0], known, means[:0], covariances[:0]), math.nan
    after, slots, first = slots_of(known, ids)
    # The kernel writes into these.
    poses, weights = np.empty_like(start), log_weights.copy()
    placed = np.empty((len(start), len(after), 2))
    spread = np.empty((len(start), len(after), 3))
    for i in range(len(start)):
        for k in range(len(known)):
            placed[i, k, 0], placed[i, k, 1] = means[i, k, 0], means[i, k, 1]
            for j in range(3):
                spread[i, k, j] = covariances[i, k, j]
    rows = measured(ranges, bearings, sensor, own)
    step(
        start, motion[0], L, normals, len(known), slots, first, rows, improved, poses, weights,
        placed, spread,
    )  # fmt: skip
    weights, log_evidence = normalised(weights)
    return (poses, weights, after, placed, spread), log_evidence


def propagated(
    particles: Particles, increment: Increment, generator: np.random.Generator
) -> Particles:
    """Moves the particles without measurements: pose ∘ mean ∘ Exp(xi); weights and landmarks
    stay.
    """
    nothing = np.empty(0)
    ids = np.empty(0, np.uint32)
    moved, _ = filter_step(
        particles, increment, Sensor(), ids, nothing, nothing, "fastslam1", generator
    )
    return replace(moved, log_weights=particles.log_weights)
