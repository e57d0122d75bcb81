"""A second reader of ROS 2 bags: definitions and CDR of a bag's MCAP file, without rosbags."""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

FORMATS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
FIELD = re.compile(r"([\w/]+)(\[\d*\])?\s+([a-z]\w*)$")
Definitions = dict[str, list[tuple[str, str | None, str]]]


def definitions(kind: str, text: str) -> Definitions:
    """Fields (type, array, name) of a type and of all that it contains, without constants."""
    found: Definitions = {}
    for k, part in enumerate(re.split(r"^=+\n", text, flags=re.MULTILINE)):
        lines = [line.split("#")[0].strip() for line in part.splitlines()]
        name = kind if k == 0 else lines.pop(0).removeprefix("MSG: ")
        fields = found.setdefault(name.replace("/msg/", "/"), [])
        for line in lines:
            if line and "=" not in line:
                field = FIELD.match(line)
                assert field is not None, line
                fields.append((field[1], field[2], field[3]))
    return found


class Cdr:
    """Little-endian XCDR1; alignment is relative to the end of the header of 4 bytes."""

    def __init__(self, data: bytes, known: Definitions) -> None:
        assert data[:4] == b"\0\1\0\0"
        self.rest, self.at, self.known = data[4:], 0, known

    def scalar(self, form: str) -> Any:
        size = struct.calcsize(form)
        self.at += -self.at % size
        self.at += size
        return struct.unpack_from(f"<{form}", self.rest, self.at - size)[0]

    def value(self, kind: str, package: str) -> Any:
        if kind in FORMATS:
            return self.scalar(FORMATS[kind])
        if kind == "string":
            size = self.scalar("I")
            self.at += size
            assert self.rest[self.at - 1] == 0
            return self.rest[self.at - size : self.at - 1].decode()
        names = kind, f"{package}/{kind}", f"std_msgs/{kind}"
        (name,) = [each for each in names if each in self.known][:1]
        return self.message(name)

    def message(self, name: str) -> dict[str, Any]:
        out = {}
        for kind, array, field in self.known[name]:
            package = name.split("/")[0]
            if array is None:
                out[field] = self.value(kind, package)
            else:
                count = int(array[1:-1]) if array != "[]" else self.scalar("I")
                out[field] = [self.value(kind, package) for _ in range(count)]
        return out


def messages(bag: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Topic, log time [ns] and decoded message; every byte must belong to a field."""
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            cdr = Cdr(message.data, definitions(schema.name, schema.data.decode()))
            found = cdr.message(schema.name.replace("/msg/", "/"))
            assert not cdr.rest[cdr.at :].strip(b"\0"), channel.topic
            yield channel.topic, message.log_time, found
