"""The interface of fusion rules: a pure function from what the team has sent to its fused map.

`fuse` is that function. The centre's node decides when it is called: `take` files a message,
`advance` returns the maps that are due, `conclude` the final one. A rerun asks `fuse` for each
recorded map with the inputs that the map names, and has to get the same bytes.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from central.attendance import TeamAttendance
from central.config import CentralConfig
from team.pairs import RULES
from team.registry import loaded
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing

Stream = tuple[str, int]
"""(robot, incarnation)."""
Tail = Literal["final", "closed", "provisional"]
"""The kind of a map: the last one; one with all submaps up to a time; one beyond that."""


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The inputs of one map.

    starts: of every stream. submaps: of each stream from sequence 0 on, without a gap. sightings:
    by (robot, incarnation, sequence) of their submap. maps: the robots' own. withdrawals: orders by
    withdrawn robot. verdicts: an operator's on unnamed landmarks. heard: raw measurements, the
    robots' models and the end of the streams, for rules that take these. exchange: the round, of
    rules in lockstep.
    """

    starts: Mapping[Stream, m.InitialPose] = field(default_factory=dict)
    submaps: Mapping[Stream, Sequence[m.Submap]] = field(default_factory=dict)
    sightings: Mapping[tuple[str, int, int], Sequence[m.SightingFactor]] = field(
        default_factory=dict
    )
    maps: Sequence[m.MapEstimate] = ()
    withdrawals: Mapping[str, m.Withdrawal] = field(default_factory=dict)
    verdicts: Sequence[m.Judgement] = ()
    heard: Sequence[m.Message] = ()
    exchange: int = 0
    stamp_ns: int = 0


class FusionRule(ABC):
    """A fusion rule: messages of the robots in, the team's maps out; the node keeps the attendance.

    listens: the channels whose messages it takes. unnamed: fields of its maps that depend on more
    than the inputs that a map names. landmarks: in its newest map. warnings: in words, the newest
    last.
    """

    listens: ClassVar[tuple[ch.Channel, ...]]
    unnamed: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str]) -> None:
        self.config = config
        self.config_digest = digest
        self.team = tuple(sorted(robots))
        self.broadcast_ns: int | None = None
        self.landmarks = 0
        self.warnings: list[str] = []

    def admit(self, robot: str) -> None:
        """Add a robot to the team."""
        self.team = tuple(sorted({*self.team, robot}))

    @abstractmethod
    def fuse(self, inputs: Inputs, tail: Tail) -> list[Outgoing]:
        """The map of these inputs, and the messages that go out with it; growing inputs are
        cheap.
        """

    @abstractmethod
    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; returns the credit that it gives."""

    @abstractmethod
    def advance(self, attendance: TeamAttendance) -> list[Outgoing]:
        """The maps that are due."""

    def refresh(self, attendance: TeamAttendance) -> list[Outgoing]:
        """The newest map at once, whether or not it is due, if it has more than the last one."""
        return []

    @abstractmethod
    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The last messages, the final map after all others."""

    def dealt(self, done: m.Done) -> bool:
        """True once all messages announced in the robot's `Done` have arrived."""
        return True

    def complete(self, end: m.End) -> bool:
        """Whether the streams that the rule itself consumes are complete here."""
        return True

    @property
    def submaps(self) -> int:
        """Number of submaps that were dealt with."""
        return 0

    @property
    def figures(self) -> Mapping[str, float]:
        """Figures for people."""
        return {}

    @property
    def findings(self) -> tuple[str, ...]:
        """Warnings for readers of the map."""
        return ()

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The withdrawn robots."""
        return ()

    def refuse(self, message: m.Message, why: str, now_ns: int) -> list[Outgoing]:
        """Count a message whose handling raised as refused; returns the credit that this gives."""
        return []

    def kept(self, robot: str) -> Sequence[m.Message]:
        """What the robot's next process takes over; nothing: it begins its stream again.

        Of each incarnation, the latest first: its initial pose, the submaps without a gap and the
        inter-robot factors from them.
        """
        return ()

    def lacking(self, attendance: TeamAttendance) -> list[m.SubmapsRequest]:
        """What robots say that they have sent and is not here."""
        return []

    def wanted(self, now_ns: int) -> list[m.MeasurementsRequest]:
        """Measurements that are missing and must be asked for at their source."""
        return []

    def is_due(self, now_ns: int) -> bool:
        """Whether broadcast_s of team time have gone by since the last broadcast."""
        last_ns = self.broadcast_ns
        return last_ns is None or now_ns - last_ns >= self.config.broadcast_s * 1e9


def rule_of(config: CentralConfig, digest: bytes, robots: Sequence[str]) -> FusionRule:
    """The rule that the configuration names; raises NotInstalledError."""
    made: type[FusionRule] = loaded(
        RULES[config.fusion].made_by, f"the fusion rule {config.fusion}"
    )
    return made(config, digest, robots)
