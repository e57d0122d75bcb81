"""JSON Schemas of the messages, so that any MCAP viewer can interpret a log.

A schema describes the MessagePack array position by position. Fields with `contentEncoding: base64`
are encoded as MessagePack `bin`: little-endian numbers, see docs/wire.md.
"""

import json
from typing import NamedTuple

import msgspec

from team.wire.channels import channel_of
from team.wire.messages import Message, tag_of
from team.wire.views import json_schema, view_of


def schema_of(message: type[Message]) -> bytes:
    """The JSON Schema of one message as UTF-8 bytes, the same for the same class."""
    return json.dumps(msgspec.json.schema(message), sort_keys=True).encode()


class Declaration(NamedTuple):
    """How a log declares a key: the encoding of its payloads, and their schema's name and text."""

    encoding: str
    schema: str
    schema_encoding: str
    text: bytes


def declaration_of(key: str, tag: str = "") -> Declaration | None:
    """The declaration of a relative key of the team; None for a key without a row in the table.

    tag: of the message, where the key carries more than one type.
    """
    found = channel_of(key)
    if found is not None:
        kind = found[0].kind_of(tag)
        return Declaration("msgpack", tag_of(kind), "jsonschema", schema_of(kind))
    view = view_of(key)
    if view is None:
        return None
    if isinstance(view.schema, str):
        import foxglove.messages  # 50 ms that a log without views does not need

        kind_there = getattr(foxglove.messages, view.schema.removeprefix("foxglove."))
        schema = kind_there.get_schema()
        return Declaration(schema.encoding, schema.name, schema.encoding, schema.data)
    name = f"teamslam.{view.schema.__name__}"
    text = json.dumps(json_schema(view.schema), sort_keys=True).encode()
    return Declaration("json", name, "jsonschema", text)
