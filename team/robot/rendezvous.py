"""What a robot holds back until it meets a teammate (Xu, 5.1; Downs, 4.3).

Who meets is known to one of the two only: the one that sees. It says so, and both send what they
hold. Holding back changes when a submap is sent, never what is in it: the final map is that of a
continuous exchange.
"""

from dataclasses import dataclass, field

from team.wire import messages as m
from team.wire.bus import Outgoing


@dataclass
class Held:
    """Submaps and sightings that are closed and not sent yet, in their order.

    waits: whether anything is held back at all. greeted: the teammates that were told of a meeting
    since the last window ended: once is enough.
    """

    waits: bool
    greeted: set[str] = field(default_factory=set)
    _out: list[Outgoing] = field(default_factory=list)

    @property
    def submaps(self) -> int:
        """How many submaps are held."""
        return sum(isinstance(o.message, m.Submap) for o in self._out)

    @property
    def since_ns(self) -> int | None:
        """When the window of the oldest one began; None: nothing is held."""
        found = (o.message.start_ns for o in self._out if isinstance(o.message, m.Submap))
        return next(found, None)

    def put(self, out: list[Outgoing]) -> list[Outgoing]:
        """What of it may go out now."""
        if not self.waits:
            return out
        self._out += out
        self.greeted.clear()
        return []

    def released(self) -> list[Outgoing]:
        """All of it, to be sent."""
        out, self._out = self._out, []
        return out

    def ended_ns(self) -> int | None:
        """When the window of the oldest one ended; None: nothing is held."""
        found = (o.message.stamp_ns for o in self._out if isinstance(o.message, m.Submap))
        return next(found, None)
