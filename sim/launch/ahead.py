"""Start the template, ahead of everything else that `launch` imports and computes.

What a team needs takes a second and a half to import and to load; meanwhile the launch reads its
command line and its scenario on another core. This module imports next to nothing, so that the
template is started within the first hundredth of a second: docs/decisions/12.
"""

import os
import socket
import subprocess
import sys

from sim.launch.linux import adopt_orphans

# -P keeps the working folder off the module path: a user's `sim/` must not shadow ours.
PROGRAM = (sys.executable, "-P", "-m", "sim")
TEMPLATE = "template"
"""`python -m sim template FD`: started by `launch`, no command for users."""
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMBA_NUM_THREADS",
    ),
    "1",
)
"""The environment of a process whose libraries have one thread each."""
_ROOM = 4_096
"""Bytes of a forked process's command line; the template is started with that many spaces."""


class Template:
    """The process from which a team's are forked, and the socket by which it is asked to.

    output: the descriptor for its errors until it has a file of its own.
    """

    def __init__(self, output: int) -> None:
        self.asks, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.process = subprocess.Popen(  # noqa: S603 - our own program, no shell
                [*PROGRAM, TEMPLATE, str(theirs.fileno()), " " * _ROOM],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**os.environ, **ONE_THREAD, "PYTHONUNBUFFERED": "1"},
                start_new_session=True,
                pass_fds=[theirs.fileno()],
            )

    def end(self) -> None:
        """End the process."""
        self.asks.close()
        self.process.kill()
        self.process.wait()


_waiting: list[Template] = []


def start_ahead() -> None:
    """Start a template, where the system has what it needs; `taken` returns it."""
    if sys.stderr is not None and adopt_orphans():
        _waiting.append(Template(sys.stderr.fileno()))


def taken() -> Template | None:
    """The template that was started ahead, if any, for its one user."""
    return _waiting.pop() if _waiting else None


def end_ahead() -> None:
    """End the template that was started ahead and that nobody has taken: the command has failed."""
    if (template := taken()) is not None:
        template.end()
