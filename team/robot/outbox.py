"""What a robot sends for fusion: buffered until an encounter, and kept for later requests.

Under `rendezvous` closed submaps are buffered until the robot encounters a teammate (Xu, 5.1;
Downs, 4.3). Only the observing robot of the two notices the encounter: it announces it, and both
release their buffered submaps. This changes when a submap is sent, never its content: the final map
is that of a continuous exchange.
"""

from collections.abc import Sequence

from team.config import Exchange
from team.robot.sent import Sent
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import decoded, encoded


class Outbox:
    """Initial poses, submaps and inter-robot factors of one robot, in their order.

    buffers: whether submaps wait for an encounter.
    """

    def __init__(self, robot: str, exchange: Exchange) -> None:
        self.buffers = exchange == "rendezvous"
        self._robot = robot
        self._sent = Sent()
        self._greeted: set[str] = set()  # told of an encounter since the last window ended
        self._buffered: list[Outgoing] = []
        self._submaps: list[m.Submap] = []

    @property
    def submaps(self) -> int:
        """Number of buffered submaps."""
        return len(self._submaps)

    @property
    def since_ns(self) -> int | None:
        """Start of the oldest buffered window; None where nothing is buffered."""
        return next((submap.start_ns for submap in self._submaps), None)

    def put(self, out: list[Outgoing]) -> list[Outgoing]:
        """Take a window's messages; returns those that go out now."""
        if self.buffers:
            self._buffered += out
            self._submaps += [each.message for each in out if isinstance(each.message, m.Submap)]
            self._greeted.clear()
            return []
        self._note(out)
        return out

    def release(self, seen: tuple[str, ...], now_ns: int, incarnation: int) -> list[Outgoing]:
        """Release the buffered messages behind an announcement, at an encounter or at the end.

        seen: the teammates that are to release theirs, too. Nothing where no message would be new.
        """
        submaps = self._submaps
        if not self.buffers or not (submaps or set(seen) - self._greeted):
            return []
        self._greeted.update(seen)
        announced = m.Rendezvous(
            stamp_ns=now_ns,
            robot=self._robot,
            incarnation=incarnation,
            teammates=seen,
            submaps=len(submaps),
            waited_s=max(0.0, 1e-9 * (now_ns - submaps[0].stamp_ns)) if submaps else 0.0,
        )
        released, self._buffered, self._submaps = self._buffered, [], []
        self._note(released)
        return [Outgoing(ch.RENDEZVOUS, self._robot, announced), *released]

    def keep(self, message: m.Message) -> None:
        """Keep a message for fusion that is sent otherwise, or was sent by an earlier process."""
        self._sent.take(message)

    def _note(self, out: Sequence[Outgoing]) -> None:
        for each in out:
            self._sent.take(each.message)

    def answer(self, request: bytes) -> list[bytes]:
        """The answer to `SubmapsRequest`: everything sent for fusion, also by an earlier
        process.
        """
        requested = decoded(request, m.SubmapsRequest)
        if requested.robot != self._robot:
            return []
        return [encoded(message) for message in self._sent.answer(requested)]
