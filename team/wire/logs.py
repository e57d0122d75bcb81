r"""Texts of others: printable, short, and logged at a bounded rate, so that none floods or forges.

Control and other invisible characters are written as `\x1b` or `\u202e`. Each place in the program
may log AT_ONCE lines, and regains PER_S lines a second; the next line counts the omitted ones.
"""

import logging
import unicodedata
from collections.abc import Mapping
from typing import Any, TypeVar, cast

import msgspec

AT_ONCE = 50
PER_S = 0.5
LONGEST = 4_000
T = TypeVar("T")


def one_line(text: str) -> str:
    """Write a text as one line without control characters."""
    return text if text.isprintable() else "".join(map(_printable, text))


def printable_lines(text: str) -> str:
    """Apply `one_line` to each line of a text of this program."""
    return "\n".join(one_line(line) for line in text.split("\n"))


def cut(text: str, length: int) -> str:
    """Shorten a text to `length` characters, the last an ellipsis."""
    return text if len(text) <= length else f"{text[: length - 1]}…"


def make_printable(value: T) -> T:
    """Apply `one_line` to all texts of a message; an unchanged message is returned itself."""
    return cast("T", _readable(value))


def _readable(value: Any) -> Any:
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, tuple | list):
        parts = [_readable(part) for part in value]
        same = all(new is old for new, old in zip(parts, value, strict=True))
        return value if same else type(value)(parts)
    if isinstance(value, Mapping):
        found = {_readable(key): _readable(part) for key, part in value.items()}
        return value if found == value else found
    if isinstance(value, msgspec.Struct):
        fields = {name: getattr(value, name) for name in value.__struct_fields__}
        changed = {name: new for name, old in fields.items() if (new := _readable(old)) is not old}
        return msgspec.structs.replace(value, **changed) if changed else value
    return value


def _printable(character: str) -> str:
    if character.isprintable() or unicodedata.category(character) == "Zs":
        return character
    number = ord(character)
    return f"\\x{number:02x}" if number < 0x100 else f"\\u{number:04x}"


class Limits(logging.Filter):
    """Limit the rate of records by their place, and escape their texts."""

    def __init__(self) -> None:
        super().__init__()
        self._sites: dict[tuple[str, int], tuple[float, float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Decide whether to log the record, and make its message one printable line."""
        now = record.created
        site = (record.pathname, record.lineno)
        allowance, since, left_out = self._sites.get(site, (float(AT_ONCE), now, 0))
        allowance = min(float(AT_ONCE), allowance + PER_S * max(0.0, now - since))
        if allowance < 1.0:
            self._sites[site] = (allowance, now, left_out + 1)
            return False
        self._sites[site] = (allowance - 1.0, now, 0)
        text = cut(one_line(record.getMessage()), LONGEST)
        if left_out:
            text += f" ({left_out} more like this were left out)"
        elif allowance < 2.0:
            text += " (of more like this some are left out)"
        record.msg, record.args = text, ()
        return True

    def forget(self) -> None:
        """Reset the limits of all places."""
        self._sites.clear()


LIMITS = Limits()
LOG = logging.getLogger("teamslam")
LOG.addFilter(LIMITS)
