"""Linux features missing in Python: adopting orphans, parent's death, command line.

On other systems these functions do nothing and report it.
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
"""Fields of /proc/PID/stat, from 1, with the command line's address range."""


def _prctl(option: int, value: int) -> bool:
    done: int = ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
    return done == 0


def adopt_orphans() -> bool:
    """Become the parent of orphaned descendants; returns whether the system allows it."""
    return sys.platform == "linux" and _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def end_with_parent(number: signal.Signals) -> None:
    """Request a signal on the parent's end."""
    if sys.platform == "linux":
        _prctl(_PR_SET_PDEATHSIG, int(number))


def threads() -> int:
    """Number of this process's threads, including those of libraries."""
    return len(os.listdir("/proc/self/task"))


def write_command_line(words: Sequence[str]) -> None:
    """Overwrite this process's command line, in `ps` and /proc, cut to the original length."""
    from_third = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    begin, end = (int(from_third[field - 3]) for field in (_ARG_START, _ARG_END))
    room = end - begin
    text = b"\0".join(word.encode(errors="surrogateescape") for word in words)[: room - 1]
    ctypes.memmove(begin, text.ljust(room, b"\0"), room)
