"""FastSLAM with known data association: particles over paths, each with an EKF per landmark.

p(path, landmarks | z) = p(path | z) Π p(landmark | path, z). Montemerlo 2003; Thrun et al. 2005,
ch. 13.
"""

from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import numpy as np

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.core import systematic_parents
from teamslam.team.estimation.gaussian import CoreErrors
from teamslam.team.estimation.models import Increment, Own, noise_of
from teamslam.team.shapes import Float, Int64, UInt32

Proposal = Literal["fastslam2", "fastslam1"]
Arrays = tuple[
    Float[np.ndarray, "M 3"],
    Float[np.ndarray, " M"],
    UInt32[np.ndarray, " L"],
    Float[np.ndarray, "M L 2"],
    Float[np.ndarray, "M L 3"],
]
"""Fields of `Particles`."""


@dataclass(frozen=True)
class Particles:
    """M weighted poses, each with its own estimate of L landmarks.

    poses: (x [m], y [m], theta [rad]) in the frame of the window's start. log_weights: Σ exp = 1.
    ids: in order of first observation. means: [m]; covariances: (xx, xy, yy) given the path [m²].
    """

    poses: Float[np.ndarray, "M 3"]
    log_weights: Float[np.ndarray, " M"]
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "M L 2"]
    covariances: Float[np.ndarray, "M L 3"]

    @property
    def arrays(self) -> Arrays:
        """Fields in the order of the core's arguments."""
        return self.poses, self.log_weights, self.ids, self.means, self.covariances


class StepInfo(msgspec.Struct, frozen=True, gc=False):
    """Statistics of one step.

    effective_sample_size: 1/Σ w² after the step, in [1, M]. parents: origin of each particle if
    resampled. log_evidence: log p(z | earlier z); 0 without a re-observation.
    """

    effective_sample_size: float
    parents: Int64[np.ndarray, " M"] | None
    log_evidence: float


def at_poses(poses: Float[np.ndarray, "M 3"]) -> Particles:
    """Make equal particles at these poses, without landmarks."""
    count = len(poses)
    return Particles(
        poses=poses,
        log_weights=np.full(count, -core.log(count)),
        ids=np.empty(0, np.uint32),
        means=np.empty((count, 0, 2)),
        covariances=np.empty((count, 0, 3)),
    )


def resampled(
    particles: Particles, generator: "np.random.Generator"
) -> tuple[Particles, Int64[np.ndarray, " M"]]:
    """Resample to equal weights; draws one uniform number."""
    parents = systematic_parents(particles.log_weights, generator.random())
    copies = Particles(
        poses=particles.poses[parents],
        log_weights=np.full(len(parents), -core.log(float(len(parents)))),
        ids=particles.ids,
        means=particles.means[parents],
        covariances=particles.covariances[parents],
    )
    return copies, parents


def filter_step(
    particles: Particles,
    increment: Increment,
    sensor: Sensor,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    proposal: Proposal,
    generator: "np.random.Generator",
    *,
    own: Own | None = None,
) -> tuple[Particles, float]:
    """Move the particles, then update them by the measurements; return also the log evidence.

    ranges [m] and bearings [rad] are calibrated; own: their covariances (`models.Own`); an id may
    occur twice. Draws M × 3 normal numbers. Raises NotACovarianceError.
    """
    normals = generator.standard_normal((len(particles.poses), 3))
    with CoreErrors():
        window = core.Window.of_particles(
            *particles.arrays, noise_of(sensor), proposal == "fastslam2"
        )
        log_evidence = window.step(
            increment.keyframe(core.Scan(ids, ranges, bearings, own)), normals
        )
    return Particles(*window.particles()), log_evidence


def propagated(
    particles: Particles, increment: Increment, generator: "np.random.Generator"
) -> Particles:
    """Move the particles: pose ∘ mean ∘ Exp(xi); weights and landmarks stay."""
    nothing = np.empty(0)
    ids = np.empty(0, np.uint32)
    moved, _ = filter_step(
        particles, increment, Sensor(), ids, nothing, nothing, "fastslam1", generator
    )
    return replace(moved, log_weights=particles.log_weights)
