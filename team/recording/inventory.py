"""Numbered streams of a log: present and missing numbers.

A source numbers measurements across all sensor channels of a robot; the robot numbers submaps.
Ends, heads and progress name totals, so numbers missing at a stream's end are detected.
"""

from array import array
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Literal, NamedTuple
from zlib import crc32

import msgspec

from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import NO_COUNTER, Sample, try_open
from teamslam.team.wire.intervals import describe_intervals

NUMBERED = (*ch.SENSORS, ch.SUBMAP)
"""Channels with numbered messages, which the recorder reports as progress."""


@dataclass
class _Run:
    """Samples with counters first … end − 1 and wall clocks [ns] first_ns … last_ns."""

    first: int
    end: int
    first_ns: int
    last_ns: int


class Received:
    """Received counters of each key that its publisher caches, in runs of one process."""

    def __init__(self) -> None:
        self._runs: dict[str, list[_Run]] = defaultdict(list)

    def take(self, sample: Sample) -> None:
        """Register a sample; a repetition changes nothing."""
        found = ch.channel_of(sample.key)
        if sample.counter == NO_COUNTER or found is None or not _is_acknowledged(found[0]):
            return
        runs, counter, wall_ns = self._runs[sample.key], sample.counter, sample.wall_ns
        if any(r.first <= counter < r.end and r.first_ns <= wall_ns <= r.last_ns for r in runs):
            return
        if runs and runs[-1].end == counter and runs[-1].last_ns <= wall_ns:
            runs[-1].end, runs[-1].last_ns = counter + 1, wall_ns
        else:
            runs.append(_Run(counter, counter + 1, wall_ns, wall_ns))

    def of_process(self, key: str, since_ns: int) -> tuple[int, int]:
        """Return the number of samples of the process that began then, and its next counter."""
        runs = [run for run in self._runs.get(key, ()) if run.first_ns >= since_ns]
        return sum(run.end - run.first for run in runs), max((run.end for run in runs), default=0)

    def lacking(self, tally: m.Tally, awaited: set[str]) -> dict[str, int]:
        """Return the keys of a process with missing samples, each with the number received.

        awaited: keys that may still have samples; others need only the newest.
        """
        found = {}
        for key, count in zip(tally.keys, tally.counts, strict=True):
            row = ch.channel_of(key)
            if row is None or not _is_acknowledged(row[0]):
                continue
            number, end = self.of_process(key, tally.since_ns)
            if number < count and (end < count or key in awaited):
                found[key] = number
        return found


def _is_acknowledged(channel: ch.Channel) -> bool:
    return channel.recorded and channel.delivery != "stream" and channel not in NUMBERED


MISSING = "missing: "  # prefix of the recorder's last note, which lists missing messages
Kind = Literal["measurements", "submaps"]
_ASKED_FOR = (ch.SIGHTING_FACTOR, *ch.REPLIES[ch.KEPT])
"""Channels without numbers, sent as replies; repetitions are recognised by their content."""
_TOTALS = (ch.ROBOT_PROGRESS, ch.ROBOT_DONE, ch.END, ch.HEAD, ch.ROBOT_HEAD)
"""Channels whose messages name totals."""
_Role = Literal["measurements", "submaps", "reply", "totals", ""]


class NumberedStream(NamedTuple):
    """Measurements or submaps of one incarnation of a robot."""

    kind: Kind
    robot: str
    incarnation: int


@dataclass
class Numbered:
    """Present numbers of a stream, each with a payload checksum; newest: the last known number."""

    newest: int = -1
    count: int = 0
    contradicted: int = 0
    _sums: "array[int]" = field(default_factory=lambda: array("I"), init=False)
    _beyond: dict[int, int] = field(default_factory=dict, init=False)

    @property
    def whole(self) -> int:
        """First missing number."""
        return len(self._sums)

    def take(self, number: int, payload: bytes) -> bool:
        """Add a payload; return False if present with the same content."""
        found, sums, beyond = crc32(payload), self._sums, self._beyond
        whole = len(sums)
        there = sums[number] if number < whole else beyond.get(number)
        if there is not None:
            self.contradicted += there != found
            return there != found
        self.count += 1
        self.newest = max(self.newest, number)
        if number > whole:
            beyond[number] = found
            return True
        sums.append(found)
        while beyond and (following := beyond.pop(len(sums), None)) is not None:
            sums.append(following)
        return True

    @property
    def missing(self) -> list[tuple[int, int]]:
        """Intervals of known, missing numbers."""
        here = sorted(self._beyond)
        begins = [self.whole, *(number + 1 for number in here)]
        ends = [*(number - 1 for number in here), self.newest]
        return [(b, e) for b, e in zip(begins, ends, strict=True) if b <= e]


