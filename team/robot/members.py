"""What a robot's estimator is to its node, and which one has which name."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from team.config import RobotConfig
from team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from team.estimation.hybrid_slam.innovation import Innovation
from team.estimation.hybrid_slam.pose_grid import Looks
from team.estimation.submap import LocalMap
from team.pairs import FEEDBACK
from team.robot.baselines.filters import NOTHING_KNOWN, KnownMap
from team.robot.baselines.running import RunningMember
from team.robot.member import ClosedWindow, Driven, HybridMember


@runtime_checkable
class Member(Protocol):
    """One epoch of a robot's stream: readings in, submaps, running poses and maps out.

    sequence: by what its running poses and maps are named. used: the disposition of a reading that
    it takes. joint: whether its map has a joint covariance. innovation: of all that it predicted.
    """

    sequence: int

    @property
    def used(self) -> str: ...  # noqa: D102
    @property
    def joint(self) -> bool: ...  # noqa: D102
    @property
    def innovation(self) -> Innovation: ...  # noqa: D102

    def start(self, pose: Float[np.ndarray, "3"] | None, covariance: Matrix | None) -> None:
        """The start pose (None: unknown) and its covariance (None: exact)."""

    def resume(self, closed: ClosedWindow) -> None:
        """Take over a submap of an earlier life."""

    def consumed(self, reading: int) -> None:
        """The reading with this counter is being taken or rejected."""

    def observe(self, stamp_ns: int, scan: tuple[np.ndarray, np.ndarray, np.ndarray]) -> str | None:
        """Take landmarks (ids, ranges [m], bearings [rad]); the reason if they are rejected."""

    def sight(self, stamp_ns: int, reading: int, looks: Looks) -> str | None:
        """Take sightings of teammates; the reason if they are rejected."""

    def drive(
        self,
        stamp_ns: int,
        duration_ns: int,
        forward: float,
        yaw_rate: float,
        *,
        measured: bool = True,
    ) -> Driven:
        """Take one odometry interval, or its time alone (not measured); what it gave."""

    def finish(self) -> tuple[Driven, int]:
        """The stream has ended: what that gave, and how many scans no odometry covered."""

    def open_window(self) -> LocalMap | None:
        """The Gaussian since the last submap, if there is an epoch in it."""

    def own_pose(self, window: LocalMap | None) -> PoseGaussian:
        """The running pose from own readings alone; `window` is the open one."""

    def own_map(self) -> LandmarkGaussian:
        """The running map from own readings (and what was absorbed)."""

    def absorb(self, ids: np.ndarray, means: Float[np.ndarray, "L 2"], covariance: Matrix) -> None:
        """The fused landmarks replace the own ones (rules with feedback)."""


def member_of(config: RobotConfig, epoch: int, known: KnownMap = NOTHING_KNOWN) -> Member:
    """The estimator that the configuration names, at the beginning of an epoch."""
    if config.estimator == "hybrid":
        return HybridMember(config, epoch)
    return RunningMember(config, epoch, known, maps_at_epochs=config.fusion in FEEDBACK)
