"""The inputs of a fusion rule, and their collection from the messages of the robots.

An intake files and acknowledges messages; it does not fold, and does not decide when a map is due.
That is done by the scheduler (`central.scheduler`), by the rule's own clock and by what the intake
has.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Generic, Literal, TypeVar

from central.attendance import TeamAttendance
from central.config import CentralConfig
from team.estimation.contribution import Stream
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing

Due = Literal["news", "period", "now"]
"""When a running map is due: broadcast_s of team time after the last one, if an input is new; each
broadcast_s; at every instant."""


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The inputs of one map; each intake adds what it collects.

    closed_ns: every input that ends up to here has arrived. ahead: later inputs are in the map,
    too. recorded: the inputs are those that a recorded map has named: no further robot is
    withdrawn. now_ns: team time.
    """

    closed_ns: float = float("inf")
    ahead: bool = True
    recorded: bool = False
    now_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class MapInputs(Inputs):
    """The robots' own maps; exchange: their round, for rules in lockstep."""

    maps: Sequence[m.MapEstimate] = ()
    starts: Mapping[Stream, m.InitialPose] = field(default_factory=dict)
    exchange: int = 0


I = TypeVar("I", bound=Inputs)  # noqa: E741 - the inputs of one family of rules


@dataclass(frozen=True)
class Instant(Generic[I]):
    """The inputs at one instant of a rule's clock, `now_ns`.

    since_ns: a first map is due a period after this; None: at once.
    """

    now_ns: int
    inputs: I
    since_ns: int | None = None


class Intake(ABC, Generic[I]):
    """Files the inputs of a rule; knows which have arrived and which are waited for.

    listens: the channels whose messages it takes. due: when a running map of it is. orders: robots
    that the team goes on without, by an order. withdrawn: those, and the robots that the rule has
    withdrawn. warnings: in words, the newest last. refused: number of refused messages.
    """

    listens: ClassVar[tuple[ch.Channel, ...]]
    due: ClassVar[Due] = "news"

    def __init__(self, config: CentralConfig, robots: Sequence[str]) -> None:
        self.config = config
        self.orders: set[str] = set()
        self.withdrawn: tuple[str, ...] = ()
        self.warnings: list[str] = []
        self.refused = 0

    @abstractmethod
    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """File one message; returns the credit that it gives."""

    @abstractmethod
    def inputs(self, closed_ns: float, now_ns: int) -> I:
        """Everything that is here."""

    @abstractmethod
    def instants(self, attendance: TeamAttendance) -> Iterator[Instant[I]]:
        """The instants until now at which a map may be due."""

    def members(self, until_ns: float) -> Mapping[Stream, int]:
        """The last input of each stream that ends up to a time, as a map names it."""
        return {}

    def dealt(self, done: m.Done) -> bool:
        """True once all messages announced in the robot's `Done` have arrived."""
        return True

    @property
    def complete(self) -> bool:
        """Whether everything of the streams that the rule itself consumes is here."""
        return True

    def count(self, stream: Stream) -> int:
        """Number of submaps of a stream that are in the map's reach, or will never be."""
        return 0

    @property
    def submaps(self) -> int:
        """Number of submaps that were dealt with."""
        return 0

    def refuse(self, message: m.Message, why: str, now_ns: int) -> list[Outgoing]:
        """Count a message whose handling raised as refused; returns the credit that this gives."""
        return []

    def stored_messages(self, robot: str) -> Sequence[m.Message]:
        """The messages that the robot's next process takes over; empty: it begins its stream again.

        Of each incarnation, the latest first: its initial pose, the submaps without a gap and the
        inter-robot factors from them.
        """
        return ()

    def lacking(self, attendance: TeamAttendance) -> list[m.SubmapsRequest]:
        """Requests for submaps that robots have announced and that are not here."""
        return []

    def requests(self, now_ns: int) -> list[m.MeasurementsRequest]:
        """Requests for missing measurements, for their source."""
        return []
