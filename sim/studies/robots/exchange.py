"""Exchange whole maps between a robot and a centre that fuses them, every `exchange_s`.

Under a rule with feedback the robot waits for the answer (lockstep) and absorbs it.
"""

from collections import deque

from teamslam.team.config import RobotConfig
from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.pairs import FEEDBACK, PAIRS
from teamslam.team.robot.statements import MessageWriter
from teamslam.team.wire.bus import Outgoing

JOINT_LANDMARKS = 2000
"""Landmarks beyond which a map has only 2 × 2 covariances."""


class MapExchange:
    """Rounds of one robot.

    exchanges: the rule fuses own maps. lockstep: the robot waits for answers. answered, awaited:
    last answered and last sent round. last: its sequence; −1: none.
    """

    def __init__(self, config: RobotConfig, warnings: deque[str]) -> None:
        self.exchanges = PAIRS[config.estimator, config.fusion] == "own/map"
        self.lockstep = config.fusion in FEEDBACK
        self._warnings = warnings
        self._every_ns = config.exchange_s * 1e9
        self._map_ns: int | None = None
        self._sent_ns: int | None = None
        self.answered = self.awaited = 0
        self.last = -1

    @property
    def waits(self) -> bool:
        """Whether a sent map has no answer yet."""
        return self.lockstep and self.awaited > self.answered

    def take_answer(self, round_: int) -> bool:
        """Record the answer of a round; return whether it is new."""
        if not self.lockstep or round_ <= self.answered:
            return False
        self.answered = round_
        return True

    def is_sent(self, stamp_ns: int) -> bool:
        """Record a new map; return whether to send it."""
        self._map_ns = stamp_ns
        since = None if self._sent_ns is None else stamp_ns - self._sent_ns
        return not self.exchanges or since is None or since >= self._every_ns

    @property
    def unsent_ns(self) -> int | None:
        """Stamp of the last map, if no exchange had it."""
        is_new = self.exchanges and self._map_ns != self._sent_ns
        return self._map_ns if is_new else None

    def message(
        self,
        stamp_ns: int,
        sequence: int,
        landmarks: LandmarkGaussian,
        writer: MessageWriter,
        *,
        joint: bool,
    ) -> Outgoing:
        """Make a map's message; an exchanged one opens a round."""
        if self.exchanges:
            self._sent_ns, self.last = stamp_ns, sequence
            self.awaited = self.answered + 1 if self.lockstep else self.awaited
        joint = joint and self.exchanges
        if joint and len(landmarks.ids) > JOINT_LANDMARKS:
            joint = False
            self._warnings.append("the own map is too large for a joint covariance")
        return writer.own_map(
            stamp_ns, sequence, self.awaited, landmarks, "joint" if joint else "blocks"
        )
