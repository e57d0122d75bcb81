"""Publishes a robot's running map: for viewers, or in an exchange where the rule fuses whole
maps.
"""

import numpy as np

from team import translate
from team.config import RobotConfig
from team.estimation.gaussian import LandmarkGaussian, NotACovarianceError
from team.pairs import PAIRS
from team.robot.estimator import AbsorbsMaps
from team.robot.front_end import BoundedEstimator
from team.robot.pace import Pace
from team.robot.statements import MessageWriter
from team.wire import messages as m
from team.wire.bus import Outgoing

JOINT_LANDMARKS = 2000
"""An own map with more landmarks carries their 2 × 2 covariances only: a message has at most 64
MiB."""


class RunningMaps:
    """Decides when the own map is published, and with it the particles.

    For viewers they go out for each window in which a multiple of `pose_s` lies: by the stamps
    alone, so that a robot that is started again publishes the same ones. Under a rule on whole maps
    a map goes out every `exchange_s`, with its joint covariance; under one with feedback the robot
    then waits for the answer (`Pace`). last: the sequence of the last one that was exchanged; −1:
    none.
    """

    def __init__(self, config: RobotConfig, pace: Pace, warnings: list[str]) -> None:
        self._config = config
        self._pace = pace
        self._warnings = warnings
        self._exchanges = PAIRS[config.estimator, config.fusion] == "own/map"
        self._period_ns = round(config.pose_s * 1e9)
        self._map_ns: int | None = None
        self._exchange_ns: int | None = None
        self.last = -1

    def begin_incarnation(self) -> None:
        """Begin an incarnation: its maps are numbered from 0."""
        self.last = -1

    def due(self, begin_ns: int, end_ns: int) -> bool:
        """Whether a map at the end of this window is published, or may be exchanged."""
        period_ns = self._period_ns
        return self._exchanges or period_ns == 0 or end_ns // period_ns > begin_ns // period_ns

    def at(self, stamp_ns: int, front: BoundedEstimator, writer: MessageWriter) -> list[Outgoing]:
        """A new running map: publish it for viewers, or in an exchange that is due."""
        self._map_ns = stamp_ns
        if not self._exchanges:
            return [self._own_map(stamp_ns, front, writer)]
        since = None if self._exchange_ns is None else stamp_ns - self._exchange_ns
        if since is not None and since < self._config.exchange_s * 1e9:
            return []
        return self._exchange(stamp_ns, front, writer)

    def finish(self, front: BoundedEstimator, writer: MessageWriter) -> list[Outgoing]:
        """End the stream: publish the last map, unless an exchange had it."""
        if self._map_ns is None or not self._exchanges or self._map_ns == self._exchange_ns:
            return []
        return self._exchange(self._map_ns, front, writer)

    def _exchange(
        self, stamp_ns: int, front: BoundedEstimator, writer: MessageWriter
    ) -> list[Outgoing]:
        self._exchange_ns = stamp_ns
        self.last = front.estimator.sequence
        if self._pace.lockstep:
            self._pace.sent_map()
        return [self._own_map(stamp_ns, front, writer)]

    def _own_map(self, stamp_ns: int, front: BoundedEstimator, writer: MessageWriter) -> Outgoing:
        estimator = front.estimator
        landmarks = estimator.own_map()
        joint = self._exchanges and estimator.joint
        if joint and len(landmarks.ids) > JOINT_LANDMARKS:
            joint = False
            self._warnings.append("the own map is too large for a joint covariance")
        return writer.own_map(
            stamp_ns,
            estimator.sequence,
            self._pace.awaited,
            landmarks,
            "joint" if joint else "blocks",
        )

    def absorb(self, fused: m.FusedMap, front: BoundedEstimator) -> None:
        """Take the answer of an exchange: under a rule with feedback the own map absorbs it."""
        estimator: object = front.estimator
        if self._pace.answered(fused.exchange):
            if not isinstance(estimator, AbsorbsMaps):
                raise ValueError(f"the estimator {self._config.estimator} absorbs no map")
            ids, means = translate.landmarks_of(fused)
            joint = translate.landmark_covariance_of(fused)
            try:
                estimator.absorb(LandmarkGaussian(ids, means, joint))
            except (NotACovarianceError, np.linalg.LinAlgError) as error:
                self._warnings.append(f"the fused map can not be absorbed: {error}")
