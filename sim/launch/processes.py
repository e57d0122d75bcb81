"""Processes of a team: start, end, output, resources."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from teamslam.team.end_query import SINCE
from teamslam.team.shell import PARENT
from teamslam.team.wire.logs import one_line

# -P keeps the working folder off the module path: a user's `sim/` must not shadow ours.
PROGRAM = (sys.executable, "-P", "-m", "teamslam")
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Environment that gives linear algebra one thread."""
LOOK_S = 0.005  # time [s] between checks of an ending process
LAST_LINES = 12
GRACE_S = 5.0  # time [s] for a requested stop


@dataclass(frozen=True)
class Used:
    """CPU, peak resident set, final share of memory (a page of n processes counts 1/n)."""

    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0
    pss_mb: float | None = None

    def and_later(self, later: "Used") -> "Used":
        """Resources of two consecutive lives."""
        pss_mb = self.pss_mb if later.pss_mb is None else later.pss_mb
        peak_rss_mb = max(self.peak_rss_mb, later.peak_rss_mb)
        return Used(self.cpu_s + later.cpu_s, peak_rss_mb, pss_mb)


@dataclass(frozen=True)
class Ended:
    """End of a process: exit status (negative: signal), last lines; asked: on request."""

    name: str
    pid: int
    exit: int
    last_lines: tuple[str, ...]
    asked: bool
    used: Used

    @property
    def how(self) -> str:
        """The end as text."""
        if self.exit < 0:
            return f"was ended by {signal.Signals(-self.exit).name}"
        return f"ended with exit status {self.exit}"


class Child:
    """Process in its own session, with its own output file; life: number of earlier starts."""

    def __init__(
        self,
        name: str,
        words: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
        life: int = 0,
    ) -> None:
        self.name = name
        self.started = time.monotonic()
        self.used = Used()
        self.output = folder / f"{name}.log"
        self._asked = False
        self._status: int | None = None
        with self.output.open("ab" if life else "wb") as file:
            self._before = self.output.stat().st_size
            self._process = subprocess.Popen(  # noqa: S603 - our own program, no shell
                [*PROGRAM, *words],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )
        self.pid = self._process.pid
        self.measure()  # a short run may end before the next measurement

    @property
    def exit(self) -> int | None:
        """Exit status (negative: signal); None while running."""
        if self._status is None:
            pid, status, used = os.wait4(self.pid, os.WNOHANG)
            if pid:
                self._status = self._process.returncode = os.waitstatus_to_exitcode(status)
                # Bytes on macOS, kilobytes elsewhere. The peak includes that of the starting
                # program.
                most_mb = used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
                cpu_s = used.ru_utime + used.ru_stime
                peak_rss_mb = self.used.peak_rss_mb or most_mb
                self.used = replace(self.used, cpu_s=cpu_s, peak_rss_mb=peak_rss_mb)
        return self._status

    def measure(self) -> None:
        """Measure the memory share and its peak, on Linux."""
        with suppress(OSError, StopIteration):
            pss_mb = self._kilobytes("smaps_rollup", "Pss:") / 1e3
            peak_rss_mb = self._kilobytes("status", "VmHWM:") / 1e3
            self.used = replace(self.used, pss_mb=pss_mb, peak_rss_mb=peak_rss_mb)

    def _kilobytes(self, file: str, word: str) -> int:
        lines = Path(f"/proc/{self.pid}/{file}").read_text().splitlines()
        return int(next(line for line in lines if line.startswith(word)).split()[1])

    @property
    def is_stopped(self) -> bool:
        """Whether it is stopped (SIGSTOP)."""
        return self._state in ("T", "t")

    @property
    def is_computing(self) -> bool:
        """Whether it is running or runnable."""
        return self._state == "R"

    @property
    def _state(self) -> str:
        try:
            return Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, IndexError):
            return ""

    def kill(self) -> None:
        """End it at once, even if stopped."""
        if self.exit is None:
            os.kill(self.pid, signal.SIGKILL)

    def stop(self) -> None:
        """Request its end."""
        if self.exit is None:
            self._asked = True
            os.kill(self.pid, signal.SIGTERM)

    def end(self, deadline: float) -> Ended:
        """Wait until `deadline` (monotonic), then end it."""
        while self.exit is None:
            if time.monotonic() >= deadline:
                self.kill()
                deadline = math.inf
            time.sleep(LOOK_S)
        return self.ended()

    def ended(self) -> Ended:
        """How it ended; call after its end."""
        status = self.exit
        assert status is not None
        asked = self._asked and status != -signal.SIGKILL
        return Ended(self.name, self.pid, status, self.last_lines(), asked, self.used)

    def last_lines(self) -> tuple[str, ...]:
        """Last lines of its output."""
        text = self.output.read_bytes()[self._before :].decode("utf-8", "replace")
        return tuple(one_line(line) for line in text.splitlines()[-LAST_LINES:])


def environment_of(since_ns: int) -> dict[str, str]:
    """Environment of a run's processes; since_ns: its beginning, for a child restarted after its
    end.
    """
    tied = {PARENT: str(os.getpid()), SINCE: str(since_ns), "PYTHONUNBUFFERED": "1"}
    return {**os.environ, **ONE_THREAD, **tied}


def end_all(children: Sequence[Child]) -> list[Ended]:
    """End nodes, then the recorder, then the router; kill those that do not stop."""
    ended = {}
    for group in (
        [c for c in children if c.name not in ("recorder", "router")],
        [c for c in children if c.name == "recorder"],
        [c for c in children if c.name == "router"],
    ):
        for child in group:
            child.stop()
        deadline = time.monotonic() + GRACE_S
        for child in group:
            ended[child.name] = child.end(deadline)
    return [ended[child.name] for child in children]
