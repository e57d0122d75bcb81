"""Names of robots as people read them: their order, and who is not in the team's map."""

import re
from collections.abc import Iterable, Iterator

OUTSIDE = "not in the team's frame"
"""In place of the error of a robot's poses that are not in the frame of the team's map."""
_DIGITS = re.compile("([0-9]+)")
_NOT_JOINED = " not joined: "
_FIRST_LIFE = " (incarnation 1)"
_ROBOT = re.compile(r"(\S+) \(incarnation \d+\)")


def in_order(names: Iterable[str]) -> list[str]:
    """Names as people count them: r2 before r10."""
    return sorted(
        names, key=lambda name: [int(p) if p.isdigit() else p for p in _DIGITS.split(name)]
    )


def not_joined(reasons: Iterable[str]) -> Iterator[tuple[str, str]]:
    """The robots that are not joined by a map's reasons, as `r2, r3`, and why."""
    for reason in reasons:
        who, apart, why = reason.partition(_NOT_JOINED)
        if apart:
            yield ", ".join(in_order(dict.fromkeys(_ROBOT.findall(who)))) or who, short(why)


def short(words: str) -> str:
    """The words without the incarnation of robots that have had no other."""
    return words.replace(_FIRST_LIFE, "")
