"""The robot's own map: its submaps joined one after the other (Brooks and Bailey's back end).

It needs no teammate and no submap depends on it. Landmarks without identities are left out: the
team's fold finds out which of them are one over several submaps, and until then the pose follows
odometry and the landmarks with identities.
"""

from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.core import WholeMap
from teamslam.team.estimation import se2
from teamslam.team.estimation.gaussian import (
    LandmarkGaussian,
    Matrix,
    NotACovarianceError,
    PoseGaussian,
)
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.map_joining.conditioning import compose_pose
from teamslam.team.estimation.map_joining.gauss_newton import UNSOLVABLE
from teamslam.team.estimation.map_joining.whole_map import initial_map, join_submap
from teamslam.team.estimation.plausibility import are_landmarks
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Float

CLOUD_PARTICLES = 32
"""Particles in a cloud for viewers."""


class InitialPose(NamedTuple):
    """Where a stream begins: a pose (None: unknown) and its covariance (None: exact)."""

    pose: Float[np.ndarray, "3"] | None
    covariance: Matrix | None


AT_ORIGIN = InitialPose(np.zeros(3), None)


class Cloud(NamedTuple):
    """A thinned particle cloud in the own map's frame: P poses and their weights, summing to 1."""

    poses: Float[np.ndarray, "P 3"]
    weights: Float[np.ndarray, " P"]


def thin_out(particles: Particles, origin: Float[np.ndarray, "3"]) -> Cloud:
    """Thin out the particles evenly; origin: the pose of their frame in the own map's frame."""
    every = max(1, -(-len(particles.poses) // CLOUD_PARTICLES))
    logs = particles.log_weights[::every]
    weights = core.exp(logs - logs.max())
    poses = np.ascontiguousarray(particles.poses[::every])
    return Cloud(se2.compose(origin, poses), weights / weights.sum())


class OwnMap:
    """The join of a robot's submaps so far, from its initial pose on.

    whole: pose and landmarks. origin: the pose at which the last joined submap begins.
    """

    def __init__(self, initial: InitialPose = AT_ORIGIN) -> None:
        self.origin = np.zeros(3) if initial.pose is None else initial.pose
        self.whole: WholeMap = initial_map(self.origin, initial.covariance)

    def join(self, local: LocalMap) -> None:
        """Join the next submap, or its motion alone if it contradicts the map numerically."""
        self.origin, _ = self.whole.pose()
        named = local.named
        try:
            after = join_submap(self.whole, named)
        except NotACovarianceError:
            after = None
        if after is None or not are_landmarks(after.covariance[3:, 3:]):
            after = join_submap(self.whole, named.motion)
        self.whole = after

    def pose(self, window: LocalMap | None) -> PoseGaussian:
        """The pose after the open window, or after its motion alone if it contradicts the map."""
        try:
            return compose_pose(self.whole, window).pose
        except UNSOLVABLE:
            return compose_pose(self.whole, None if window is None else window.motion).pose

    @property
    def landmarks(self) -> LandmarkGaussian:
        """The landmarks of the map."""
        whole = self.whole
        return LandmarkGaussian(whole.ids, whole.mean[3:].reshape(-1, 2), whole.covariance[3:, 3:])
