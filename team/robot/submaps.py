"""The robot's submaps, each stored once, as its message's payload.

A restarted centre may request all of them (`SubmapsRequest`); the pose in the team's map decodes
the few that it needs.

Under `rendezvous` closed submaps are buffered until the robot encounters a teammate (Xu, 5.1;
Downs, 4.3). The observer announces the encounter, and both release their buffers. This changes when
a submap is sent, never its content.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import overload

import msgspec

from teamslam.team import translate
from teamslam.team.config import Exchange
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import decoded, encoded

_SUBMAP = msgspec.msgpack.Decoder(m.Submap)
"""Decodes without the checks of `decoded`: the payloads are this robot's own."""


@dataclass
class _Stream:
    """Payloads of one incarnation: submaps and their factors, by sequence."""

    start: bytes | None = None
    submaps: dict[int, bytes] = field(default_factory=dict)
    factors: dict[int, list[bytes]] = field(default_factory=dict)

    def submap(self, sequence: int) -> m.Submap:
        message: m.Submap = _SUBMAP.decode(self.submaps[sequence])
        return message

    def between(self, first: int, end: int) -> Iterator[bytes]:
        for sequence in sorted(self.factors):
            if first <= sequence < end:
                yield from self.factors[sequence]
        yield from (self.submaps[k] for k in sorted(self.submaps) if first <= k < end)


class Submaps(Sequence[LocalMap]):
    """The messages for fusion of one robot, and its incarnation's submaps as a sequence of maps.

    Items have the landmarks with identities, and are decoded when read. buffers: submaps wait for
    an encounter. sent: number of those sent, with those of an earlier process.
    """

    def __init__(self, robot: str, exchange: Exchange) -> None:
        self.buffers = exchange == "rendezvous"
        self._robot = robot
        self._greeted: set[str] = set()  # with an announced encounter since the last window
        self._streams: dict[int, _Stream] = {}
        self._newest, self._incarnation = _Stream(), 0
        self.sent = 0

    def begin(self, start: m.InitialPose) -> None:
        """Begin an incarnation."""
        self._newest = self._streams[start.incarnation] = _Stream(encoded(start))
        self._incarnation, self.sent = start.incarnation, 0

    def restore(self, message: m.Message) -> None:
        """Store a message of an earlier process in the newest incarnation."""
        if isinstance(message, m.InitialPose | m.Submap | m.SightingFactor):
            stream = self._streams.setdefault(message.incarnation, _Stream())
            payload = encoded(message)
            match message:
                case m.InitialPose():
                    stream.start = payload
                case m.Submap():
                    stream.submaps[message.sequence] = payload
                case m.SightingFactor():
                    factors = stream.factors.setdefault(message.sequence, [])
                    if payload not in factors:
                        factors.append(payload)
        self.sent = len(self._newest.submaps)

    def close(self, factors: Sequence[m.SightingFactor], submap: m.Submap) -> list[Outgoing]:
        """Store a window's messages; return those to send now."""
        if factors:
            self._newest.factors[submap.sequence] = [encoded(each) for each in factors]
        self._newest.submaps[submap.sequence] = encoded(submap)
        self._greeted.clear()
        if self.buffers:
            return []
        self.sent = len(self)
        return self._outgoing(factors, submap)

    def _outgoing(self, factors: Sequence[m.SightingFactor], submap: m.Submap) -> list[Outgoing]:
        out = [Outgoing(ch.SIGHTING_FACTOR, self._robot, each) for each in factors]
        return [*out, Outgoing(ch.SUBMAP, self._robot, submap)]

    @property
    def since_ns(self) -> int | None:
        """Start of the oldest buffered window, if any."""
        return None if self.sent == len(self) else self._newest.submap(self.sent).start_ns

    @property
    def last(self) -> m.Submap | None:
        """Newest submap of the incarnation."""
        return self._newest.submap(len(self) - 1) if len(self) else None

    def release(self, seen: tuple[str, ...], now_ns: int) -> list[Outgoing]:
        """Release the buffered messages after an announcement, at an encounter or the end.

        seen: teammates that are to release theirs, too. Empty if no message would be new.
        """
        stream, buffered = self._newest, range(self.sent, len(self))
        if not self.buffers or not (buffered or set(seen) - self._greeted):
            return []
        self._greeted.update(seen)
        waited_ns = now_ns - stream.submap(self.sent).stamp_ns if buffered else 0
        announced = m.Rendezvous(
            stamp_ns=now_ns,
            robot=self._robot,
            incarnation=self._incarnation,
            teammates=seen,
            submaps=len(buffered),
            waited_s=max(0.0, 1e-9 * waited_ns),
        )
        released = [Outgoing(ch.RENDEZVOUS, self._robot, announced)]
        for sequence in buffered:
            factors = [decoded(x, m.SightingFactor) for x in stream.factors.get(sequence, ())]
            released += self._outgoing(factors, stream.submap(sequence))
        self.sent = len(self)
        return released

    def answer(self, request: bytes) -> list[bytes]:
        """Answer with everything sent for fusion, by earlier processes too."""
        requested = decoded(request, m.SubmapsRequest)
        return [*self._answer(requested)] if requested.robot == self._robot else []

    def _answer(self, request: m.SubmapsRequest) -> Iterator[bytes]:
        every = request.incarnation == 0
        for incarnation in sorted(self._streams) if every else [request.incarnation]:
            stream = self._streams.get(incarnation, _Stream())
            if stream.start is not None:
                yield stream.start
            end = self.sent if stream is self._newest else len(stream.submaps)
            yield from stream.between(0 if every else request.first, end)

    def __len__(self) -> int:
        return len(self._newest.submaps)

    @overload
    def __getitem__(self, index: int) -> LocalMap: ...
    @overload
    def __getitem__(self, index: slice) -> list[LocalMap]: ...
    def __getitem__(self, index: int | slice) -> LocalMap | list[LocalMap]:
        """Decode the local maps of this incarnation's submaps."""
        numbers = range(len(self))[index]
        if isinstance(numbers, int):
            return translate.local_map_of(self._newest.submap(numbers)).named
        return [translate.local_map_of(self._newest.submap(k)).named for k in numbers]
