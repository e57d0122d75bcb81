"""Read the structure of a MessagePack payload without creating what it contains: the tag, and the
number and the nesting of its values.
"""

SMALL = 2**18
"""Payloads of up to so many bytes have too few values to matter."""
MOST_VALUES = 250_000
"""Largest number of values in a message; arrays of numbers are one value each."""
DEEPEST = 16
"""Deepest nesting of a message; the known ones have four levels."""
_LONGEST_TAG = 100
_INVALID = 0xC1
_SCALARS = {0xC0: 0, 0xC2: 0, 0xC3: 0, 0xCA: 4, 0xCB: 8,
            0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8}  # fmt: skip
"""By the code of a scalar, the number of bytes after it."""
_TEXTS = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
"""By the code of a `bin` or `str`, the number of bytes of its length."""
_GROUPS = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}
"""By the code of an array or a map, the number of bytes of its length, and the values an entry."""


class StructureError(ValueError):
    """A payload whose structure no message has; reason and detail as in `wire.codec`."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def read_tag(payload: bytes) -> str:
    """The tag with which a message begins; raises `StructureError` where there is none."""
    count, at = _group_at(payload)
    if count > MOST_VALUES:
        raise StructureError("too large", f"an array of {count} values, {MOST_VALUES} at most")
    if not count:
        raise _no_tag()
    code = _byte(payload, at)
    if code >> 5 == 0b101:
        size, at = code & 31, at + 1
    elif code in (0xD9, 0xDA, 0xDB):
        size, at = _length(payload, at + 1, _TEXTS[code])
    else:
        raise _no_tag(code)
    if len(payload) < at + size:
        raise _truncated()
    try:
        return payload[at : at + min(size, _LONGEST_TAG)].decode()
    except UnicodeDecodeError:
        raise StructureError("damaged", "a text is not UTF-8") from None


def check_structure(payload: bytes) -> None:
    """Raise `StructureError` where a payload has more values, or nests deeper, than any message.

    Bytes behind the message are not looked at.
    """
    at = values = 0
    left = [1]
    while left:
        if not left[-1]:
            left.pop()
            continue
        left[-1] -= 1
        inside, at = _value_at(payload, at)
        values += 1
        if values + inside > MOST_VALUES:
            raise StructureError("too large", f"more than {MOST_VALUES} values")
        if inside:
            left.append(inside)
        if len(left) > DEEPEST:
            raise StructureError("too deep", "nested beyond any message's structure")
    if at > len(payload):
        raise _truncated()


def _value_at(payload: bytes, at: int) -> tuple[int, int]:
    """The number of values within the value at a place, and the place behind its head, or behind
    it where there are none.
    """
    code = _byte(payload, at)
    at += 1
    if code < 0x80 or code >= 0xE0:
        return 0, at
    if code < 0x90:
        return 2 * (code & 15), at
    if code < 0xA0:
        return code & 15, at
    if code < 0xC0:
        return 0, at + (code & 31)
    if code in _SCALARS:
        return 0, at + _SCALARS[code]
    if code in _TEXTS:
        size, at = _length(payload, at, _TEXTS[code])
        return 0, at + size
    if code in _GROUPS:
        width, each = _GROUPS[code]
        size, at = _length(payload, at, width)
        return size * each, at
    raise StructureError("damaged", "a value of no message")


def _group_at(payload: bytes) -> tuple[int, int]:
    """The number of values of the array with which a payload begins, and the place of the first."""
    code = _byte(payload, 0)
    if code >> 4 == 0b1001:
        return code & 15, 1
    if code in (0xDC, 0xDD):
        return _length(payload, 1, _GROUPS[code][0])
    raise _no_tag(code)


def _length(payload: bytes, at: int, width: int) -> tuple[int, int]:
    """An unsigned number of so many bytes, and the place behind it."""
    if len(payload) < at + width:
        raise _truncated()
    return int.from_bytes(payload[at : at + width], "big"), at + width


def _byte(payload: bytes, at: int) -> int:
    if at >= len(payload):
        raise _truncated()
    return payload[at]


def _truncated() -> StructureError:
    return StructureError("truncated", "the payload ends inside the message")


def _no_tag(code: int = 0) -> StructureError:
    if code == _INVALID:
        return StructureError("damaged", "not MessagePack")
    return StructureError("wrong tag", "a message is an array that begins with its tag")
