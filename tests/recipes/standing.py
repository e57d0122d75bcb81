"""An estimator by the recipe of docs/architecture.md: one class in one file."""

import numpy as np

from teamslam.sim.studies.robots.filters import NOTHING_NEW, Estimates, KnownMap
from teamslam.team.config import RobotConfig
from teamslam.team.core import OdometryInterval, Scan
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation
from teamslam.team.rejection import Rejection
from teamslam.team.robot.maps import InitialPose


class Standing:
    """A robot that assumes that it stands still, and sees nothing."""

    sequence = 0
    used = "in no map"
    joint = True
    innovation: Innovation = NOTHING

    def __init__(
        self, config: RobotConfig, incarnation: int, initial: InitialPose, known: KnownMap
    ) -> None:
        self._pose = np.zeros(3) if initial.pose is None else initial.pose

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Ignore landmarks."""
        return Rejection.NO_LANDMARKS

    def drive(self, interval: OdometryInterval, *, measured: bool = True) -> Estimates:
        """End each interval with a pose."""
        return Estimates(pose_ns=interval.end_ns)

    def finish(self) -> tuple[Estimates, int]:
        """Nothing is pending."""
        return NOTHING_NEW, 0

    def own_pose(self) -> PoseGaussian:
        """The initial pose."""
        return PoseGaussian(self._pose, np.eye(3))

    def own_map(self) -> LandmarkGaussian:
        """None."""
        return NO_LANDMARKS
