"""Interface between a comparison robot and its estimator."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import msgspec
import numpy as np

from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.config import RobotConfig
from teamslam.team.core import OdometryInterval
from teamslam.team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.scans import Scan
from teamslam.team.estimation.submap import Became
from teamslam.team.pairs import ESTIMATORS
from teamslam.team.registry import load
from teamslam.team.rejection import Rejection
from teamslam.team.robot.maps import AT_ORIGIN, Cloud, InitialPose
from teamslam.team.shapes import Float, UInt32


class KnownMap(NamedTuple):
    """Prior map: ids ascending, positions [m] in the team's frame."""

    ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"]


NOTHING_KNOWN = KnownMap(np.empty(0, np.uint32), np.empty((0, 2)))


class Estimates(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """Results of an odometry interval: stamps of a new pose and map.

    judged: the innovation since its last report, and its time. became: outcomes of detections
    without identities, at the end.
    """

    pose_ns: int | None = None
    map_ns: int | None = None
    cloud: Callable[[], Cloud] | None = None
    judged: tuple[Innovation, int] | None = None
    became: Became | None = None


NOTHING_NEW = Estimates()


@runtime_checkable
class RobotEstimator(Protocol):
    """Estimator on one incarnation.

    sequence: number of poses and maps. used: disposition of its measurements. joint: the map has a
    joint covariance.
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
        """Process a scan; return the reason of a rejection."""

    def drive(self, interval: OdometryInterval, *, measured: bool = True) -> Estimates:
        """Process one odometry interval, or only its duration (not measured)."""

    def finish(self) -> tuple[Estimates, int]:
        """End the stream; return the last results, and the number of unused scans."""

    def own_pose(self) -> PoseGaussian:
        """Running pose from own measurements alone."""

    def own_map(self) -> LandmarkGaussian:
        """Running map from own measurements and absorbed maps."""


@runtime_checkable
class Associates(Protocol):
    """Estimator that accepts scans without identities: numbers from 2³¹ on."""

    associates: bool


@runtime_checkable
class AbsorbsMaps(Protocol):
    """An estimator that absorbs the team's map (rules with feedback)."""

    def absorb(self, landmarks: LandmarkGaussian) -> None:
        """Replace the own landmarks by the fused ones."""


Factory = Callable[[RobotConfig, int, InitialPose, KnownMap], RobotEstimator]


def estimator_of(
    config: RobotConfig,
    incarnation: int,
    initial: InitialPose = AT_ORIGIN,
    known: KnownMap = NOTHING_KNOWN,
) -> RobotEstimator:
    """Make the configured estimator of an incarnation."""
    made: Factory = load(ESTIMATORS[config.estimator].made_by, f"the estimator {config.estimator}")
    return made(config, incarnation, initial, known)


IN_MAP = "in the running map"
IN_POSE = "in the running pose"  # dispositions of a measurement that such an estimator uses
InitialState = Callable[[RobotConfig, InitialPose, KnownMap, np.random.Generator], Any]
FilterStep = Callable[[Any, RobotStep, np.random.Generator], Any]


class Filter(NamedTuple):
    """Recursive estimator over its own state.

    Steps take calibrated ranges and bearings. looks: accepts landmarks; claims: with covariances;
    maps: has a map; joint: with covariances between landmarks. absorbed: with these landmarks.
    particles: for viewers. innovation: of a step's measurements, predicted by the state before.
    """

    initial_state: InitialState
    filter_step: FilterStep
    pose: Callable[[Any], PoseGaussian]
    landmarks: Callable[[Any], LandmarkGaussian]
    innovation: Callable[[Any, RobotStep], Innovation]
    absorbed: Callable[[Any, np.ndarray, np.ndarray, Matrix], Any] | None = None
    used: str = IN_MAP
    looks: bool = True
    claims: bool = False
    maps: bool = True
    joint: bool = True
    particles: Callable[[Any], Particles] | None = None
    took: Callable[[Any], np.ndarray] | None = None
