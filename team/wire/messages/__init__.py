"""The messages: frozen, versioned, positional; one module for each kind of publisher.

A message is a MessagePack array `[tag, field, field, …]`; `tag` is "name/version". A later program
may append fields with defaults; readers ignore further fields. A new meaning, unit or frame is a
new version. Arrays are `bin`: little-endian, C order, of the type `Floats`, `Ids` or `Stamps`. SI
units, radians, bearings in (−π, π].

`stamp_ns` is the team time of the measurement that the message is about. `check` raises
`ValueError` with the reason where the numbers do not fit the message.
"""

from teamslam.team.wire.messages.base import *
from teamslam.team.wire.messages.base import Message
from teamslam.team.wire.messages.maps import *
from teamslam.team.wire.messages.measurements import *
from teamslam.team.wire.messages.nodes import *
from teamslam.team.wire.messages.submaps import *


def _by_tag(base: type[Message]) -> dict[str, type[Message]]:
    found: dict[str, type[Message]] = {}
    for message in base.__subclasses__():
        tag = message.__struct_config__.tag
        if isinstance(tag, str):
            found[tag] = message
        found |= _by_tag(message)
    return found


BY_TAG = _by_tag(Message)
