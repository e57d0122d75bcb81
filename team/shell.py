"""The shell of a node owns its bus, clock and signals; the node computes the answers."""

import ctypes
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Protocol, TypeVar, runtime_checkable

import msgspec

from teamslam.team.config import MAP
from teamslam.team.containment import Boundary, reply_of
from teamslam.team.end_query import EndQuery
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Answer, Bus, BusError, Outgoing, Sample, read_reply
from teamslam.team.wire.codec import WireError, decoded
from teamslam.team.wire.intervals import RequestTimes

FAILED_S = 10.0
"""Time [s] before work that raised an exception is tried again."""


class SpareTime:
    """The time of the next piece of deferrable work; took_s: duration of the last useful one."""

    def __init__(self, share: float) -> None:
        self._rest = 1.0 / share - 1.0
        self._next = 0.0
        self.took_s: float | None = None

    @property
    def wait_s(self) -> float:
        """Time until the next piece may begin [s]; 0: now."""
        return max(0.0, self._next - time.monotonic())

    def note(self, began: float, *, useful: bool) -> None:
        """Record a piece that began at this monotonic time; useless ones are free."""
        now = time.monotonic()
        if useful:
            self.took_s = now - began
            self._next = now + self._rest * self.took_s

    def note_failure(self) -> None:
        """Record a piece that raised."""
        self._next = time.monotonic() + FAILED_S


STATUS_S = 0.5
"""Wall time [s] between two statuses of a node."""
REMIND_S = 10.0
"""Wall time [s] between two log lines of a node that waits."""
WAIT_S = 0.05
"""Time [s] that a shell waits for input before it turns to its other duties."""
RECORDER_S = 30.0
"""Time [s] for which a finished process stays for a recorder that is absent or makes no progress.
"""
BACK_S = 1.5
"""Time [s] in which a returned recorder fetches missed messages from the publishers' caches."""
RECORDER = "recorder"
PARENT = "TEAMSLAM_PARENT"
"""Environment variable: the process whose end ends this one."""
LAST_S = 20
"""SIGALRM ends a process this many seconds after its stop signal."""
T = TypeVar("T")
Take = Callable[[Sequence[Sample]], None]
_LOG = logging.getLogger("teamslam")
_PR_SET_PDEATHSIG = 1


@runtime_checkable
class Node(Protocol):
    """The interface of a node to its shell: messages in, messages out."""

    finished: bool

    def begin(self) -> list[Outgoing]:
        """Return the node's first messages."""

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Handle one message; return the answers."""

    def status(self) -> m.Status:
        """Return the node's status."""


class FaultyRunError(RuntimeError):
    """Messages were set aside in this run, or its final map lacks a robot."""


def judge(boundary: Boundary, final: m.FusedMap | None) -> None:
    """Raise FaultyRunError if any message was set aside, or the final map lacks a robot."""
    warnings = boundary.warnings if boundary.faults else ()
    lacks = "" if final is None else describe_missing(final)
    if warnings or lacks:
        raise FaultyRunError("; ".join((*warnings, *([lacks] if lacks else ()))))


def describe_missing(final: m.FusedMap) -> str:
    """Describe the robots that the final map lacks; empty: none."""
    found = []
    robots = [each for each in final.withdrawn if not each.startswith(MAP)]
    if robots:
        found.append(f"the final map is without {', '.join(robots)}: withdrawn")
    if final.lost:
        names = ", ".join(final.lost)
        found.append(f"the final map is provisional: {names} lost, and not wholly in it")
    return "; ".join(found)


