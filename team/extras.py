"""Packages that only some commands need, and the command that installs them."""

import re
import shlex
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires

US = "teamslam"
_EXTRA = re.compile(r"""(.+?)\s*;.*\bextra\s*==\s*["']([^"']+)["']""")
_OURS = re.compile(rf"{US}\[([^\]]+)\]")


def install_command(extra: str) -> str:
    """Return the command that installs an extra's packages, by their names, for this Python."""
    packages = [*dict.fromkeys(_packages(extra))] or [f".[{extra}]"]
    return f"{shlex.quote(sys.executable)} -m pip install {' '.join(map(shlex.quote, packages))}"


def _packages(extra: str) -> Iterator[str]:
    try:
        stated = requires(US) or []
    except PackageNotFoundError:
        stated = []
    for text in stated:
        found = _EXTRA.fullmatch(text.strip())
        if found is None or found[2] != extra:
            continue
        ours = _OURS.fullmatch(found[1])
        if ours is None:
            yield found[1]
            continue
        for name in ours[1].split(","):
            yield from _packages(name.strip())
