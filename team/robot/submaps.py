"""The robot's submaps: each is held once, as the message that carries it.

A centre that is started again may ask for all of them (`SubmapsRequest`), so they are kept as
compact as they were sent; the robot's own pose in the team's map decodes the few that it needs.

Under `rendezvous` closed submaps are buffered until the robot encounters a teammate (Xu, 5.1;
Downs, 4.3). Only the observing robot of the two notices the encounter: it announces it, and both
release their buffered submaps. This changes when a submap is sent, never its content: the final map
is that of a continuous exchange.
"""

from bisect import insort
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import overload

from team import translate
from team.config import Exchange
from team.estimation.submap import LocalMap
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import decoded, encoded


@dataclass
class _Stream:
    """The messages for fusion of one incarnation: submaps by sequence, each behind its factors."""

    start: m.InitialPose | None = None
    submaps: dict[int, m.Submap] = field(default_factory=dict)
    factors: dict[int, list[m.SightingFactor]] = field(default_factory=dict)

    def from_sequence(self, first: int) -> Iterator[m.Submap | m.SightingFactor]:
        """The factors, then the submaps, from this sequence on."""
        for sequence in sorted(self.factors):
            if sequence >= first:
                yield from self.factors[sequence]
        yield from (self.submaps[k] for k in sorted(self.submaps) if k >= first)


class Submaps(Sequence[LocalMap]):
    """The messages for fusion of one robot, and its incarnation's submaps as a sequence of maps.

    The sequence has the submaps' landmarks with identities; an item is decoded when it is read.
    buffers: whether submaps wait for an encounter. sent: number of submaps of the incarnation that
    were sent, also by an earlier process.
    """

    def __init__(self, robot: str, exchange: Exchange) -> None:
        self.buffers = exchange == "rendezvous"
        self._robot = robot
        self._greeted: set[str] = set()  # told of an encounter since the last window ended
        self._streams: dict[int, _Stream] = {}
        self._newest = _Stream()
        self.sent = 0

    def begin(self, start: m.InitialPose) -> None:
        """Begin an incarnation."""
        self._newest = self._streams[start.incarnation] = _Stream(start)
        self.sent = 0

    def restore(self, message: m.Message) -> None:
        """Store a message that an earlier process has sent; the newest incarnation has begun."""
        if isinstance(message, m.InitialPose | m.Submap | m.SightingFactor):
            stream = self._streams.setdefault(message.incarnation, _Stream())
            match message:
                case m.InitialPose():
                    stream.start = message
                case m.Submap():
                    stream.submaps[message.sequence] = message
                case m.SightingFactor():
                    factors = stream.factors.setdefault(message.sequence, [])
                    if message not in factors:
                        insort(factors, message, key=lambda each: (each.stamp_ns, each.teammate))
        self.sent = len(self._newest.submaps)

    def close(self, factors: Sequence[m.SightingFactor], submap: m.Submap) -> list[Outgoing]:
        """Store a window's messages; returns those that go out now."""
        if factors:
            self._newest.factors[submap.sequence] = list(factors)
        self._newest.submaps[submap.sequence] = submap
        self._greeted.clear()
        return [] if self.buffers else self._take_unsent()

    def _take_unsent(self) -> list[Outgoing]:
        out: list[Outgoing] = []
        for sequence in range(self.sent, len(self)):
            factors = self._newest.factors.get(sequence, ())
            out += (Outgoing(ch.SIGHTING_FACTOR, self._robot, each) for each in factors)
            out.append(Outgoing(ch.SUBMAP, self._robot, self._newest.submaps[sequence]))
        self.sent = len(self)
        return out

    @property
    def since_ns(self) -> int | None:
        """Start of the oldest buffered window; None where nothing is buffered."""
        return None if self.sent == len(self) else self._newest.submaps[self.sent].start_ns

    @property
    def last(self) -> m.Submap | None:
        """The newest submap of the incarnation."""
        return self._newest.submaps[len(self) - 1] if len(self) else None

    def release(self, seen: tuple[str, ...], now_ns: int) -> list[Outgoing]:
        """Release the buffered messages behind an announcement, at an encounter or at the end.

        seen: the teammates that are to release theirs, too. Nothing where no message would be new.
        """
        count, start = len(self) - self.sent, self._newest.start
        if start is None or not self.buffers or not (count or set(seen) - self._greeted):
            return []
        self._greeted.update(seen)
        waited_ns = now_ns - self._newest.submaps[self.sent].stamp_ns if count else 0
        announced = m.Rendezvous(
            stamp_ns=now_ns,
            robot=self._robot,
            incarnation=start.incarnation,
            teammates=seen,
            submaps=count,
            waited_s=max(0.0, 1e-9 * waited_ns),
        )
        return [Outgoing(ch.RENDEZVOUS, self._robot, announced), *self._take_unsent()]

    def answer(self, request: bytes) -> list[bytes]:
        """Answer `SubmapsRequest`: everything sent for fusion, also by an earlier process."""
        requested = decoded(request, m.SubmapsRequest)
        if requested.robot != self._robot:
            return []
        return [encoded(message) for message in self._answer(requested)]

    def _answer(self, request: m.SubmapsRequest) -> Iterator[m.Message]:
        """The initial pose of each incarnation, then its factors and submaps by sequence."""
        every = request.incarnation == 0
        for incarnation in sorted(self._streams) if every else [request.incarnation]:
            stream = self._streams.get(incarnation, _Stream())
            if stream.start is not None:
                yield stream.start
            for message in stream.from_sequence(0 if every else request.first):
                if stream is not self._newest or message.sequence < self.sent:
                    yield message

    def __len__(self) -> int:
        return len(self._newest.submaps)

    @overload
    def __getitem__(self, index: int) -> LocalMap: ...
    @overload
    def __getitem__(self, index: slice) -> list[LocalMap]: ...
    def __getitem__(self, index: int | slice) -> LocalMap | list[LocalMap]:
        """The local maps of submaps of this incarnation, decoded."""
        submaps = self._newest.submaps
        if isinstance(index, slice):
            numbers = range(*index.indices(len(submaps)))
            return [translate.local_map_of(submaps[k]).named for k in numbers]
        return translate.local_map_of(submaps[range(len(submaps))[index]]).named