class Shell:
    """Run one node on one bus; ends: channels on which the node's team ends."""

    def __init__(
        self,
        bus: Bus,
        node: Node,
        name: str,
        stop: threading.Event,
        ends: Collection[ch.Channel] = (ch.FINAL_MAP,),
    ) -> None:
        self.bus = bus
        self.node = node
        self._name = name
        self._stop = stop
        self._status_due = 0.0
        self._is_running = False
        self._remind_due = time.monotonic() + REMIND_S
        self.boundary = Boundary(name)
        self.notes: Callable[[], tuple[str, ...]] = tuple
        self.believed: Callable[[Sequence[Sample]], Sequence[Sample]] = lambda samples: samples
        """Filter for the samples that reach the node."""
        self.end_query = EndQuery(bus, name, ends)
        self.take_end: Take = self.take
        """Handler of the samples that end the team and that this node has missed."""
        self._recorder_is_there: bool | None = None
        self._recorder_since = 0.0
        self._totals: m.Tally | None = None
        self._lacking: dict[str, int] | None = None
        self._missing_least = 0
        self._messages = 0
        self._bytes = 0
        self._since = time.monotonic()
        self._refresh: Callable[[], list[Outgoing]] | None = None
        self._spare_time = SpareTime(1.0)
        self._stale = False

    def refresh_by(self, refresh: Callable[[], list[Outgoing]], share: float) -> None:
        """Publish `refresh()` after input, for at most `share` of the time."""
        self._refresh, self._spare_time = refresh, SpareTime(share)

    def receive(self) -> list[Sample]:
        """Receive samples for WAIT_S; publish a due refresh if none arrives."""
        refreshes = self._stale and self._refresh is not None
        wait_s = min(WAIT_S, self._spare_time.wait_s) if refreshes else WAIT_S
        samples = self.bus.receive(wait_s)
        if samples:
            self._stale = True
        elif refreshes and not self._spare_time.wait_s and self._refresh is not None:
            self._stale = False
            began = time.monotonic()
            out = self.contain("refresh", self._refresh)
            if out is None:
                self._spare_time.note_failure()
            else:
                self._spare_time.note(began, useful=bool(out))
                self.publish(out)
        return samples

    def begin(self) -> None:
        """Publish the first messages and declare the node alive, after subscribing."""
        self.publish(self.node.begin())
        self.bus.declare_alive(self._name)
        self._is_running = True
        self.report()

    @property
    def going(self) -> bool:
        """Whether the node has neither finished nor to stop."""
        return not (self.node.finished or self._stop.is_set())

    def publish(self, out: Iterable[Outgoing]) -> None:
        """Publish messages in order, and send requests; a failure is a fault."""
        for outgoing in out:
            try:
                if outgoing.channel in ch.QUERIES:
                    self.bus.request(*outgoing)
                    continue
                self._bytes += self.bus.publish(outgoing)
                self._messages += 1
            except Exception as error:
                sample = Sample(outgoing.key, b"", outgoing.message.stamp_ns, 0, -1)
                fault = self.boundary.note(error, sample, m.tag_of(type(outgoing.message)))
                if outgoing.channel is not ch.FAULT:
                    self.publish([fault])

    def take(self, samples: Iterable[Sample]) -> None:
        """Decode and handle samples; publish answers and status."""
        for sample in samples:
            self._note_recorder(sample)
            self.publish(self.boundary.take(self.node, sample))
            if self._is_running:
                self.report()

    def take_replies(self, channel: ch.Channel, name: str, replies: Iterable[bytes]) -> None:
        """Handle the replies to a query as `take` does."""
        for reply in replies:
            try:
                sample = read_reply(channel, name, reply, 0)
            except WireError as error:
                self.boundary.refuse(Sample(channel.key(name), reply, 0, 0, -1), str(error))
            else:
                self.publish(self.boundary.take(self.node, sample))

    def answer(self, channel: ch.Channel, name: str, answer: Answer) -> None:
        """Answer queries; an exception is a fault, which the sender is told."""

        def contained(request: bytes) -> list[bytes]:
            try:
                return list(answer(request))
            except ValueError:
                raise  # an unsound request: the asker's
            except Exception as error:
                sample = Sample(channel.key(name), request, 0, 0, -1)
                self.publish([self.boundary.note(error, sample, m.tag_of(channel.message))])
                raise ValueError(f"the answer failed: {type(error).__name__}") from error

        self.bus.answer(channel, name, contained)

    def contain(self, what: str, duty: Callable[[], T]) -> T | None:
        """Run `duty`; an exception other than BusError is a fault, and the result None."""
        try:
            return duty()
        except BusError:
            raise
        except Exception as error:
            self.publish([self.boundary.note(error, Sample(what, b"", 0, 0, -1), "")])
        return None

    def query_end(self) -> None:
        """Query the router for a missed end of the team."""
        if missed := self.end_query.find_missed():
            self.take_end(missed)

    def note(self, samples: Iterable[Sample]) -> None:
        """Read the recorder's messages among these samples."""
        for sample in samples:
            self._note_recorder(sample)

    def _note_recorder(self, sample: Sample) -> None:
        if sample.key == ch.ALIVE.key(RECORDER):
            with suppress(WireError):
                there = decoded(sample.payload, m.Liveliness).alive
                came_back = there and self._recorder_is_there is False
                if came_back or not there:
                    self._recorder_since = time.monotonic()
                    self._lacking = None
                self._recorder_is_there = there
        elif sample.key == ch.RECORDED.key(self._name) and self._totals is not None:
            with suppress(WireError):
                self._note_recorded(decoded(sample.payload, m.Tally), self._totals)

    def _note_recorded(self, has: m.Tally, totals: m.Tally) -> None:
        if has.since_ns != totals.since_ns:
            return
        published = dict(zip(totals.keys, totals.counts, strict=True))
        counted = zip(has.keys, has.counts, strict=True)
        lacking = {key: published.get(key, 0) - count for key, count in counted}
        missing = sum(lacking.values())
        if self._lacking is None or missing < self._missing_least:
            self._recorder_since, self._missing_least = time.monotonic(), missing
        self._lacking = lacking

    def wait_for_recorder(self, lacks: Callable[[], bool], take: Take | None = None) -> None:
        """Wait until a recorder has all messages of this process, or makes no progress for
        RECORDER_S.

        lacks: whether it lacks anything else. take: handles other samples meanwhile.
        """
        if self._recorder_is_there is None:
            return
        self.bus.subscribe(ch.RECORDED, self._name)
        self._totals = self.bus.publish_totals()
        now = time.monotonic()
        away = not self._recorder_is_there
        self._recorder_since = now if away else max(self._recorder_since, now - BACK_S)
        due = now + REMIND_S
        while not self._stop.is_set() and not self._is_recorded(lacks):
            now = time.monotonic()
            reports = self._recorder_is_there and self._totals is not None
            if (
                self._lacking is not None or not reports
            ) and now - self._recorder_since >= RECORDER_S:
                _LOG.warning("the recorder lacks something of this process: %s", self._lacks())
                return
            if now >= due:
                due = now + REMIND_S
                _LOG.info("waiting for the recorder: %s", self._lacks())
            samples = self.bus.receive(WAIT_S)
            self.note(samples)
            if take is not None:
                take([sample for sample in samples if sample.key != ch.RECORDED.key(self._name)])

    def _is_recorded(self, lacks: Callable[[], bool]) -> bool:
        if not self._recorder_is_there or lacks():
            return False
        if self._totals is not None:
            return self._lacking == {}
        return time.monotonic() - self._recorder_since >= BACK_S

    def _lacks(self) -> str:
        if not self._recorder_is_there:
            return "it is away"
        if not self._lacking:
            return "it has not reported what it has"
        missing, keys = sum(self._lacking.values()), list(self._lacking)
        return f"it lacks {missing} messages on {len(keys)} keys, as {keys[0]}"

    def end(self, final: m.FusedMap | None) -> None:
        """Raise FaultyRunError if any message was set aside, or the final map lacks a robot."""
        judge(self.boundary, final)

    def report(self, *, last: bool = False) -> None:
        """Publish the node's status, at most every STATUS_S."""
        now = time.monotonic()
        if last or now >= self._status_due:
            self._status_due = now + STATUS_S
            self._publish_status()

    def _publish_status(self) -> None:
        status = self.contain("status", self.node.status)
        if status is None:
            status = m.Status(
                stamp_ns=0,
                node=self._name,
                state="unknown",
                figures={},
                warnings=("its status failed: see its faults",),
            )
        now = time.monotonic()
        elapsed = max(now - self._since, 1e-3)
        rates = {"messages_per_s": self._messages / elapsed, "bytes_per_s": self._bytes / elapsed}
        self._messages = self._bytes = 0
        self._since = now
        warnings = (*self.notes(), *status.warnings)
        if status.state != "waiting":
            self._remind_due = now + REMIND_S
        elif now >= self._remind_due:
            self._remind_due = now + REMIND_S
            _LOG.info("%s", "; ".join(warnings) or "waiting")
        warnings = (*warnings, *self.boundary.warnings)
        if self._spare_time.took_s is not None:
            rates["fresh_s"] = self._spare_time.took_s
        if self.boundary.faults:
            rates["faults"] = float(self.boundary.faults)
        if self.bus.dropped:
            rates["dropped_samples"] = float(self.bus.dropped)
        status = msgspec.structs.replace(status, figures=status.figures | rates, warnings=warnings)
        self.bus.publish(Outgoing(ch.STATUS, self._name, status))

    def run(self, duty: Callable[[], None] = lambda: None) -> None:
        """Run until the end: receive, handle, publish, run `duty`, publish the status."""
        self.begin()
        while self.going:
            self.take(self.believed(self.receive()))
            self.query_end()
            self.contain("duty", duty)
            self.report()
        self.report(last=True)


