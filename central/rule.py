"""What a fusion rule is: a pure function from what the team has sent to its fused map.

`fuse` is that function. The centre's node decides when it is asked: `take` files what comes,
`advance` gives the maps that are due, `conclude` the final one. A rerun asks `fuse` for each
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
"""Which map it is: the last one; one that holds all submaps up to a time; one ahead of that."""


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What one map rests on.

    starts: of every stream. submaps: of each stream from sequence 0 on, without a gap. sightings:
    by (robot, incarnation, sequence) of their submap. maps: the robots' own. withdrawals: whom the
    team goes on without, by robot. verdicts: an operator's on unnamed landmarks. heard: raw
    measurements, the robots' models and the end of the streams, for rules that take these.
    exchange: the round, of rules in lockstep.
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
    """Messages of the robots in, the team's maps out; the node keeps the roll.

    listens: the channels whose messages it takes. unnamed: fields of its maps that rest on what it
    knew beyond the inputs that a map names. landmarks: in its newest map. warnings: what went
    wrong, the newest last.
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
        """From now on the robot is in the team."""
        self.team = tuple(sorted({*self.team, robot}))

    @abstractmethod
    def fuse(self, inputs: Inputs, tail: Tail) -> list[Outgoing]:
        """The map of these inputs, and what goes out with it; inputs that grow are cheap."""

    @abstractmethod
    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; the credit that it gives."""

    @abstractmethod
    def advance(self, attendance: TeamAttendance) -> list[Outgoing]:
        """The maps that are due."""

    def refresh(self, attendance: TeamAttendance) -> list[Outgoing]:
        """The newest map at once, whether or not one is due, if it has more than the last one."""
        return []

    @abstractmethod
    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The last messages, the final map behind all others."""

    def dealt(self, done: m.Done) -> bool:
        """True once all messages announced in the robot's `Done` have arrived."""
        return True

    def complete(self, end: m.End) -> bool:
        """Whether everything of the streams that it needs itself is here."""
        return True

    @property
    def submaps(self) -> int:
        """How many submaps it has dealt with."""
        return 0

    @property
    def figures(self) -> Mapping[str, float]:
        """Figures for people."""
        return {}

    @property
    def findings(self) -> tuple[str, ...]:
        """What a reader of the map must know."""
        return ()

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the team goes on without."""
        return ()

    def refuse(self, message: m.Message, why: str, now_ns: int) -> list[Outgoing]:
        """A message whose handling raised counts as refused; the credit that this gives."""
        return []

    def kept(self, robot: str) -> Sequence[m.Message]:
        """What the robot's next process takes over; nothing: it begins its stream again.

        Of each incarnation, the latest first: its initial pose, the submaps without a gap and the
        inter-robot factors from them.
        """
        return ()

    def lacking(self, attendance: TeamAttendance) -> list[m.SubmapsRequest]:
        """What robots say that they have sent, and what is not here."""
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
