"""A log as tables: one per channel, one row per message, in any file format.

Columns: key, counter, wall_ns, then the message's fields.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from teamslam.team.recording.reader import Log
from teamslam.team.wire.arrays import floats, ids, octets, stamps
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.channels import Channel, channel_of
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.messages import Message, tag_of

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
"""Decoder of a field's bytes by name; other fields are floats."""


@dataclass
class Exported:
    """Rows of each written file, and number of invalid messages, which are omitted."""

    rows: dict[Path, int] = field(default_factory=dict)
    unsound: int = 0

    def messages(
        self, log: Log, channels: Collection[Channel] | None
    ) -> Iterator[tuple[Sample, Channel, Message]]:
        """Valid messages of the channels (None: all), without views; others are counted."""
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
    """Table name: the channel's, or an alternative message's."""
    kind = type(message)
    return channel.name if kind is channel.message else tag_of(kind).partition("/")[0]


def numbers_of(name: str, value: bytes) -> NDArray[Any]:
    """Numbers in a field's bytes."""
    return _ARRAYS.get(name, floats)(value, name)


def type_of_numbers(name: str) -> str:
    """NumPy type of a field's numbers."""
    return str(numbers_of(name, b"").dtype)
