"""Start a team's processes, forked from the warm template or from scratch."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from sim.launch.ahead import ONE_THREAD, PROGRAM, Template, taken
from sim.launch.linux import adopt_orphans
from team.shell import PARENT
from team.the_end import SINCE

LOOK_S = 0.005
"""Time [s] between checks of an ending process."""
PATIENCE_S = 600.0
"""Time [s] for a template's answer, which may include compiling all kernels."""
_LARGEST_ANSWER = 64
KERNELS = "kernels"
"""First request of a template: `kernels ESTIMATOR RULE SINCE`, with the file for its errors."""


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
    """Child of this process by id.

    exit: status (negative: signal), None while running. used: resources, with the last memory
    measurement.
    """

    def __init__(self, pid: int, started: "subprocess.Popen[bytes] | None" = None) -> None:
        self.pid = pid
        self.exit: int | None = None
        self.used = Used()
        self._started = started

    def poll(self) -> int | None:
        """Exit status; None while running."""
        if self.exit is None:
            pid, status, used = os.wait4(self.pid, os.WNOHANG)
            if pid:
                self.exit = os.waitstatus_to_exitcode(status)
                # Bytes on macOS, kilobytes elsewhere. The peak includes that of the starting
                # program.
                most_mb = used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
                cpu_s = used.ru_utime + used.ru_stime
                peak_rss_mb = self.used.peak_rss_mb or most_mb
                self.used = replace(self.used, cpu_s=cpu_s, peak_rss_mb=peak_rss_mb)
                if self._started is not None:
                    self._started.returncode = self.exit
        return self.exit

    def measure(self) -> None:
        """Measure the memory share and its peak, on Linux."""
        with suppress(OSError, StopIteration):
            pss_mb = self._kilobytes("smaps_rollup", "Pss:") / 1e3
            peak_rss_mb = self._kilobytes("status", "VmHWM:") / 1e3
            self.used = replace(self.used, pss_mb=pss_mb, peak_rss_mb=peak_rss_mb)

    def _kilobytes(self, file: str, word: str) -> int:
        """Kilobytes behind a word in a /proc file of the process."""
        lines = Path(f"/proc/{self.pid}/{file}").read_text().splitlines()
        return int(next(line for line in lines if line.startswith(word)).split()[1])

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends within this time."""
        deadline = time.monotonic() + timeout_s
        while self.poll() is None:
            if time.monotonic() >= deadline:
                return False
            time.sleep(LOOK_S)
        return True

    def signal(self, number: int) -> None:
        """Send a signal unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)


class Starter:
    """Start the processes of one run; a context that ends the template.

    warm: estimator and rule whose kernels a template loads before forking. With None, without
    orphan adoption, or after a template's death, processes start from scratch. log: file for the
    template's errors. compiled: receives the number of compiled kernels and the estimated total.
    """

    def __init__(
        self,
        since_ns: int,
        warm: tuple[str, str] | None,
        log: Path,
        compiled: Callable[[int, int], None] = lambda done, of: None,
    ) -> None:
        self._compiled, self._done = compiled, 0
        self._environment = _environment(os.environ, since_ns)
        self._template: Process | None = None
        self._asks: socket.socket | None = None
        if warm is not None and adopt_orphans():
            self._use_template(warm, log, since_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end_template()

    @property
    def is_warm(self) -> bool:
        """Whether there is a template."""
        return self._asks is not None

    def start(self, words: Sequence[str], output: int) -> Process:
        """Start `teamslam TEMPLATES`; output: descriptor of output and errors."""
        if self._asks is not None:
            try:
                return Process(self._forked(self._asks, words, output))
            except OSError:
                self._end_template()
        started = subprocess.Popen(  # noqa: S603 - our own program, no shell
            [*PROGRAM, *words],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=self._environment,
            start_new_session=True,
        )
        return Process(started.pid, started)

    def _forked(self, asks: socket.socket, words: Sequence[str], output: int) -> int:
        """Id of a process forked by the template; raises OSError without an answer."""
        socket.send_fds(asks, [json.dumps(list(words)).encode()], [output])
        while answer := asks.recv(_LARGEST_ANSWER):
            match answer.decode().split():
                case ["started", pid]:
                    return int(pid)
                case ["compiled", of]:
                    self._done += 1
                    self._compiled(self._done, max(self._done, int(of)))
        raise ConnectionResetError("the template has ended")

    def _use_template(self, warm: tuple[str, str], log: Path, since_ns: int) -> None:
        with log.open("wb") as file:
            template = taken() or Template(file.fileno())
            self._template = Process(template.process.pid, template.process)
            self._asks = template.asks
            self._asks.settimeout(PATIENCE_S)
            words = [KERNELS, *warm, str(since_ns)]
            try:
                socket.send_fds(self._asks, [json.dumps(words).encode()], [file.fileno()])
            except OSError:
                self._end_template()

    def _end_template(self) -> None:
        if self._asks is not None:
            self._asks.close()
            self._asks = None
        if self._template is not None:
            self._template.signal(9)
            self._template.wait(PATIENCE_S)
            self._template = None


def _environment(mine: Mapping[str, str], since_ns: int) -> dict[str, str]:
    """Child environment: one BLAS thread, bound to this process, unbuffered output.

    since_ns: beginning of the run, for a child restarted after its end.
    """
    tied = {PARENT: str(os.getpid()), SINCE: str(since_ns), "PYTHONUNBUFFERED": "1"}
    return {**mine, **ONE_THREAD, **tied}
