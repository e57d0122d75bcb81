"""Child processes: start, restart, end and failure report."""

import math
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from teamslam.sim.launch.processes import Process, Starter, Used
from teamslam.team.wire.text import one_line

LAST_LINES = 12
GRACE_S = 5.0
"""Time [s] for a requested stop."""
FRUITLESS = 5
"""Consecutive deaths without progress before a process is given up."""
FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 5.0
"""Longest wait [s] before a restart."""
_PROC = Path("/proc")


@dataclass(frozen=True)
class Ended:
    """End of a process: exit status (negative: signal) and last lines.

    asked: it stopped on request. used: its resources.
    """

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


class Child(Process):
    """A `teamslam …` process with its own output file."""

    def __init__(
        self, name: str, arguments: Sequence[str], folder: Path, starter: Starter, life: int = 0
    ) -> None:
        self.name = name
        self.started = time.monotonic()
        self._asked = False
        self.output = folder / f"{name}.log"
        with self.output.open("ab" if life else "wb") as file:
            self._before = self.output.stat().st_size
            super().__init__(starter.start(arguments, file.fileno()))
        # A short run may end before the next measurement.
        self.measure()

    @property
    def is_stopped(self) -> bool:
        """Whether the process is stopped (SIGSTOP), as far as reported."""
        return self._state in ("T", "t")

    @property
    def is_computing(self) -> bool:
        """Whether the process is running or runnable, as far as reported."""
        return self._state == "R"

    @property
    def _state(self) -> str:
        try:
            return (_PROC / str(self.pid) / "stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, IndexError):
            return ""

    def kill(self) -> None:
        """End it at once, even if stopped."""
        self.signal(signal.SIGKILL)

    def stop(self) -> None:
        """Request its end."""
        if self.exit is None:
            self._asked = True
            self.signal(signal.SIGTERM)

    def end(self, deadline: float) -> Ended:
        """Wait until `deadline` (monotonic), then end it; return how it ended."""
        while not self.wait(max(0.0, deadline - time.monotonic())):
            self.kill()
            deadline = math.inf
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


@dataclass
class Supervised:
    """Process restarted by the same command on death, after growing waits.

    Given up after FRUITLESS deaths in a row without progress. reached: progress at its last death.
    ended_s: detection of its end (monotonic). used: resources of earlier lives.
    """

    name: str
    arguments: list[str]
    folder: Path
    starter: Starter
    restarts: int = 0
    fruitless: int = 0
    reached: float = -1.0
    given_up: bool = False
    over: bool = False
    due: float | None = None
    ended_s: float | None = None
    used: Used = field(default_factory=Used)
    child: Child = field(init=False)

    def __post_init__(self) -> None:
        self.child = Child(self.name, self.arguments, self.folder, self.starter)

    @property
    def is_watched(self) -> bool:
        """Whether it runs or will run again."""
        return not (self.over or self.given_up)

    def has_ended_for(self, time_s: float) -> bool:
        """Whether its end was detected at least this long ago."""
        self.ended_s = self.ended_s or time.monotonic()
        return time.monotonic() - self.ended_s >= time_s

    def died(self, reached: float) -> None:
        """Schedule a restart after a death, or give the process up."""
        self.fruitless = 1 if reached > self.reached else self.fruitless + 1
        self.reached = max(self.reached, reached)
        if self.fruitless >= FRUITLESS:
            self.given_up = True
            return
        wait_s = min(FIRST_WAIT_S * 2.0 ** (self.fruitless - 1), LONGEST_WAIT_S)
        self.due = time.monotonic() + wait_s

    def start_again(self) -> None:
        """Restart it if due."""
        if self.due is not None and time.monotonic() >= self.due:
            self.due = self.ended_s = None
            self.restarts += 1
            self.used = self.used.and_later(self.child.end(0.0).used)
            self.child = Child(self.name, self.arguments, self.folder, self.starter, self.restarts)


def end_all(children: Sequence[Child], *, last: str = "recorder") -> list[Ended]:
    """Request all to stop and end the rest; `last` is asked after the others."""
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
