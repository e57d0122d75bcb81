"""A log as tables: one per channel, one row per message, whatever the file format.

Columns: key, counter, wall_ns, then the message's fields by name.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from team.recording.reader import Log
from team.wire.arrays import floats, ids, octets, stamps
from team.wire.bus import Sample, opened
from team.wire.channels import Channel, channel_of
from team.wire.codec import WireError
from team.wire.messages import Message, tag_of

HEAD = ("key", "counter", "wall_ns")
_ARRAYS: dict[str, Callable[[bytes, str], NDArray[Any]]] = {
    "ids": ids,
    "stamps": stamps,
    "nodes": stamps,
    "counts": ids,
    "labels": ids,
    "landmarks": ids,
    "rows": ids,
    "seen": octets,
    "pairs": octets,
    "certificate": octets,
    "signature": octets,
    "sha256": octets,
}
"""The decoder of a field's bytes, by the field's name; all other fields are floats."""


@dataclass
class Exported:
    """The number of rows of each written file, and of unsound messages, which are in no file."""

    rows: dict[Path, int] = field(default_factory=dict)
    unsound: int = 0

    def messages(
        self, log: Log, channels: Collection[Channel] | None
    ) -> Iterator[tuple[Sample, Channel, Message]]:
        """Every sound message of the given channels (None: all); the others are counted.

        Views have no fields of the team's messages and are left out.
        """
        for sample in log.samples(channels):
            if channel_of(sample.key) is None:
                continue
            try:
                channel, _, message = opened(sample)
            except WireError:
                self.unsound += 1
                continue
            yield sample, channel, message


def table_of(channel: Channel, message: Message) -> str:
    """The table's name: the channel's; of an alternative message on its key, the message's."""
    kind = type(message)
    return channel.name if kind is channel.message else tag_of(kind).partition("/")[0]


def numbers_of(name: str, value: bytes) -> NDArray[Any]:
    """The numbers in the bytes of a message's field."""
    return _ARRAYS.get(name, floats)(value, name)


def type_of_numbers(name: str) -> str:
    """The type of these numbers, in NumPy's notation."""
    return str(numbers_of(name, b"").dtype)
