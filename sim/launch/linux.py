"""Features of Linux that Python does not offer: adopting orphans, a parent's death, the command
line.

On other systems these functions do nothing and return that.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_ARG_START, _ARG_END = 48, 49
"""Fields of /proc/PID/stat, counted from 1: between which addresses the command line lies."""


def _prctl(option: int, value: int) -> bool:
    done: int = ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
    return done == 0


def adopt_orphans() -> bool:
    """Become the parent of descendants whose parent ends; returns whether the system allows it."""
    return sys.platform == "linux" and _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def end_with_parent(number: signal.Signals) -> None:
    """Have this process sent a signal when its parent ends."""
    if sys.platform == "linux":
        _prctl(_PR_SET_PDEATHSIG, int(number))


def threads() -> int:
    """The number of this process's threads, those of libraries included."""
    return len(os.listdir("/proc/self/task"))


def write_command_line(words: Sequence[str]) -> None:
    """Show other words as the command line of this process, in `ps` and /proc.

    They overwrite the original words, and are cut to their length.
    """
    from_third = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    begin, end = (int(from_third[field - 3]) for field in (_ARG_START, _ARG_END))
    room = end - begin
    text = b"\0".join(word.encode(errors="surrogateescape") for word in words)[: room - 1]
    ctypes.memmove(begin, text.ljust(room, b"\0"), room)
