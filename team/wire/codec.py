"""Encode messages, and decode them with all checks, so that only valid ones reach a node.

Values are never unpacked without a type: a list of empty lists takes 75 times its size. Number and
nesting of the values of a large payload are checked before any is created.
"""

import re
from functools import cache, lru_cache
from typing import Any, TypeVar, Union

import msgspec

from teamslam.team.wire.messages import BY_TAG, NAME, Measurement, Message, PoseEstimate

M = TypeVar("M", bound=Message)

LARGEST_PAYLOAD = 64 * 2**20
"""Largest payload [bytes]: a joint covariance of 4096 rows."""


class WireError(ValueError):
    """An invalid payload.

    reason: "wrong tag", "wrong version", "truncated", "trailing bytes", "wrong length", "not
    finite", "not symmetric", "not positive definite", "not ascending", "out of bounds", "too
    large", "too deep", "damaged" or "wrong field". detail: a sentence.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def encoded(message: Message) -> bytes:
    """Encode a message as a MessagePack array [tag, field, …]."""
    return _ENCODER.encode(message)


def _plain(value: object) -> float:
    if isinstance(value, float):
        return float(value)
    raise TypeError(f"no field of a message takes a {type(value).__name__}")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)


def decoded(payload: bytes, *expected: type[M]) -> M:
    """Decode and check a payload as one of the expected classes (none: any); raises `WireError`."""
    if len(payload) > LARGEST_PAYLOAD:
        raise WireError("too large", f"{len(payload)} bytes, {LARGEST_PAYLOAD} at most")
    try:
        if len(payload) > SMALL:
            check_structure(payload)
        message: Any = _decoder(expected).decode(payload)
    except (WireError, *_UNREADABLE) as error:
        raise _refusal(payload, expected, error) from None
    if type(message) in _OF_ROBOTS and not _is_name(message.robot[:LONGEST]):
        raise WireError("wrong field", f"{type(message).__name__}: {_NO_NAME}")
    try:
        message.check()
    except ValueError as error:
        reason, _, detail = str(error).partition(": ")
        raise WireError(reason, f"{type(message).__name__}.{detail}") from None
    valid: M = message
    return valid


_OF_ROBOTS = frozenset(k for k in BY_TAG.values() if issubclass(k, Measurement | PoseEstimate))
"""Messages whose field `robot` is a `Robot`."""
_NO_NAME = f"Expected `str` matching regex {NAME!r} - at `$[2]`"


LONGEST = 33  # characters of a name that are read, one more than it has


@lru_cache(maxsize=1024)
def _is_name(text: str) -> bool:
    return _NAME.fullmatch(text) is not None


_NAME = re.compile(NAME)


class _Head(msgspec.Struct, array_like=True):
    tag: str


_HEAD = msgspec.msgpack.Decoder(_Head)
_UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def _refusal(payload: bytes, expected: tuple[type[Message], ...], error: Exception) -> WireError:
    """Explain why a payload could not be decoded; a wrong tag comes first."""
    kind: type[Message] = Message
    try:
        kind = _kind(_HEAD.decode(payload).tag, expected)
    except msgspec.ValidationError:
        return WireError("wrong tag", "a message is an array that begins with its tag")
    except _UNREADABLE as unreadable:
        error = error if isinstance(error, WireError) else unreadable
    match error:
        case WireError():
            return error
        case RecursionError():
            return WireError("too deep", "nested beyond any message's structure")
        case msgspec.ValidationError():
            return WireError("wrong field", f"{kind.__name__}: {error}")
        case UnicodeDecodeError():
            return WireError("damaged", "a text is not UTF-8")
    text = str(error)
    if "truncated" in text:
        return _truncated()
    if "trailing" in text:
        return WireError("trailing bytes", "the message ends before its payload does")
    return WireError("damaged", text)


def find_error(message: Message) -> WireError | None:
    """Return the error with which every receiver refuses this message; None for a valid one."""
    try:
        decoded(encoded(message), type(message))
    except WireError as error:
        return error
    return None


@cache
def _decoder(kinds: tuple[type[Message], ...]) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(Union[kinds or tuple(BY_TAG.values())])  # noqa: UP007


def tag_in(payload: bytes) -> str:
    """Return the tag of a payload; empty if it has none, or is damaged."""
    try:
        return _HEAD.decode(payload).tag
    except _UNREADABLE:
        return ""


def _kind(tag: str, expected: tuple[type[Message], ...]) -> type[Message]:
    kind = BY_TAG.get(tag)
    if kind is not None and (not expected or kind in expected):
        return kind
    requested = [str(each.__struct_config__.tag) for each in expected]
    name = tag[:60].partition("/")[0]
    known = [t for t in requested or BY_TAG if t.startswith(f"{name}/")]
    if known:
        raise WireError("wrong version", f"{tag[:60]!r} where {', '.join(known)} is understood")
    belongs = " or ".join(map(repr, requested))
    raise WireError(
        "wrong tag", f"{tag[:60]!r}" + (f" where {belongs} belongs" if requested else "")
    )


SMALL = 2**18
"""Payloads up to this size [bytes] have too few values to matter."""
MOST_VALUES = 250_000
"""Most values in a message; an array of numbers is one value."""
DEEPEST = 16
"""Deepest nesting of a message; the known ones have four levels."""
_SCALARS = {0xC0: 0, 0xC2: 0, 0xC3: 0, 0xCA: 4, 0xCB: 8,
            0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8}  # fmt: skip
_TEXTS = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
_GROUPS = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}
_HEADS: dict[int, tuple[int, int, int, int]] = {
    **dict.fromkeys((*range(0x80), *range(0xE0, 0x100)), (0, 0, 0, 0)),
    **{0x80 + entries: (0, entries, 0, 2) for entries in range(16)},
    **{0x90 + entries: (0, entries, 0, 1) for entries in range(16)},
    **{0xA0 + size: (0, size, 1, 0) for size in range(32)},
    **{code: (0, size, 1, 0) for code, size in _SCALARS.items()},
    **{code: (width, 0, 1, 0) for code, width in _TEXTS.items()},
    **{code: (width, 0, 0, each) for code, (width, each) in _GROUPS.items()},
}
"""By the code of a value: bytes of its length, its length where it has none, and the bytes and the
values behind the head for each unit of the length."""


def check_structure(payload: bytes) -> None:
    """Raise `WireError` where a payload has more values, or nests deeper, than any message."""
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
            raise WireError("too large", f"more than {MOST_VALUES} values")
        if inside:
            left.append(inside)
        if len(left) > DEEPEST:
            raise WireError("too deep", "nested beyond any message's structure")
    if at > len(payload):
        raise _truncated()


def _value_at(payload: bytes, at: int) -> tuple[int, int]:
    """Return the number of values inside the value at `at`, and the position after its head."""
    if at >= len(payload):
        raise _truncated()
    head = _HEADS.get(payload[at])
    if head is None:
        raise WireError("damaged", "a value of no message")
    width, length, size, values = head
    end = at + 1 + width
    if len(payload) < end:
        raise _truncated()
    if width:
        length = int.from_bytes(payload[at + 1 : end], "big")
    return length * values, end + length * size


def _truncated() -> WireError:
    return WireError("truncated", "the payload ends inside the message")
