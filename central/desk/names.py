"""Names and texts for display."""

import re
from collections.abc import Iterable, Iterator
from pathlib import PurePath

import msgspec

from teamslam.central.config import UNREADABLE

OUTSIDE = "not in the team's frame"  # replaces the error of poses outside the team map's frame
_DIGITS = re.compile("([0-9]+)")
_DECIMAL = re.compile(r"\d+\.\d+")
_NOT_JOINED = " not joined: "
_FIRST_LIFE = " (incarnation 1)"
_ROBOT = re.compile(r"(\S+) \(incarnation \d+\)")


PACKED = (".zip", ".mcap", ".db3")  # suffixes of data sets in one file


def data_set_name(path: str | PurePath) -> str:
    """Name of a data set without suffix."""
    place = PurePath(path)
    return place.stem if place.suffix in PACKED else place.name


def data_set_of(scenario: str) -> str:
    """Data set's name in a scenario's JSON text, or empty."""
    try:
        return data_set_name(msgspec.json.decode(scenario)["world"]["path"])
    except (*UNREADABLE, LookupError, TypeError):
        return ""


def in_order(names: Iterable[str]) -> list[str]:
    """Sort naturally: r2 before r10."""
    return sorted(
        names, key=lambda name: [int(p) if p.isdigit() else p for p in _DIGITS.split(name)]
    )


def not_joined(reasons: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Unjoined robots in a map's reasons, as `r2, r3`, and why."""
    for reason in reasons:
        who, apart, why = reason.partition(_NOT_JOINED)
        if apart:
            yield ", ".join(in_order(dict.fromkeys(_ROBOT.findall(who)))) or who, short(why)


def short(words: str) -> str:
    """Omit the incarnation of robots that have only one."""
    return words.replace(_FIRST_LIFE, "")


def without_decimals(text: str) -> str:
    """Mask decimals: other figures make no new event."""
    return _DECIMAL.sub("#", text)
