"""A robot's running poses: by its own measurements, and given the team's map.

A pose on team/pose is in the team's frame while the newest prior is in the frame that it names.
When a newer prior is in another frame, or withdraws, the own pose replaces it on team/pose.
"""

import math
from collections import deque
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np

from teamslam.team.config import RobotConfig
from teamslam.team.estimation.gaussian import UNSOLVABLE, PoseGaussian
from teamslam.team.estimation.hybrid_slam.window import RunningWindow
from teamslam.team.estimation.plausibility import prior_beyond
from teamslam.team.robot.maps import TeamMap
from teamslam.team.robot.statements import MessageWriter
from teamslam.team.robot.submaps import Submaps
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.message_order import is_newer_prior

TELLING = 3
"""Fewest landmarks of a first pose, one less for each that is refused, that reveal a
wrong range.
"""
PATIENCE_NS = 4_000_000_000  # longest delay of a first pose by fewer landmarks


@runtime_checkable
class PoseEstimator(Protocol):
    """Estimates of a mapper that make a pose."""

    writer: MessageWriter
    submaps: Submaps

    @property
    def sequence(self) -> int:
        """Number of the open window."""

    def open_window(self) -> RunningWindow | None:
        """Return the Gaussian of the open window."""

    def own_pose(self, window: RunningWindow | None) -> PoseGaussian:
        """Return the pose by own measurements."""


class RunningPoses:
    """Poses published every `pose_s`.

    sigma_m: of the last pose in the team's frame; 0 without.
    """

    def __init__(self, config: RobotConfig, warnings: deque[str]) -> None:
        self._bounds = config.bounds
        self._period_ns = config.pose_s * 1e9
        self._warnings = warnings
        self._prior: m.Prior | None = None
        self._posed_ns: int | None = None
        self._own: Outgoing | None = None
        self._claimed: str | None = None
        """The team's frame by this process's last message on team/pose; None: it was not in it."""
        self._pair_ns: int | None = None
        """Time of this incarnation's first pose by fewer landmarks than TELLING."""
        self._is_first = True
        """No message on team/pose is this process's; there may be one of an earlier process."""
        self.team_map = TeamMap()
        self.sigma_m = 0.0

    def take_prior(self, prior: m.Prior) -> list[Outgoing]:
        """Store a prior from the team's map; return the message that withdraws a last pose in
        another frame.
        """
        if not is_newer_prior(prior, self._prior):
            return []
        whole = self.team_map.decode(prior).whole
        why = prior_beyond(whole.mean, whole.covariance, self._bounds)
        if why is not None:
            self._warnings.append(f"the team's map is refused: {why}")
            return []
        self._prior = prior
        # By landmarks alone the next pose decides whether the robot is still placed.
        return [] if prior.ids and prior.frame == self._claimed else self._withdrawn_pose()

    def _withdrawn_pose(self) -> list[Outgoing]:
        prior = self._prior
        if prior is None:
            return []
        if not prior.in_team_frame:
            self.sigma_m = 0.0
            withdraws = self._is_first or self._claimed is not None
        else:
            withdraws = self._claimed not in {None, prior.frame}
        if not withdraws or self._own is None:
            return []
        self._claimed, self._is_first = None, False
        return [outside_team_frame(self._own)]

    @property
    def has_prior(self) -> bool:
        """Whether the newest prior has the robot's pose."""
        return self._prior is not None and self._prior.in_team_frame

    def prior_of(self, incarnation: int) -> m.Prior | None:
        """Return the prior with a pose of this incarnation."""
        prior = self._prior if self.has_prior else None
        return prior if prior is not None and prior.incarnation == incarnation else None

    def _placing(self, incarnation: int) -> m.Prior | None:
        """Return the newest prior if it places this incarnation by a pose or by landmarks."""
        prior = self._prior
        if prior is None or prior.incarnation != incarnation:
            return None
        return prior if prior.in_team_frame or prior.ids else None

    def begin_incarnation(self, incarnation: int) -> None:
        """Drop the prior of an earlier incarnation."""
        self._pair_ns = None
        if self._prior is not None and self._prior.incarnation < incarnation:
            self._prior = None

    def publish(self, stamp_ns: int, estimator: PoseEstimator) -> list[Outgoing]:
        """Make the messages of a new pose, if due."""
        if self._posed_ns is not None and stamp_ns - self._posed_ns < self._period_ns:
            return []
        self._posed_ns = stamp_ns
        prior = self._placing(estimator.writer.incarnation)
        out = self.estimate(stamp_ns, prior, estimator)
        self._own = out[0]
        if len(out) == 1 or self._awaits_more(stamp_ns):
            return [out[0], *self._withdrawn_pose()]
        assert prior is not None
        self._claimed, self._is_first = prior.frame, False
        return out

    def _awaits_more(self, stamp_ns: int) -> bool:
        """Return whether a first pose by landmarks alone needs another landmark to reveal a wrong
        one.
        """
        is_placed = self.has_prior or self._claimed is not None
        if is_placed or self.team_map.known - 2 * self.team_map.refused >= TELLING:
            return False
        if self._pair_ns is None:
            self._pair_ns = stamp_ns
        return stamp_ns - self._pair_ns < PATIENCE_NS

    def estimate(
        self, stamp_ns: int, prior: m.Prior | None, estimator: PoseEstimator
    ) -> list[Outgoing]:
        """Make the messages of the own pose and, given a prior, the team's."""
        sequence, writer, window = estimator.sequence, estimator.writer, estimator.open_window()
        out = [writer.pose(stamp_ns, sequence, estimator.own_pose(window))]
        if prior is None:
            return out
        try:
            with np.errstate(all="ignore"):  # a pose that is not finite is withheld
                if prior.in_team_frame:
                    posed = self.team_map.pose(prior, estimator.submaps, window).pose
                else:
                    own_map = getattr(estimator, "own_map", None)  # not every one joins a map
                    placed = self.team_map.place(prior, own_map, window) if own_map else None
                    if placed is None:
                        return out
                    posed = placed
        except UNSOLVABLE as error:
            self._warnings.append(f"no team pose from the fused map: {error}")
            return out
        self.sigma_m = math.sqrt(max(float(posed[1][0, 0] + posed[1][1, 1]), 0.0))
        return [*out, writer.pose(stamp_ns, sequence, posed, prior)]


def outside_team_frame(own: Outgoing) -> Outgoing:
    """Make the message of the own pose on team/pose that withdraws earlier poses."""
    assert isinstance(own.message, m.PoseEstimate)
    message = msgspec.structs.replace(own.message, in_team_frame=False)
    return Outgoing(ch.TEAM_POSE, own.name, message)
