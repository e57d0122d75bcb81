"""Encode messages, and decode them with all checks, so that only valid ones reach a node.

A payload is decoded into the class of its tag, field by field, and refused at the first byte that
does not fit. Values are never unpacked without a type: a list of empty lists takes 75 times its
size.
"""

from functools import cache
from typing import Any, NoReturn, TypeVar, Union

import msgspec

from teamslam.team.wire.messages import BY_TAG, Message
from teamslam.team.wire.structure import SMALL, StructureError, check_structure, read_tag

M = TypeVar("M", bound=Message)

LARGEST_PAYLOAD = 64 * 2**20
"""Largest payload [bytes]: a joint covariance of 4096 rows."""


class WireError(ValueError):
    """An invalid payload; `reason` is one of the texts below, `detail` a sentence.

    Reasons: "wrong tag", "wrong version", "truncated", "trailing bytes", "wrong length", "not
        finite", "not symmetric", "not positive definite", "not ascending", "out of bounds", "too
        large", "too deep", "damaged", "wrong field".
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def encoded(message: Message) -> bytes:
    """Encode a message as a MessagePack array [tag, field, …]."""
    return _ENCODER.encode(message)


def _plain(value: object) -> float:
    """Convert a NumPy number that is a `float` to a plain float."""
    if isinstance(value, float):
        return float(value)
    raise TypeError(f"no field of a message takes a {type(value).__name__}")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)


def decoded(payload: bytes, *expected: type[M]) -> M:
    """Decode and check a payload field by field; raises `WireError`.

    expected: the accepted classes, as those of a channel; without any, all.
    """
    if len(payload) > LARGEST_PAYLOAD:
        raise WireError("too large", f"{len(payload)} bytes, {LARGEST_PAYLOAD} at most")
    try:
        if len(payload) > SMALL:
            check_structure(payload)
        message: M = _decoder(expected).decode(payload)
    except (StructureError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        _refuse(payload, expected, error)
    try:
        message.check()
    except ValueError as error:
        reason, _, detail = str(error).partition(": ")
        raise WireError(reason, f"{type(message).__name__}.{detail}") from None
    return message


def _refuse(payload: bytes, expected: tuple[type[Message], ...], error: Exception) -> NoReturn:
    """Raise the `WireError` of a payload that could not be decoded; a wrong tag comes first."""
    try:
        tag = read_tag(payload)
    except StructureError as why:
        raise WireError(why.reason, why.detail) from None
    kind = _kind(tag, expected)
    match error:
        case StructureError():
            raise WireError(error.reason, error.detail) from None
        case RecursionError():
            raise WireError("too deep", "nested beyond any message's structure") from None
        case msgspec.ValidationError():
            raise WireError("wrong field", f"{kind.__name__}: {error}") from None
        case UnicodeDecodeError():
            raise WireError("damaged", "a text is not UTF-8") from None
    text = str(error)
    if "truncated" in text:
        raise WireError("truncated", "the payload ends inside the message") from None
    if "trailing" in text:
        raise WireError("trailing bytes", "the message ends before its payload does") from None
    raise WireError("damaged", text) from None


def unsound(message: Message) -> WireError | None:
    """Return the error with which every receiver refuses this message; None for a valid one.

    A sender applies it before publishing; the checks are those of `decoded`.
    """
    payload = _ENCODER.encode(message)
    kind = type(message)
    try:
        if len(payload) > SMALL:
            decoded(payload, kind)
        else:
            _decoder((kind,)).decode(payload)
            message.check()
    except WireError as error:
        return error
    except (msgspec.ValidationError, ValueError):
        return _refusal(payload, kind)
    return None


def _refusal(payload: bytes, kind: type[Message]) -> WireError | None:
    """Return the error with which a payload is refused."""
    try:
        decoded(payload, kind)
    except WireError as error:
        return error
    return None


@cache
def _decoder(kinds: tuple[type[Message], ...]) -> msgspec.msgpack.Decoder[Any]:
    """Return a decoder of the messages of these classes; without any, of all."""
    return msgspec.msgpack.Decoder(Union[kinds or tuple(BY_TAG.values())])  # noqa: UP007


def tag_in(payload: bytes) -> str:
    """Return the tag at the beginning of a payload; empty if it has none."""
    try:
        return read_tag(payload)
    except StructureError:
        return ""


def _kind(tag: str, expected: tuple[type[Message], ...]) -> type[Message]:
    """Return the class of a tag; raises `WireError` if it is not expected."""
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
