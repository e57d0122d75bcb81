"""Buffer the messages of a live robot's topics for its driver, and count the lost ones.

rmw_zenoh attaches to each publication its publisher's counter and name, in one of two forms:

  "sequence_number" int64 "source_timestamp" int64 "source_gid" bytes     each text and the bytes
  int64 int64 bytes                                                       behind their length

A skipped number is a lost message. A bridge attaches none.
"""

import struct
import time
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from typing import NamedTuple

MOST_WAITING = 100_000  # most waiting messages of a topic; then the oldest is dropped, and counted
MOST_PUBLISHERS = 256
MOST_SKIPPED = 1_000_000  # a counter that jumps farther has begun anew, or is no counter
_NAMED = struct.Struct("<x15sqx16sqx10sx16s")
_PLAIN = struct.Struct("<qqx16s")
_NAMES = (b"sequence_number", b"source_timestamp", b"source_gid")


def number_of(attachment: bytes) -> tuple[bytes, int] | None:
    """Return a publisher's name and the number of its message, or None."""
    if len(attachment) == _NAMED.size:
        *fields, gid = _NAMED.unpack(attachment)
        return (gid, fields[1]) if tuple(fields[::2]) == _NAMES else None
    if len(attachment) == _PLAIN.size:
        number, _, gid = _PLAIN.unpack(attachment)
        return gid, number
    return None


def attachment(number: int, stamp_ns: int, gid: bytes) -> bytes:
    """Make the attachment of our publication, in the second form; gid: 16 bytes."""
    return struct.pack("<qqB16s", number, stamp_ns, len(gid), gid)


@dataclass
class Lost:
    """Number of lost messages by topic; numbered: messages with a known counter."""

    count: Counter[str] = field(default_factory=Counter)
    numbered: Counter[str] = field(default_factory=Counter)
    _last: OrderedDict[tuple[str, bytes], int] = field(default_factory=OrderedDict)

    def take(self, topic: str, attachment: bytes) -> None:
        """Count the numbers between the publisher's last message and this one."""
        named = number_of(attachment)
        if named is None:
            return
        gid, number = named
        self.numbered[topic] += 1
        last = self._last.pop((topic, gid), None)
        if last is not None and 1 < number - last <= MOST_SKIPPED:
            self.count[topic] += number - last - 1
        self._last[topic, gid] = number
        while len(self._last) > MOST_PUBLISHERS:
            self._last.popitem(last=False)


class Arrived(NamedTuple):
    """A message, and its time of arrival by the monotonic clock [s]."""

    kind: str
    payload: bytes
    at_s: float


@dataclass
class Backlog:
    """Messages that are not decoded yet, by topic in the order of arrival."""

    waiting: dict[str, deque[Arrived]] = field(default_factory=dict)
    dropped: Counter[str] = field(default_factory=Counter)

    def put(self, topic: str, kind: str, payload: bytes) -> None:
        """Append a message; the oldest of MOST_WAITING makes room."""
        queue = self.waiting.setdefault(topic, deque())
        if len(queue) >= MOST_WAITING:
            queue.popleft()
            self.dropped[topic] += 1
        queue.append(Arrived(kind, payload, time.monotonic()))

    def next_of(self, topic: str) -> Arrived | None:
        """Remove and return the oldest message of a topic."""
        queue = self.waiting.get(topic)
        return queue.popleft() if queue else None

    def __len__(self) -> int:
        return sum(map(len, self.waiting.values()))

    @property
    def oldest_s(self) -> float:
        """Waiting time of the oldest message [s]."""
        arrived = [queue[0].at_s for queue in self.waiting.values() if queue]
        return time.monotonic() - min(arrived) if arrived else 0.0
