"""Start the template before `launch` imports anything else.

A team's imports take 1.5 s; meanwhile the launch reads command line and scenario on another core.
This module's imports are minimal, so the template starts within 10 ms: docs/decisions/12.
"""

import os
import socket
import subprocess
import sys

from sim.launch.linux import adopt_orphans

# -P keeps the working folder off the module path: a user's `sim/` must not shadow ours.
PROGRAM = (sys.executable, "-P", "-m", "sim")
TEMPLATE = "template"
"""Internal command `python -m sim template FD` of `launch`."""
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
"""Environment that gives each library one thread."""
_ROOM = 4_096
"""Bytes for a forked process's command line, reserved as spaces."""


class Template:
    """Process from which a team's processes are forked, and its request socket.

    output: error descriptor until it has its own file.
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
    """Start a template if the system supports it; `taken` returns it."""
    if sys.stderr is not None and adopt_orphans():
        _waiting.append(Template(sys.stderr.fileno()))


def taken() -> Template | None:
    """Template started ahead, if any, for its one user."""
    return _waiting.pop() if _waiting else None


def end_ahead() -> None:
    """End an unused template after a failed command."""
    if (template := taken()) is not None:
        template.end()
