"""The interface between a robot's node and its estimator, and the further abilities that some
have.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import msgspec
import numpy as np
from jaxtyping import Float, UInt32

from team.config import RobotConfig
from team.estimation import elementwise, geometry
from team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.estimation.hybrid_slam.fastslam import Particles
from team.estimation.hybrid_slam.innovation import Innovation
from team.estimation.hybrid_slam.pose_grid import TeammateScan
from team.estimation.odometry import OdometryInterval
from team.estimation.scans import Scan
from team.estimation.submap import Became, LocalMap
from team.pairs import ESTIMATORS
from team.registry import loaded
from team.rejection import Rejection

CLOUD_PARTICLES = 32
"""Particles in a cloud for viewers."""


class InitialPose(NamedTuple):
    """Where a stream begins: a pose (None: unknown) and its covariance (None: exact)."""

    pose: Float[np.ndarray, "3"] | None
    covariance: Matrix | None


class KnownMap(NamedTuple):
    """Prior map of a localisation-only robot: ids ascending, positions [m] in the team's frame."""

    ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"]


AT_ORIGIN = InitialPose(np.zeros(3), None)
NOTHING_KNOWN = KnownMap(np.empty(0, np.uint32), np.empty((0, 2)))


class Cloud(NamedTuple):
    """A thinned particle cloud in the own map's frame: P poses and their weights, summing to 1."""

    poses: Float[np.ndarray, "P 3"]
    weights: Float[np.ndarray, " P"]


def thinned(particles: Particles, origin: Float[np.ndarray, "3"]) -> Cloud:
    """Thin out the particles evenly; origin: the pose of their frame in the own map's frame."""
    every = max(1, -(-len(particles.poses) // CLOUD_PARTICLES))
    logs = particles.log_weights[::every]
    weights = elementwise.exp(logs - logs.max())
    poses = np.ascontiguousarray(particles.poses[::every])
    return Cloud(geometry.composed_with(origin, poses), weights / weights.sum())


class Estimates(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """What an odometry interval led to: a submap, and the stamps of a new running pose and map.

    cloud: returns the particles, where there are any, until the next interval is taken. judged: the
    innovation of an estimator without windows since it was last reported, and its time. became: the
    outcomes of all detections without identities, from such an estimator at the end of its stream.
    """

    closed: ClosedWindow | None = None
    pose_ns: int | None = None
    map_ns: int | None = None
    cloud: Callable[[], Cloud] | None = None
    judged: tuple[Innovation, int] | None = None
    became: Became | None = None


NOTHING_NEW = Estimates()


@runtime_checkable
class RobotEstimator(Protocol):
    """An estimator on one incarnation of a robot's stream: measurements in, running poses and maps
    out.

    sequence: the number of its running poses and maps. used: the disposition of a measurement that
    it takes. joint: whether its map has a joint covariance. innovation: of all measurements that it
    predicted.
    """

    @property
    def sequence(self) -> int: ...  # noqa: D102
    @property
    def used(self) -> str: ...  # noqa: D102
    @property
    def joint(self) -> bool: ...  # noqa: D102
    @property
    def innovation(self) -> Innovation: ...  # noqa: D102

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Take a scan of landmarks; returns the reason if it is rejected."""

    def drive(self, interval: OdometryInterval, *, measured: bool = True) -> Estimates:
        """Take one odometry interval, or only its duration (not measured); returns what it led
        to.
        """

    def finish(self) -> tuple[Estimates, int]:
        """End the stream; returns what that led to, and the number of scans that no odometry
        covered.
        """

    def own_pose(self) -> PoseGaussian:
        """The running pose from own measurements alone."""

    def own_map(self) -> LandmarkGaussian:
        """The running map from own measurements (and what was absorbed)."""


@runtime_checkable
class MakesSubmaps(Protocol):
    """An estimator whose windows become submaps; it can be reset to its last submap."""

    def consumed(self, measurement: int) -> None:
        """Note that the measurement with this counter belongs to the open window."""

    def resume(self, closed: ClosedWindow) -> None:
        """Continue behind a submap of an earlier process."""

    def sight(self, stamp_ns: int, measurement: int, looks: TeammateScan) -> Rejection | None:
        """Take inter-robot measurements; returns the reason if they are rejected."""

    def open_window(self) -> LocalMap | None:
        """The Gaussian since the last submap, if there is a keyframe in it."""


@runtime_checkable
class Associates(Protocol):
    """An estimator that takes scans of landmarks without identities: numbers from 2³¹ on."""

    associates: bool


@runtime_checkable
class AbsorbsMaps(Protocol):
    """An estimator that takes the team's map back in (rules with feedback)."""

    def absorb(self, landmarks: LandmarkGaussian) -> None:
        """Replace the own landmarks by the fused ones."""


Factory = Callable[[RobotConfig, int, InitialPose, KnownMap], RobotEstimator]


def estimator_of(
    config: RobotConfig,
    incarnation: int,
    initial: InitialPose = AT_ORIGIN,
    known: KnownMap = NOTHING_KNOWN,
) -> RobotEstimator:
    """Make the estimator that the configuration names, at the beginning of an incarnation."""
    made: Factory = loaded(
        ESTIMATORS[config.estimator].made_by, f"the estimator {config.estimator}"
    )
    return made(config, incarnation, initial, known)
