"""One robot's input to an estimate over raw measurements."""

from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.scans import Own, unclaimed
from teamslam.team.estimation.se2 import Pose, tangent
from teamslam.team.shapes import Float, UInt32

POSE_FLOOR = np.diag([1e-6, 1e-6, 1e-8])
"""Added to a pose's covariance [m², m², rad²], which may be singular."""


class RobotStep(NamedTuple):
    """Motion of a robot since its last turn, and the measurements at its end.

    ranges [m] and bearings [rad] are calibrated; own: their covariances, or no rows.
    """

    robot: str
    increment: Increment
    sensor: Sensor
    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    own: Own = unclaimed(0)

    @property
    def blind(self) -> "RobotStep":
        """The motion alone."""
        none = slice(0)
        return self._replace(
            ids=self.ids[none],
            ranges=self.ranges[none],
            bearings=self.bearings[none],
            own=self.own[none],
        )


def uncertain_start(pose: Pose, covariance: Matrix) -> Increment:
    """Zero motion with the noise of an initial pose N(pose, covariance).

    In the pose's own axes the noise is C = GᵀPG, G = blkdiag(R(θ), 1).
    """
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
