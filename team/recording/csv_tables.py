"""Export a log as CSV: one table per channel, with exactly readable numbers.

Arrays are space-separated numbers, digests hexadecimal, lists and tables JSON.
"""

import csv
import json
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from teamslam.team.recording.reader import Log
from teamslam.team.recording.tables import HEAD, Exported, numbers_of, table_of
from teamslam.team.wire.channels import Channel
from teamslam.team.wire.messages import Digest, Message


def export_csv(log: Log, folder: Path, channels: Collection[Channel] | None = None) -> Exported:
    """Write `<channel>.csv` for each non-empty channel (None: all) into `folder`.

    Raises `LogError` for a damaged log, OSError for an unwritable folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    exported = Exported()
    with ExitStack() as files:
        writers: dict[str, tuple[Path, Any]] = {}  # csv does not export its writer's type
        for sample, channel, message in exported.messages(log, channels):
            name = table_of(channel, message)
            if name not in writers:
                path = folder / f"{name}.csv"
                file = files.enter_context(path.open("w", newline="", encoding="utf-8"))
                writers[name] = (path, csv.writer(file, lineterminator="\n"))
                writers[name][1].writerow((*HEAD, *message.__struct_fields__))
            path, writer = writers[name]
            writer.writerow((sample.key, sample.counter, sample.wall_ns, *_cells(message)))
            exported.rows[path] = exported.rows.get(path, 0) + 1
    return exported


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
            return " ".join(map(repr, numbers_of(name, value).tolist()))
        case str():
            return value
        case bool() | tuple() | dict() | msgspec.Struct():
            return json.dumps(msgspec.to_builtins(value))
        case _:
            return repr(value)
