"""The processes `record` and `replay`: a bus and a clock around the recorder and the reader."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import NamedTuple

import msgpack

from team.recording.recorder import Recorder
from team.recording.replayer import schedule
from team.the_end import TheEnd
from team.wire.bus import Bus, Outgoing, Sample
from team.wire.channels import (
    ALIVE,
    CHANNELS,
    FINAL_MAP,
    RECORDER_PROGRESS,
    SENSORS,
    STATUS,
    channel_of,
)
from team.wire.codec import WireError, decoded, encoded
from team.wire.messages import Liveliness, Message, Progress, Status

NODE = "recorder"
PROGRESS_EVERY = 256
"""Readings of a robot between two reports of progress while the queue is busy."""
_FAR_BEHIND = 20_000  # samples: the disk takes half a second for as many
_WAIT_S = 0.05
_QUIET_S = 0.5
_STATUS_S = 1.0
_REMIND_S = 10.0
_LOG = logging.getLogger("teamslam")
_HEAD = 128  # bytes of a reading: its tag, stamp, robot and epoch are within


class _Taken(NamedTuple):
    epoch: int
    readings: int
    reported: int


class RecordLoop:
    """Takes samples from a bus, writes them, and says how far it is.

    The log also gets what the recorder itself observes: `Liveliness` of the others, at the newest
    team time seen, and its own status.
    """

    def __init__(self, bus: Bus, recorder: Recorder, expected: Collection[str]) -> None:
        self._bus = bus
        self._recorder = recorder
        self._missing = set(expected)
        self._alive: set[str] = set()
        self._taken: dict[str, _Taken] = {}
        self._newest_ns = 0
        self._final = False
        self._messages = 0
        self._statuses = 0
        for channel in CHANNELS:
            if channel.recorded and channel is not ALIVE:
                bus.subscribe(channel)
        bus.watch_alive()
        bus.declare_alive(NODE)

    @property
    def written(self) -> int:
        """How many messages have gone to the log."""
        return self._messages + self._statuses

    @property
    def finished(self) -> bool:
        """The final map is in the log and nobody else is alive."""
        return self._final and not self._alive

    def take(self, samples: list[Sample]) -> None:
        """Write these samples; report progress of robots that are due, of all when there are none.

        Progress is credit: while the writing thread is far behind, nothing is reported.
        """
        noted = [self._noted(sample) for sample in samples]
        self._recorder.write(noted)
        self._messages += len(noted)
        if self._recorder.waiting() > _FAR_BEHIND:
            return
        for robot, (epoch, readings, reported) in self._taken.items():
            if readings - reported >= (PROGRESS_EVERY if samples else 1):
                progress = Progress(self._newest_ns, NODE, robot, epoch, readings, 0)
                self._bus.publish(Outgoing(RECORDER_PROGRESS, robot, progress))
                self._taken[robot] = _Taken(epoch, readings, readings)

    def _noted(self, sample: Sample) -> Sample:
        found = channel_of(sample.key)
        if found is None:
            return sample
        channel, name = found
        if channel is ALIVE:
            return self._noted_alive(sample, name)
        self._newest_ns = max(self._newest_ns, sample.stamp_ns)
        self._final = self._final or channel is FINAL_MAP
        if channel in SENSORS:
            epoch = _epoch_in(sample.payload)
            before = self._taken.get(name)
            if before is None or before.epoch != epoch:
                before = _Taken(epoch, 0, 0)
            self._taken[name] = before._replace(readings=before.readings + 1)
        return sample

    def _noted_alive(self, sample: Sample, node: str) -> Sample:
        try:
            came = _is_alive(sample.payload)
        except WireError as error:  # a name that no node has: recorded as it came
            _LOG.warning("%.80s: %s", sample.key, error)
            return replace(sample, stamp_ns=self._newest_ns)
        (self._alive.add if came else self._alive.discard)(node)
        self._missing.discard(node)
        message = Liveliness(self._newest_ns, node, came)
        return replace(sample, payload=encoded(message), stamp_ns=self._newest_ns)

    def look(self, end: TheEnd) -> None:
        """Take a final map that was missed, and see who has left while nobody said so."""
        missed = end.missed()
        if missed and not self._final:
            self.take(missed)
        if missed:
            self._alive = {node for node in self._alive if self._bus.is_alive(node)}

    def status(self) -> Status:
        """Publish and log what the recorder is doing; returns it."""
        waiting = self._recorder.waiting()
        figures = {"messages": float(self._messages), "waiting": float(waiting)}
        warnings = tuple(f"{node} has not appeared yet" for node in sorted(self._missing))
        status = Status(self._newest_ns, NODE, "recording", figures, warnings)
        self._bus.publish(Outgoing(STATUS, NODE, status))
        self._recorder.write([_own(STATUS.key(NODE), status, self._statuses)])
        self._statuses += 1
        return status


def record(
    bus: Bus,
    recorder: Recorder,
    expected: Collection[str] = (),
    on_status: Callable[[Status], None] | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Record until the final map is there and all other nodes have gone, or until `stop`; close.

    Returns how many messages were written.
    `expected`: nodes whose absence is a warning in the status. Raises `RecorderError` when the log
    can not be written.
    """
    stop = threading.Event() if stop is None else stop
    with recorder:
        loop = RecordLoop(bus, recorder, expected)
        due = time.monotonic()
        remind_due = due + _REMIND_S
        end = TheEnd(bus)
        while not (stop.is_set() or loop.finished):
            loop.take(bus.receive(_WAIT_S))
            loop.look(end)
            if time.monotonic() >= due:
                due = time.monotonic() + _STATUS_S
                status = loop.status()
                if on_status is not None:
                    on_status(status)
                if status.warnings and time.monotonic() >= remind_due:
                    remind_due = time.monotonic() + _REMIND_S
                    _LOG.info("%s", "; ".join(status.warnings))
        loop.take(bus.receive(0.0))
        # A token goes with a higher priority than data: what it overtook is still on its way.
        while loop.finished and (samples := bus.receive(_QUIET_S)):
            loop.take(samples)
    return loop.written


def replay(bus: Bus, samples: Iterable[Sample], speed: float, stop: threading.Event) -> int:
    """Publish samples again, byte by byte, at `speed` × team time; returns how many.

    Each is due at a time counted from the first, so that delays do not add up. Ends when `stop` is
    set.
    """
    due = time.monotonic()
    published = 0
    for delay, sample in schedule(samples, speed):
        due += delay
        wait = due - time.monotonic()
        if stop.wait(wait) if wait > 0.0 else stop.is_set():
            break
        bus.publish_raw(sample)
        published += 1
    return published


def _own(key: str, message: Message, counter: int) -> Sample:
    return Sample(key, encoded(message), message.stamp_ns, time.time_ns(), counter)


def _epoch_in(payload: bytes) -> int:
    """The epoch of a reading, [tag, stamp, robot, epoch, …]; 0 when it is no reading."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(payload[:_HEAD])
    try:
        if unpacker.read_array_header() < 4:
            return 0
        for _ in range(3):
            unpacker.skip()
        epoch = unpacker.unpack()
    except (ValueError, msgpack.UnpackException):
        return 0  # unsound readings are recorded as they came; whoever opens them will say so
    return epoch if isinstance(epoch, int) and epoch >= 0 else 0


def _is_alive(payload: bytes) -> bool:
    return decoded(payload, Liveliness).alive
