"""Publishes a robot's running poses: by its own measurements, and given the team's map."""

import math

import numpy as np

from team.config import RobotConfig
from team.estimation.gaussian import NotACovarianceError
from team.estimation.map_joining.gauss_newton import NotDeterminedError
from team.estimation.plausible import prior_beyond
from team.robot.front_end import BoundedEstimator
from team.robot.statements import MessageWriter
from team.robot.team_map import TeamMap
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.digest import NO_MAP
from team.wire.newer import is_newer_prior


class RunningPoses:
    """Publishes poses every `pose_s`.

    sigma_m: standard deviation of the last pose in the team's frame; 0 before there is one.
    """

    def __init__(self, config: RobotConfig, warnings: list[str]) -> None:
        self._bounds = config.bounds
        self._period_ns = config.pose_s * 1e9
        self._warnings = warnings
        self._prior: m.Prior | None = None
        self._posed_ns: int | None = None
        self.team_map = TeamMap()
        self.sigma_m = 0.0

    def take(self, prior: m.Prior) -> None:
        """Take a prior from the team's map; the newest one is used."""
        if not is_newer_prior(prior, self._prior):
            return
        whole = self.team_map.decoded(prior).whole
        why = prior_beyond(whole.mean, whole.covariance, self._bounds)
        if why is None:
            self._prior = prior
        else:
            self._warnings.append(f"the team's map is refused: {why}")

    @property
    def has_prior(self) -> bool:
        """Whether a prior has arrived."""
        return self._prior is not None

    def prior_of(self, incarnation: int) -> m.Prior | None:
        """The prior with a pose of this incarnation; None where there is none."""
        prior = self._prior
        return prior if prior is not None and prior.incarnation == incarnation else None

    def begin_incarnation(self, incarnation: int) -> None:
        """Begin an incarnation: a prior of an earlier one is of no further use."""
        if self._prior is not None and self._prior.incarnation < incarnation:
            self._prior = None

    def at(self, stamp_ns: int, front: BoundedEstimator, writer: MessageWriter) -> list[Outgoing]:
        """A new pose: the messages to publish, if they are due."""
        if self._posed_ns is not None and stamp_ns - self._posed_ns < self._period_ns:
            return []
        self._posed_ns = stamp_ns
        return self.posed(stamp_ns, self.prior_of(writer.incarnation), front, writer)

    def posed(
        self,
        stamp_ns: int,
        prior: m.Prior | None,
        front: BoundedEstimator,
        writer: MessageWriter,
    ) -> list[Outgoing]:
        """The message of the own pose and, given a prior, of the pose in the team's map."""
        sequence = front.estimator.sequence
        own = front.estimator.own_pose()
        out = [writer.pose(ch.OWN_POSE, stamp_ns, sequence, NO_MAP, own)]
        if prior is None:
            return out
        try:
            with np.errstate(all="ignore"):  # what is no number is withheld
                posed = self.team_map.pose(prior, front.submaps, front.open_window()).pose
        except (NotACovarianceError, NotDeterminedError, np.linalg.LinAlgError) as error:
            self._warnings.append(f"no team pose from the fused map: {error}")
            return out
        self.sigma_m = math.sqrt(max(float(posed[1][0, 0] + posed[1][1, 1]), 0.0))
        return [*out, writer.pose(ch.TEAM_POSE, stamp_ns, sequence, prior.digest, posed)]
