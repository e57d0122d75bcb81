"""One robot's input to a filter over raw measurements."""

from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles, Proposal
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.scans import Own, unclaimed
from teamslam.team.estimation.se2 import Pose, tangent
from teamslam.team.shapes import Float, UInt32

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
