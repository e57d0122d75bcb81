"""A log as CSV: one table per channel, one row per message, numbers that read back exactly.

Columns: key, counter, wall_ns, then the message's fields by name. An array is its numbers with
spaces between them, a digest hexadecimal, a list or a table JSON.
"""

import csv
import json
from collections.abc import Callable, Collection
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from numpy.typing import NDArray

from team.recording.reader import Log
from team.wire.arrays import floats, ids, stamps
from team.wire.bus import opened
from team.wire.channels import Channel, channel_of
from team.wire.codec import WireError
from team.wire.messages import Digest, Message

_HEAD = ("key", "counter", "wall_ns")
_ARRAYS: dict[str, Callable[[bytes, str], NDArray[Any]]] = {
    "ids": ids,
    "stamps": stamps,
    "nodes": stamps,
}
"""How the bytes of a field are read by its name; all others are floats."""


class Exported(NamedTuple):
    """The rows of each file that was written, and messages that no file has: not sound."""

    rows: dict[Path, int]
    unsound: int


def export_csv(log: Log, folder: Path, channels: Collection[Channel] | None = None) -> Exported:
    """Write `<channel>.csv` of each channel (of all without) that has a message into `folder`.

    A viewer's own messages have no fields that this program knows: they are left out. Raises
    `LogError` for a damaged log, OSError where the folder can not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows: dict[Path, int] = {}
    unsound = 0
    with ExitStack() as files:
        writers: dict[str, tuple[Path, Any]] = {}  # csv keeps its writer's type to itself
        for sample in log.samples(channels):
            if channel_of(sample.key) is None:
                continue
            try:
                channel, _, message = opened(sample)
            except WireError:
                unsound += 1
                continue
            if channel.name not in writers:
                path = folder / f"{channel.name}.csv"
                file = files.enter_context(path.open("w", newline="", encoding="utf-8"))
                writers[channel.name] = (path, csv.writer(file, lineterminator="\n"))
                writers[channel.name][1].writerow((*_HEAD, *message.__struct_fields__))
            path, writer = writers[channel.name]
            writer.writerow((sample.key, sample.counter, sample.wall_ns, *_cells(message)))
            rows[path] = rows.get(path, 0) + 1
    return Exported(rows, unsound)


def _cells(message: Message) -> list[str]:
    return [
        _cell(field.name, field.type, getattr(message, field.name))
        for field in msgspec.structs.fields(message)
    ]


def _cell(name: str, kind: object, value: object) -> str:
    match value:
        case bytes() if kind == Digest:
            return value.hex()
        case bytes():
            return " ".join(map(repr, _ARRAYS.get(name, floats)(value, name).tolist()))
        case str():
            return value
        case bool() | tuple() | dict():
            return json.dumps(msgspec.to_builtins(value))
        case _:
            return repr(value)
