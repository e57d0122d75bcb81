"""Encodes messages and decodes them with all checks, so that only sound messages reach a node."""

from functools import cache
from typing import TypeVar, cast

import msgpack
import msgspec

from team.wire.messages import BY_TAG, Message

M = TypeVar("M", bound=Message)

LARGEST_PAYLOAD = 64 * 2**20
"""Largest payload in bytes: that of a joint covariance of 4096 rows."""
_LARGEST_ARRAY = 100_000
_LARGEST_MAP = 1_000
_LARGEST_TEXT = 1_000_000


class WireError(ValueError):
    """Bytes that are no sound message; `reason` is one of the words below, `detail` a sentence.

    Reasons: "wrong tag", "wrong version", "truncated", "trailing bytes", "wrong length", "not
        finite", "not symmetric", "not positive definite", "not ascending", "out of bounds", "too
        large", "too deep", "damaged", "wrong field".
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def encoded(message: Message) -> bytes:
    """The message's payload bytes: a MessagePack array [tag, field, …]."""
    return msgspec.msgpack.encode(message)


def decoded(payload: bytes, *expected: type[M]) -> M:
    """The message in `payload`, checked field by field; raises `WireError`.

    `expected` are the classes that the channel carries; without any, every known message is
    accepted.
    """
    fields = _unpacked(payload)
    return cast(M, _converted(fields, _kind(fields, expected)))


def unsound(message: Message) -> WireError | None:
    """Why every receiver would refuse this message; None for a sound one.

    A sender checks its own messages with it before publishing; the checks are those of `decoded`.
    """
    payload = encoded(message)
    if len(payload) > LARGEST_PAYLOAD:
        return WireError("too large", f"{len(payload)} bytes, {LARGEST_PAYLOAD} at most")
    kind = type(message)
    try:
        _decoder(kind).decode(payload)
        _check(message)
    except msgspec.ValidationError as error:
        return WireError("wrong field", f"{kind.__name__}: {error}")
    except WireError as error:
        return error
    return None


@cache
def _decoder(kind: type[Message]) -> msgspec.msgpack.Decoder[Message]:
    return msgspec.msgpack.Decoder(kind)


def _converted(fields: object, kind: type[Message]) -> Message:
    try:
        message = msgspec.convert(fields, type=kind, builtin_types=(bytes,), strict=True)
    except msgspec.ValidationError as error:
        raise WireError("wrong field", f"{kind.__name__}: {error}") from None
    _check(message)
    return message


def _check(message: Message) -> None:
    try:
        message.check()
    except ValueError as error:
        reason, _, detail = str(error).partition(": ")
        raise WireError(reason, f"{type(message).__name__}.{detail}") from None


def tag_in(payload: bytes) -> str:
    """The tag at the beginning of a payload, if it can be read; empty where there is none."""
    text = payload[2 : 2 + (payload[1] & 31)] if len(payload) > 1 and payload[1] >> 5 == 5 else b""
    return text.decode("ascii", "replace")


def _unpacked(payload: bytes) -> object:
    if len(payload) > LARGEST_PAYLOAD:
        raise WireError("too large", f"{len(payload)} bytes, {LARGEST_PAYLOAD} at most")
    try:
        return msgpack.unpackb(
            payload,
            max_str_len=_LARGEST_TEXT,
            max_bin_len=LARGEST_PAYLOAD,
            max_array_len=_LARGEST_ARRAY,
            max_map_len=_LARGEST_MAP,
            max_ext_len=0,
        )
    except msgpack.ExtraData:
        raise WireError("trailing bytes", "the message ends before its payload does") from None
    except (msgpack.StackError, RecursionError):
        raise WireError("too deep", "nested beyond any message's structure") from None
    except msgpack.FormatError:
        raise WireError("damaged", "not MessagePack") from None
    except UnicodeDecodeError:
        raise WireError("damaged", "a text is not UTF-8") from None
    except ValueError as error:
        if "incomplete" in str(error):
            raise WireError("truncated", "the payload ends inside the message") from None
        if "exceeds" in str(error):
            raise WireError("too large", str(error)) from None
        raise WireError("damaged", str(error)) from None


def _kind(fields: object, expected: tuple[type[Message], ...]) -> type[Message]:
    if not (isinstance(fields, list) and fields and isinstance(fields[0], str)):
        raise WireError("wrong tag", "a message is an array that begins with its tag")
    tag = fields[0]
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