@dataclass
class Inventory:
    """Numbered streams of a log, sample by sample; earlier parts' messages may be repeated."""

    has_earlier_parts: bool = False
    streams: dict[NumberedStream, Numbered] = field(default_factory=lambda: defaultdict(Numbered))
    received: Received = field(default_factory=Received, init=False)
    _earlier: set[int] = field(default_factory=set, init=False)
    _contents: set[int] = field(default_factory=set, init=False)

    def remember(self, sample: Sample) -> None:
        """Add a sample of an earlier part, which may be repeated."""
        self._earlier.add(_name(sample))
        self.received.take(sample)
        self.take(sample)

    def is_new(self, sample: Sample) -> bool:
        """Add a sample; return False if this log or an earlier part has it."""
        self.received.take(sample)
        if self.has_earlier_parts:
            name = _name(sample)
            if name in self._earlier and sample.counter != NO_COUNTER:
                return False
            self._earlier.add(name)
        return self.take(sample)

    def take(self, sample: Sample) -> bool:
        """Add a sample; return False if its stream has it."""
        role, robot = _role_of(sample.key)
        if role == "measurements" or role == "submaps":
            named = numbered_in(sample.payload)
            if named is None:
                return True
            stream = NumberedStream(role, robot, named.incarnation)
            return self.streams[stream].take(named.number, sample.payload)
        if role == "reply":
            name = hash((sample.key, sample.payload))
            known = name in self._contents
            self._contents.add(name)
            return not known
        if role == "totals":
            self._note_totals(sample)
        return True

    def _note_totals(self, sample: Sample) -> None:
        found = try_open(sample)
        match None if found is None else found[2]:  # reported by the message's reader
            case m.Progress() | m.Done() as counted:
                self._note_total("measurements", counted, counted.measurements)
                self._note_total("submaps", counted, counted.submaps)
            case m.StreamHead() as head:
                self._note_total("measurements", head, head.measurements)
            case m.End() as ended:
                for end in ended.streams:
                    self._note_total("measurements", end, end.measurements)

    def _note_total(
        self, kind: Kind, of: m.Progress | m.Done | m.StreamHead | m.StreamEnd, count: int
    ) -> None:
        stream = self.streams[NumberedStream(kind, of.robot, of.incarnation)]
        stream.newest = max(stream.newest, count - 1)

    def counts(self) -> dict[tuple[str, int], tuple[int, int]]:
        """Count present measurements and submaps by (robot, incarnation)."""
        found: dict[tuple[str, int], tuple[int, int]] = {}
        for (kind, robot, incarnation), each in self.streams.items():
            measurements, submaps = found.get((robot, incarnation), (0, 0))
            own = (each.count, submaps) if kind == "measurements" else (measurements, each.count)
            found[robot, incarnation] = own
        return found

    @property
    def gaps(self) -> dict[NumberedStream, int]:
        """First missing number of each incomplete stream."""
        return {
            name: each.whole for name, each in self.streams.items() if each.newest >= each.whole
        }

    def span(self, stream: NumberedStream) -> tuple[int, int]:
        """Return the first and last missing number of an incomplete stream."""
        missing = self.streams[stream].missing
        return missing[0][0], missing[-1][1]

    def findings(self) -> Iterator[tuple[str, str]]:
        """Yield missing numbers, and numbers with different contents: key and description."""
        for (kind, robot, incarnation), found in sorted(self.streams.items()):
            key = ch.SUBMAP.key(robot) if kind == "submaps" else f"source/{robot}"
            of = f"of incarnation {incarnation}"
            if missing := found.missing:
                lost = sum(last - first + 1 for first, last in missing)
                yield key, f"{lost} {kind} {of} missing: {describe_intervals(missing)}"
            if found.contradicted:
                yield key, f"{found.contradicted} {kind} {of} present twice with different contents"


def _name(sample: Sample) -> int:
    return hash((sample.key, sample.counter % 2**32, sample.wall_ns))


class Head(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """First fields of a numbered message."""

    tag: str
    stamp_ns: int
    robot: str
    incarnation: Annotated[int, msgspec.Meta(ge=0)]
    number: Annotated[int, msgspec.Meta(ge=0)]


_DECODER = msgspec.msgpack.Decoder(Head)


def numbered_in(payload: bytes) -> Head | None:
    """Return the head of a numbered message, or None."""
    try:
        return _DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


@lru_cache(maxsize=16_384)
def _role_of(key: str) -> tuple[_Role, str]:
    found = ch.channel_of(key)
    if found is None:
        return "", ""
    channel, robot = found
    if channel in _ASKED_FOR:
        return "reply", robot
    if channel is ch.SUBMAP:
        return "submaps", robot
    if channel in ch.SENSORS:
        return "measurements", robot
    return ("totals" if channel in _TOTALS else ""), robot
