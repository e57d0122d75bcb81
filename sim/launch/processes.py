"""Start a team's processes, and measure the resources that they use."""

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from teamslam.team.end_query import SINCE
from teamslam.team.shell import PARENT

# -P keeps the working folder off the module path: a user's `sim/` must not shadow ours.
PROGRAM = (sys.executable, "-P", "-m", "teamslam")
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Environment that gives linear algebra one thread."""
LOOK_S = 0.005
"""Time [s] between checks of an ending process."""


@dataclass(frozen=True)
class Used:
    """Resources of a process: CPU, peak resident set, final share of memory; None: unknown.

    A page shared by n processes counts 1/n.
    """

    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0
    pss_mb: float | None = None

    def and_later(self, later: "Used") -> "Used":
        """Resources of two consecutive lives of a process, this one first."""
        pss_mb = self.pss_mb if later.pss_mb is None else later.pss_mb
        peak_rss_mb = max(self.peak_rss_mb, later.peak_rss_mb)
        return Used(self.cpu_s + later.cpu_s, peak_rss_mb, pss_mb)


class Process:
    """Child of this process; used: resources, with the last memory measurement."""

    def __init__(self, started: "subprocess.Popen[bytes]") -> None:
        self.pid = started.pid
        self.used = Used()
        self._status: int | None = None
        self._started = started

    @property
    def exit(self) -> int | None:
        """Exit status (negative: signal); None while running."""
        if self._status is None:
            pid, status, used = os.wait4(self.pid, os.WNOHANG)
            if pid:
                self._status = os.waitstatus_to_exitcode(status)
                # Bytes on macOS, kilobytes elsewhere. The peak includes that of the starting
                # program.
                most_mb = used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
                cpu_s = used.ru_utime + used.ru_stime
                peak_rss_mb = self.used.peak_rss_mb or most_mb
                self.used = replace(self.used, cpu_s=cpu_s, peak_rss_mb=peak_rss_mb)
                self._started.returncode = self._status
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

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends within this time."""
        deadline = time.monotonic() + timeout_s
        while self.exit is None:
            if time.monotonic() >= deadline:
                return False
            time.sleep(LOOK_S)
        return True

    def signal(self, number: int) -> None:
        """Send a signal unless it has ended."""
        if self.exit is None:
            os.kill(self.pid, number)


class Starter:
    """Starter of the processes of one run.

    since_ns: beginning of the run, for a child restarted after its end.
    """

    def __init__(self, since_ns: int) -> None:
        self._environment = _environment(os.environ, since_ns)

    def start(self, words: Sequence[str], output: int) -> "subprocess.Popen[bytes]":
        """Start `teamslam WORDS` in its own session; output: descriptor of output and errors."""
        return subprocess.Popen(  # noqa: S603 - our own program, no shell
            [*PROGRAM, *words],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=self._environment,
            start_new_session=True,
        )


def _environment(mine: Mapping[str, str], since_ns: int) -> dict[str, str]:
    tied = {PARENT: str(os.getpid()), SINCE: str(since_ns), "PYTHONUNBUFFERED": "1"}
    return {**mine, **ONE_THREAD, **tied}