ASK_TIMEOUT_S = 10.0
"""Longest time [s] for an answer; the request is repeated later."""
R = TypeVar("R", m.MeasurementsRequest, m.SubmapsRequest)


def select_due(requests: Iterable[R], times: RequestTimes[tuple[str, int]]) -> list[R]:
    """Select the requests that are due, one for each stream."""
    by_stream = {(each.robot, each.incarnation): each for each in requests}
    firsts = {stream: each.first for stream, each in by_stream.items()}
    return [by_stream[stream] for stream in times.due(firsts, time.monotonic())]


class MissingMeasurements:
    """Request missing measurements; confirm: called with each before the node handles it."""

    def __init__(
        self, shell: Shell, confirm: Callable[[m.Measurement], None] = lambda _: None
    ) -> None:
        self._shell = shell
        self._confirm = confirm
        self._times: RequestTimes[tuple[str, int]] = RequestTimes()

    def look(self, requests: Sequence[m.MeasurementsRequest]) -> None:
        """Send the requests that are due."""
        for each in select_due(requests, self._times):
            _LOG.warning(
                "measurements %d to %d of %s, incarnation %d, are missing: asked for",
                each.first,
                each.last,
                each.robot,
                each.incarnation,
            )
            self.ask(each)

    def ask(self, request: m.MeasurementsRequest) -> int:
        """Send one request; return the number of measurements received."""
        try:
            replies = self._shell.bus.ask(ch.MEASUREMENTS, request.robot, request, ASK_TIMEOUT_S)
        except BusError as error:
            _LOG.warning("%s", error)
            return 0
        for reply in replies:
            with suppress(WireError):  # the door counts it
                self._confirm(reply_of(reply, m.Measurement))
        self._shell.take_replies(ch.MEASUREMENTS, request.robot, replies)
        return len(replies)


@contextmanager
def process(
    name: str, *, endless: bool = False, patient: bool = False
) -> Iterator[threading.Event]:
    """Run a process of a team until SIGTERM, SIGINT or its parent's death.

    A process stopped before its work is done exits with 128 + the signal's number; an `endless` one
    with 0. The kernel ends it LAST_S after the first signal, a `patient` process after the second.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format=f"{name}: %(message)s")
    stop = threading.Event()
    signals: list[int] = []

    def take(number: int, _: FrameType | None) -> None:
        signals.append(number)
        stop.set()
        if patient:
            signal.alarm(min(len(signals) - 1, 1))  # of 0: never
            return
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
    if signals and not endless:
        sys.exit(128 + signals[0])


def _tie_to(parent: int, stop: threading.Event) -> None:
    """Request a stop at the parent's death (Linux: a signal; else polling); exit 2 s later."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        stop.set()
        time.sleep(2.0)
        os._exit(1)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()
