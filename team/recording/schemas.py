"""JSON Schemas of the messages, for any MCAP viewer.

A schema describes the MessagePack array by position. Fields with `contentEncoding: base64` are
`bin` of little-endian numbers, see docs/wire.md.
"""

import json
from importlib import import_module
from typing import NamedTuple

import msgspec

from teamslam.team.wire.channels import channel_of
from teamslam.team.wire.messages import Message, tag_of
from teamslam.team.wire.views import json_schema, view_of


def schema_of(message: type[Message]) -> bytes:
    """Return the JSON Schema of a message as UTF-8 bytes, deterministic."""
    return json.dumps(msgspec.json.schema(message), sort_keys=True).encode()


class Declaration(NamedTuple):
    """A key's payload encoding, schema name and text."""

    encoding: str
    schema: str
    schema_encoding: str
    text: bytes


def declaration_of(key: str, tag: str = "") -> Declaration | None:
    """Return the declaration of a relative key, for a message's tag if it has several; None: no
    row.
    """
    found = channel_of(key)
    if found is not None:
        kind = found[0].kind_of(tag)
        return Declaration("msgpack", tag_of(kind), "jsonschema", schema_of(kind))
    view = view_of(key)
    if view is None:
        return None
    if isinstance(view.schema, str):
        from mcap_protobuf.schema import build_file_descriptor_set  # needed for views only

        name = view.schema.removeprefix("foxglove.")
        kind_there = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
        files = build_file_descriptor_set(kind_there).SerializeToString()
        return Declaration("protobuf", view.schema, "protobuf", files)
    name = f"teamslam.{view.schema.__name__}"
    text = json.dumps(json_schema(view.schema), sort_keys=True).encode()
    return Declaration("json", name, "jsonschema", text)
