"""Child processes: started, watched, ended, and spoken of by name when they fail."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from team.shell import PARENT

LAST_LINES = 12
"""Lines of a failed process's output that are shown."""
GRACE_S = 5.0
"""A process that was asked to stop has this long."""
_ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMBA_NUM_THREADS",
    ),
    "1",
)


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit status (negative: the signal that ended it), its last lines.

    asked: we had asked it to stop, and it did.
    """

    name: str
    pid: int
    exit: int
    last_lines: tuple[str, ...]
    asked: bool

    @property
    def how(self) -> str:
        """In words."""
        if self.exit < 0:
            return f"was ended by {signal.Signals(-self.exit).name}"
        return f"ended with exit status {self.exit}"


class Child:
    """One `teamslam …` process, its output in a file of its own."""

    def __init__(self, name: str, arguments: Sequence[str], folder: Path) -> None:
        self.name = name
        self._asked = False
        self.output = folder / f"{name}.log"
        # -P keeps the working folder off the module path: a user's `sim/` must not shadow ours.
        command = [sys.executable, "-P", "-m", "sim", *arguments]
        self._file: IO[bytes] = self.output.open("wb")
        self._process = subprocess.Popen(  # noqa: S603 - our own program, no shell
            command,
            stdin=subprocess.DEVNULL,
            stdout=self._file,
            stderr=subprocess.STDOUT,
            env=_environment(os.environ),
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def exit(self) -> int | None:
        """The exit status; None while it runs."""
        return self._process.poll()

    def stop(self) -> None:
        """Ask it to stop."""
        if self.exit is None:
            self._asked = True
            self._process.terminate()

    def end(self, deadline: float) -> Ended:
        """Wait until `deadline` (monotonic), then end it; how it ended."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._file.close()
        return self.ended()

    def ended(self) -> Ended:
        """How it ended; call when it has."""
        status = self.exit
        assert status is not None
        asked = self._asked and status != -signal.SIGKILL
        return Ended(self.name, self.pid, status, self.last_lines(), asked)

    def last_lines(self) -> tuple[str, ...]:
        """The end of what it printed."""
        text = self.output.read_text("utf-8", "replace")
        return tuple(text.splitlines()[-LAST_LINES:])


def _environment(mine: Mapping[str, str]) -> dict[str, str]:
    """A child's environment: one BLAS thread, tied to this process, unbuffered output."""
    return {**mine, **_ONE_THREAD, PARENT: str(os.getpid()), "PYTHONUNBUFFERED": "1"}


def end_all(children: Sequence[Child], *, last: str = "recorder") -> list[Ended]:
    """Ask all to stop and end those that do not; the one named `last` is asked after the others."""
    ended = {}
    for group in (
        [c for c in children if c.name not in (last, "router")],
        [c for c in children if c.name == last],
        [c for c in children if c.name == "router"],
    ):
        for child in group:
            child.stop()
        deadline = time.monotonic() + GRACE_S
        for child in group:
            ended[child.name] = child.end(deadline)
    return [ended[child.name] for child in children]
