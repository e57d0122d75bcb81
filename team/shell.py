"""The shell of a node: it owns the bus, the clock and the signals; the node owns the answers."""

import ctypes
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Protocol, runtime_checkable

import msgspec

from team.wire.bus import Bus, Outgoing, Sample, opened
from team.wire.channels import STATUS
from team.wire.codec import WireError
from team.wire.messages import Message, Status

STATUS_S = 0.5
"""Wall time between two statuses of a node."""
REMIND_S = 10.0
"""Wall time between two lines of a node that waits."""
WAIT_S = 0.05
"""How long a shell waits for input before it looks at its other duties."""
PARENT = "TEAMSLAM_PARENT"
"""Environment variable: the process without which this one must not live."""
LAST_S = 20
"""A process that was told to stop is ended by SIGALRM after this many seconds."""
_LOG = logging.getLogger("teamslam")
_PR_SET_PDEATHSIG = 1


@runtime_checkable
class Node(Protocol):
    """What a shell runs: messages and time in, messages out."""

    finished: bool

    def begin(self) -> list[Outgoing]:
        """What the node says first."""

    def handle(self, message: Message, now_ns: int) -> list[Outgoing]:
        """Take one message."""

    def status(self) -> Status:
        """What the node is doing, for people."""


class Shell:
    """Runs one node on one bus.

    What fails at the door is counted, logged with its reason, and dropped.
    """

    def __init__(self, bus: Bus, node: Node, name: str, stop: threading.Event) -> None:
        self.bus = bus
        self.node = node
        self._name = name
        self._stop = stop
        self._status_due = 0.0
        self._remind_due = time.monotonic() + REMIND_S
        self._refused = 0
        self._messages = 0
        self._bytes = 0
        self._since = time.monotonic()

    def begin(self) -> None:
        """Say what the node says first and declare it alive; its subscriptions are made before."""
        self.publish(self.node.begin())
        self.bus.declare_alive(self._name)
        self.report()

    @property
    def going(self) -> bool:
        """Until the node has finished or the process was told to stop."""
        return not (self.node.finished or self._stop.is_set())

    def publish(self, out: Iterable[Outgoing]) -> None:
        """Publish what a node returned, in its order."""
        for outgoing in out:
            self._bytes += self.bus.publish(outgoing)
            self._messages += 1

    def take(self, samples: Iterable[Sample]) -> None:
        """Decode at the door, hand to the node, publish its answer."""
        for sample in samples:
            try:
                _, _, message = opened(sample)
            except WireError as error:
                self._refused += 1
                _LOG.warning("%s: dropped %s: %s", self._name, sample.key, error)
                continue
            self.publish(self.node.handle(message, sample.stamp_ns))

    def report(self, *, last: bool = False) -> None:
        """Publish the node's status, at most every STATUS_S; the last one in any case."""
        now = time.monotonic()
        if last or now >= self._status_due:
            self._status_due = now + STATUS_S
            self._publish_status()

    def _publish_status(self) -> None:
        status = self.node.status()
        now = time.monotonic()
        elapsed = max(now - self._since, 1e-3)
        rates = {"messages_per_s": self._messages / elapsed, "bytes_per_s": self._bytes / elapsed}
        self._messages = self._bytes = 0
        self._since = now
        warnings = status.warnings
        if status.state != "waiting":
            self._remind_due = now + REMIND_S
        elif now >= self._remind_due:
            self._remind_due = now + REMIND_S
            _LOG.info("%s", "; ".join(warnings) or "waiting")
        if self._refused:
            warnings = (*warnings, f"{self._refused} messages were dropped at the door")
        status = msgspec.structs.replace(status, figures=status.figures | rates, warnings=warnings)
        self.bus.publish(Outgoing(STATUS, self._name, status))

    def run(self, duty: Callable[[], None] = lambda: None) -> None:
        """Turn after turn until the end: input, the node's answers, `duty`, status."""
        self.begin()
        while self.going:
            self.take(self.bus.receive(WAIT_S))
            duty()
            self.report()
        self.report(last=True)


@contextmanager
def process(name: str, *, endless: bool = False) -> Iterator[threading.Event]:
    """What every process of a team does: stop at SIGTERM and SIGINT, end when its parent dies.

    One that was told to stop has not done its work, so it ends with status 128 + the signal's
    number; one that is `endless` works until it is told to stop, and ends with 0.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format=f"{name}: %(message)s")
    stop = threading.Event()
    told: list[int] = []

    def take(number: int, _: FrameType | None) -> None:
        told.append(number)
        stop.set()
        signal.alarm(LAST_S)  # by the kernel: neither a closing link nor the exit holds it

    handlers = {number: signal.signal(number, take) for number in (signal.SIGTERM, signal.SIGINT)}
    parent = os.environ.get(PARENT)
    if parent is not None:
        _tie_to(int(parent), stop)
    try:
        yield stop
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if told and not endless:
        sys.exit(128 + told[0])


def _tie_to(parent: int, stop: threading.Event) -> None:
    """Stop when the parent is gone: at once where the kernel tells (Linux), else by looking.

    Whoever has not stopped by itself two seconds later is ended.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        stop.set()
        time.sleep(2.0)
        os._exit(1)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()
