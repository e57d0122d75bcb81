"""Hybrid-SLAM as a robot runs it: the front end's submaps, and the robot's own whole map made of
them.

The own map is what the robot knows by itself: its submaps joined one by one (Brooks & Bailey's back
end). No submap depends on it. It has no landmarks without identities: the centre finds out which of
them are one over several submaps, and until then the pose follows odometry and the landmarks with
identities.
"""

from collections import deque
from functools import partial

import numpy as np

from team.config import RobotConfig
from team.estimation.gaussian import LandmarkGaussian, NotACovarianceError, PoseGaussian
from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.estimation.hybrid_slam.fastslam import Particles
from team.estimation.hybrid_slam.innovation import Innovation
from team.estimation.hybrid_slam.pipeline import HybridSlam
from team.estimation.hybrid_slam.pose_grid import TeammateScan
from team.estimation.map_joining.conditioning import pose_now
from team.estimation.map_joining.gauss_newton import UNSOLVABLE
from team.estimation.map_joining.whole_map import WholeMap, absorbed, initial_map, joined
from team.estimation.odometry import OdometryInterval
from team.estimation.plausible import are_landmarks
from team.estimation.scans import Scan
from team.estimation.submap import LocalMap
from team.rejection import Rejection
from team.robot.estimator import (
    AT_ORIGIN,
    NOTHING_KNOWN,
    NOTHING_NEW,
    Cloud,
    Estimates,
    InitialPose,
    KnownMap,
    thinned,
)


class HybridEstimator:
    """Hybrid-SLAM on one incarnation of a robot's stream, from its initial pose or its last
    submap.
    """

    used = "in a submap"
    joint = True

    def __init__(
        self,
        config: RobotConfig,
        incarnation: int,
        initial: InitialPose = AT_ORIGIN,
        known: KnownMap = NOTHING_KNOWN,
    ) -> None:
        self._slam = HybridSlam(config, incarnation)
        self.associates = config.fusion == "join"
        origin = np.zeros(3) if initial.pose is None else initial.pose
        self._whole: WholeMap = initial_map(origin, initial.covariance)
        self._behind: deque[LocalMap] = deque()
        self._origin = origin
        self._open: tuple[LocalMap | None] | None = None

    @property
    def sequence(self) -> int:
        """The number of the open window."""
        return self._slam.sequence

    @property
    def innovation(self) -> Innovation:
        """The innovations of all windows of this incarnation that this process has computed."""
        return self._slam.innovation

    def consumed(self, measurement: int) -> None:
        """Note that the measurement belongs to the open window, even if it was rejected."""
        self._slam.consumed(measurement)

    def resume(self, closed: ClosedWindow) -> None:
        """Continue behind a submap of an earlier process: the next window begins where that one
        ended.
        """
        self._behind.append(closed.local.named)
        self._open = None
        self._slam.resume(closed)

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Take a scan of landmarks; returns the reason if it is rejected."""
        return self._slam.observe(stamp_ns, scan)

    def sight(self, stamp_ns: int, measurement: int, looks: TeammateScan) -> Rejection | None:
        """Take inter-robot measurements; returns the reason if they are rejected."""
        return self._slam.sight(stamp_ns, measurement, looks)

    def drive(self, interval: OdometryInterval, *, measured: bool = True) -> Estimates:
        """Take one odometry interval; returns the submap that it closes, if any."""
        self._open, before_ns = None, self._slam.last_keyframe_ns
        closed = self._slam.drive(interval, measured=measured)
        if closed is not None:
            return self._with_submap(closed)
        now_ns = self._slam.last_keyframe_ns
        return NOTHING_NEW if now_ns == before_ns else Estimates(pose_ns=now_ns)

    def finish(self) -> tuple[Estimates, int]:
        """End the stream; returns the last submap, and the number of scans that no odometry
        covered.
        """
        self._open = None
        closed, uncovered = self._slam.finish()
        return Estimates() if closed is None else self._with_submap(closed), uncovered

    def _with_submap(self, closed: ClosedWindow) -> Estimates:
        """A submap is new: pose and map are updated by it as soon as they are asked for."""
        self._behind.append(closed.local.named)
        cloud = None
        if closed.window is not None:
            cloud = partial(self._cloud, closed.window.particles)
        return Estimates(closed=closed, pose_ns=closed.end_ns, map_ns=closed.end_ns, cloud=cloud)

    def _cloud(self, particles: Particles) -> Cloud:
        """The particles of the last closed window, around the pose at its beginning."""
        self._join()
        return thinned(particles, self._origin)

    @property
    def whole(self) -> WholeMap:
        """The own whole map, of all submaps."""
        self._join()
        return self._whole

    def open_window(self) -> LocalMap | None:
        """The Gaussian of the open window at its last keyframe, if there is one; kept until it
        changes.
        """
        if self._open is None:
            self._open = (self._slam.running(),)
        return self._open[0]

    def own_pose(self) -> PoseGaussian:
        """The pose by the own whole map and the open window, or by its motion alone if they
        contradict.
        """
        window = self.open_window()
        try:
            return pose_now(self.whole, window).pose
        except UNSOLVABLE:
            return pose_now(self.whole, None if window is None else window.motion).pose

    def own_map(self) -> LandmarkGaussian:
        """The landmarks of the own whole map."""
        whole = self.whole
        return LandmarkGaussian(whole.ids, whole.mean[3:].reshape(-1, 2), whole.covariance[3:, 3:])

    def absorb(self, landmarks: LandmarkGaussian) -> None:
        """Replace the landmarks of the own whole map by the fused ones; submaps never see it."""
        self._whole = absorbed(self.whole, *landmarks)

    def _join(self) -> None:
        """Join the submaps behind the own map, one by one: the map is the same whenever it is asked
        for.
        """
        while self._behind:
            local = self._behind.popleft()
            self._origin = self._whole.mean[:3]
            self._whole = self._joined(local)

    def _joined(self, local: LocalMap) -> WholeMap:
        """The own map joined with a submap, or with its motion alone if it contradicts the map
        numerically.
        """
        try:
            after = joined(self._whole, local)
        except NotACovarianceError:
            after = None
        if after is not None and are_landmarks(after.covariance[3:, 3:]):
            return after
        return joined(self._whole, local.motion)
