"""JSON Schemas of the messages, so that a log explains itself to any MCAP viewer.

A schema describes the MessagePack array position by position. Fields that say
`contentEncoding: base64` travel as MessagePack `bin`: little-endian numbers, see docs/wire.md.
"""

import json

import msgspec

from team.wire.messages import Message


def schema_of(message: type[Message]) -> bytes:
    """The JSON Schema of one message as UTF-8 bytes, the same for the same class."""
    return json.dumps(msgspec.json.schema(message), sort_keys=True).encode()
