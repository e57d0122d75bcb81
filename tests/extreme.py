"""Extreme messages of every type: the values of every field at the bounds that its type allows."""

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids, from_stamps
from team.wire.codec import encoded
from tests.hostile_team import ROBOTS, SKIPPED, S, valid
from tests.support import examples

INTEGERS = (
    0,
    1,
    2,
    7,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**53,
    2**62 - 1,
    2**63 - 1,
    -1,
    -(2**62),
)
FLOATS = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e-12, 3.2, 1e9, -1e9, 1e154, 1e300, -1e300)
TEXTS = (
    "",
    "\x1b]0;owned\x07",
    "\x1b[2J",
    "\u202e\u2066",
    "r1",
    "robot/r1",
    "world",
    "\0",
    "a" * 20_000,
    "<b>&",
)
NAMES = (*ROBOTS, "a", "z" * 32, "stranger_0")
NUMBERS = (0, 1, 2, 7, 2**16, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1)
"""Ids and counts: 32 bits."""
WORDS = {"ids", "counts", "labels", "identities", "locals", "sequences", "rows", "landmarks"}
"""Fields of uint32."""
FLAWS = ("robot", "incarnation", "number", "node", "name")
"""A node decides by these fields whether to look at a message; they are rarely changed."""


def extreme(rng: np.random.Generator, message: m.Message) -> m.Message:
    """The message with some of its fields at extremes, as far as its door lets them through."""
    rate = rng.choice([0.1, 0.3, 0.9])
    for name in rng.permutation(list(message.__struct_fields__)).tolist():
        if rng.random() > rate or (name in FLAWS and rng.random() < 0.7):
            continue
        changed = msgspec.structs.replace(
            message, **{name: _other(rng, name, getattr(message, name))}
        )
        try:
            message = valid(changed) or message
        except (TypeError, ValueError):
            continue
    return message


def _other(rng: np.random.Generator, name: str, value: Any) -> Any:
    match value:
        case bool():
            return not value
        case int():
            return (
                int(rng.choice(INTEGERS))
                if rng.random() < 0.8
                else value + int(rng.integers(-2, 3))
            )
        case float():
            return float(rng.choice(FLOATS))
        case str():
            return str(rng.choice(NAMES if rng.random() < 0.5 else TEXTS))
        case bytes():
            return _array(rng, name, value)
        case tuple():
            return _row(rng, name, value)
        case dict():
            return {str(key): float(rng.choice(FLOATS)) for key in rng.choice(TEXTS, 3)}
        case msgspec.Struct():
            chosen = str(rng.choice(value.__struct_fields__))
            return msgspec.structs.replace(
                value, **{chosen: _other(rng, chosen, getattr(value, chosen))}
            )
        case _:
            return value


def _array(rng: np.random.Generator, name: str, value: bytes) -> bytes:
    if name in WORDS:
        count = len(value) // 4
        return from_ids(np.sort(rng.choice(NUMBERS, count, replace=count > len(NUMBERS))))
    if name in ("stamps", "nodes"):
        return from_stamps(np.sort(rng.integers(-(2**62), 2**62, len(value) // 8)))
    if len(value) % 8 or rng.random() < 0.1:
        return rng.bytes(len(value))
    old = np.frombuffer(value, "<f8")
    with np.errstate(all="ignore"):
        scaled = old * rng.choice([0.0, 1e-150, 1e-9, 1e9, 1e150, -1.0])
    return from_floats(scaled if rng.random() < 0.6 else rng.choice(FLOATS, len(old)))


def _row(rng: np.random.Generator, name: str, value: tuple[Any, ...]) -> tuple[Any, ...]:
    if not value or rng.random() < 0.2:
        return ()
    some = [_other(rng, name, each) if rng.random() < 0.5 else each for each in value]
    return tuple(some * (500 if rng.random() < 0.1 else 1))


CHANNELS = {
    kind: [row for row in ch.CHANNELS if row not in SKIPPED and kind in row.kinds]
    for kind in m.BY_TAG.values()
}
"""By message, the channels that carry it; a request or a reply has none."""


def samples(
    rng: np.random.Generator, kind: type[m.Message], count: int
) -> Iterator[tuple[ch.Channel, str, bytes]]:
    """Channel, name and payload of so many extreme messages of a class, on each of its channels."""
    (example,) = (each for each in examples() if type(each) is kind)
    for _ in range(count):
        robot = str(rng.choice(ROBOTS))
        own: dict[str, object] = {"robot": robot} if "robot" in kind.__struct_fields__ else {}
        if "incarnation" in kind.__struct_fields__:
            own["incarnation"] = 1
        if "stamp_ns" in kind.__struct_fields__:
            own["stamp_ns"] = int(rng.integers(0, 100)) * S
        base = valid(msgspec.structs.replace(example, **own)) or example
        for channel in CHANNELS[kind]:
            name = (
                getattr(base, "robot", robot) if "{robot}" in channel.template else f"robot/{robot}"
            )
            publisher = channel.publisher(name if "{" in channel.template else "")
            if "node" in kind.__struct_fields__ and rng.random() < 0.7:
                base = valid(msgspec.structs.replace(base, node=publisher)) or base
            message = extreme(rng, base)
            name = getattr(message, "robot", name) if "{robot}" in channel.template else name
            yield channel, name if "{" in channel.template else "", encoded(message)
