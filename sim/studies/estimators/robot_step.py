"""A robot's step as input of an estimator, and the innovation of its measurements."""

import math
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import CoreErrors, Matrix, cholesky_factor
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles, Proposal
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation
from teamslam.team.estimation.models import Increment, Own, noise, noise_of, unclaimed
from teamslam.team.estimation.se2 import Pose, compose, tangent, wrapped
from teamslam.team.shapes import Bool, Float, Int64, UInt32

POSE_FLOOR = np.diag([1e-6, 1e-6, 1e-8])
"""Added to a pose's covariance [m², m², rad²], which may be singular."""


class RobotStep(NamedTuple):
    """Motion of a robot, and calibrated measurements [m, rad] at its end.

    own: their covariances, or no rows.
    """

    robot: str
    increment: Increment
    sensor: Sensor
    ids: UInt32[np.ndarray, " n"] = np.empty(0, np.uint32)
    ranges: Float[np.ndarray, " n"] = np.empty(0)
    bearings: Float[np.ndarray, " n"] = np.empty(0)
    own: Own = unclaimed(0)

    @property
    def blind(self) -> "RobotStep":
        """The motion alone."""
        return RobotStep(*self[:3])

    @property
    def claims(self) -> Own:
        """Covariances of the measurements, in as many rows."""
        return self.own if len(self.own) else unclaimed(len(self.ids))

    def fastslam(
        self, particles: Particles, proposal: Proposal, generator: np.random.Generator
    ) -> Particles:
        """Move and update these particles."""
        after, _ = fastslam.filter_step(particles, *self[1:6], proposal, generator, own=self.claims)
        return after


def uncertain_start(pose: Pose, covariance: Matrix) -> Increment:
    """Zero motion with the noise C = GᵀPG of an initial pose, G = blkdiag(R(θ), 1)."""
    G = tangent(pose[2])
    own = dense.product(dense.product(G.T, covariance), G)
    return Increment(np.zeros(3), 0.5 * (own + own.T))


def variances(sensor: Sensor) -> tuple[float, float, float]:
    """(σ_range² [m²], σ_range_per_m², σ_bearing² [rad²])."""
    return (
        core.squared(sensor.range_sigma),
        core.squared(sensor.range_sigma_per_m),
        core.squared(sensor.bearing_sigma),
    )


def innovation(particles: Particles, step: RobotStep) -> Innovation:
    """ν = z − ẑ of a keyframe, with joint predictive covariance.

    Moments of the mixture Σ wᵢ N(ẑᵢ, Sᵢ) of the particles before:

        ẑᵢ = h(poseᵢ ∘ mean, landmarks),  Sᵢ = Hₓ Q Hₓᵀ + Hₗ Σᵢ Hₗᵀ + R,

        S = Σ wᵢ (Sᵢ + dᵢ dᵢᵀ),  dᵢ = ẑᵢ − ẑ.
    """
    with CoreErrors():
        window = core.Window.of_particles(*particles.arrays, noise_of(step.sensor))
        scan = core.Scan(step.ids, step.ranges, step.bearings, step.claims)
        squared, error, S = window.innovation(step.increment.keyframe(scan))
    return _innovation_of(squared, error, S) if len(error) else NOTHING


def joint_innovation(
    landmarks: UInt32[np.ndarray, " L"],
    mean: Float[np.ndarray, " N"],
    covariance: Float[np.ndarray, "N N"],
    step: RobotStep,
) -> Innovation:
    """As `innovation`, of one Gaussian over pose and landmarks, such as an EKF's.

        S = A P Aᵀ + Hₓ Q Hₓᵀ + R,  A = (Hₓ Gᵀ F, Hₗ),
    F = ∂(pose ∘ mean)/∂pose; G = blkdiag(R(θ'), 1). mean: (x, y, θ), then `landmarks`; N = 3 + 2
    L.
    """
    _, at, _ = slots_of(landmarks, step.ids)
    known = at < len(landmarks)
    if not known.any():
        return NOTHING
    read, slots = np.unique(at[known], return_inverse=True)
    columns = np.concatenate((np.arange(3), (3 + 2 * read[:, None] + np.arange(2)).ravel()))
    places = mean[columns[3:]].reshape(-1, 2)
    pose = compose(mean[:3], step.increment.mean)
    dx, dy = pose[:2] - mean[:2]
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    to_own = dense.product(tangent(pose[2]).T, F)
    m = 2 * len(slots)
    error, A, R = np.empty(m), np.zeros((m, len(columns))), np.empty(m)
    measurements = np.column_stack((step.ranges, step.bearings))[known]
    expected, by_pose, by_landmark = core.predict(pose, places[slots])
    for k, slot in enumerate(slots):
        rows = slice(2 * k, 2 * k + 2)
        distance, bearing = expected[k].tolist()
        error[rows] = measurements[k, 0] - distance, wrapped(measurements[k, 1] - bearing)
        R[rows] = noise(step.sensor, distance)
        A[rows, :3] = dense.product(by_pose[k], to_own)
        A[rows, 3 + 2 * slot : 5 + 2 * slot] = by_landmark[k]
    H = by_pose.reshape(m, 3)
    S = (
        dense.product(dense.product(A, covariance[np.ix_(columns, columns)]), A.T)
        + dense.product(dense.product(H, step.increment.covariance), H.T)
        + np.diag(R)
    )
    return _innovation_of(core.normalised_square(error, S), error, S)


def slots_of(
    known: UInt32[np.ndarray, " L"], observed: UInt32[np.ndarray, " n"]
) -> tuple[UInt32[np.ndarray, " K"], Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Ids after the measurements, their slots, a mask of first sights."""
    slot = {each: k for k, each in enumerate(known.tolist())}
    slots, first = np.empty(len(observed), np.int64), np.zeros(len(observed), np.bool_)
    for k, each in enumerate(observed.tolist()):
        first[k] = each not in slot
        slots[k] = slot.setdefault(each, len(slot))
    return np.array(list(slot), np.uint32), slots, first


def _innovation_of(
    squared: float, error: Float[np.ndarray, " m"], S: Float[np.ndarray, "m m"]
) -> Innovation:
    if not math.isfinite(squared):
        white = dense.forward(cholesky_factor(S, "the prediction of measurements"), error)
        squared = float(dense.product(white, white))
    return Innovation(squared, len(error))
