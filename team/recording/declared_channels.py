"""Encoding and schema that a log declares for each key."""

import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from teamslam.team.recording.reader import Log
from teamslam.team.recording.records import (
    MALFORMED,
    Frame,
    LogError,
    expand_chunk,
    read_frames,
    read_records,
)
from teamslam.team.recording.schemas import schema_of
from teamslam.team.wire.channels import VIEW, channel_of
from teamslam.team.wire.messages import Message, tag_of


class Declared(NamedTuple):
    """A key's declaration; the schema name may be empty."""

    key: str
    encoding: str
    schema: str
    text: bytes


def read_declarations(log: Log) -> dict[str, Declared]:
    """Return the last declaration of each key; damaged parts are skipped."""
    found: dict[str, Declared] = {}
    for each in log.files:
        _declared_in(each.path, log.team, found)
    return found


def _declared_in(path: Path, team: str, found: dict[str, Declared]) -> None:
    schemas: dict[int, tuple[str, bytes]] = {0: ("", b"")}
    for frame in _declarations(path):
        stream = ReadDataStream(BytesIO(frame.body))
        try:
            if frame.opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                schemas[schema.id] = (schema.name, schema.data)
            else:
                channel = Channel.read(stream)
                key = channel.topic.removeprefix(f"team/{team}/")
                named = schemas.get(channel.schema_id, ("", b""))
                found[key] = Declared(key, channel.message_encoding, *named)
        except MALFORMED:
            continue


def find_misdeclaration(of: Declared) -> str | None:
    """Return the defect of a key's declaration, or None.

    Later versions may append fields: the shorter field list must be a prefix of the longer.
    """
    row = channel_of(of.key)
    if row is None:
        return None if VIEW.owner(of.key) is not None else "no channel has this key"
    kind = row[0].kind_of(of.schema)
    if (of.encoding, of.schema) != ("msgpack", tag_of(kind)):
        stated = f"{of.encoding or 'no encoding'}, {of.schema or 'no schema'}"
        return f"declared as {stated}; its messages are msgpack, {tag_of(kind)}"
    ours, theirs = _fields(schema_of(kind), kind), _fields(of.text, kind)
    shared = min(len(ours), len(theirs))
    if not theirs or ours[:shared] != theirs[:shared]:
        return f"its schema is not that of {tag_of(kind)}"
    return None


def _fields(text: bytes, kind: type[Message]) -> list[Any]:
    try:
        fields = json.loads(text)["$defs"][kind.__name__]["prefixItems"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return []
    return fields if isinstance(fields, list) else []


def _declarations(path: Path) -> Iterator[Frame]:
    opcodes = (Opcode.SCHEMA, Opcode.CHANNEL)
    with path.open("rb") as file:
        try:
            for frame in read_frames(file, path):
                if frame.opcode in opcodes:
                    yield frame
                elif frame.opcode == Opcode.CHUNK:
                    try:
                        every = read_records(expand_chunk(frame.body))
                        inside = [each for each in every if each.opcode in opcodes]
                    except (*MALFORMED, ValueError, zstandard.ZstdError):
                        continue
                    yield from inside
        except LogError:
            return
