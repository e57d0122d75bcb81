"""Processes `record` and `replay`: bus and clock around recorder and reader."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing

import msgspec

from teamslam.team.end_query import EndQuery
from teamslam.team.recording.inventory import MISSING, Inventory, NumberedStream
from teamslam.team.recording.reader import LOG_ID
from teamslam.team.recording.recorder import Recorder, RecorderError
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, Outgoing, Sample, open_valid
from teamslam.team.wire.codec import WireError, decoded, encoded
from teamslam.team.wire.intervals import RequestTimes, describe_intervals


def schedule(samples: Iterable[Sample], speed: float) -> Iterator[tuple[float, Sample]]:
    """Yield (delay [s] after the previous one, sample), in the given order, at `speed` × team time.

    delay = max(0, t − newest stamp so far)/speed: delays sum to the elapsed team time. Raises
    ValueError unless speed > 0.
    """
    if not speed > 0.0:
        raise ValueError(f"out of bounds: speed {speed} is not positive")
    newest: int | None = None
    for sample in samples:
        ahead_ns = 0 if newest is None else max(0, sample.stamp_ns - newest)
        newest = sample.stamp_ns if newest is None else max(newest, sample.stamp_ns)
        yield 1e-9 * ahead_ns / speed, sample


NODE = "recorder"
PROGRESS_EVERY = 256  # measurements of a robot between progress reports under load
_FAR_BEHIND = 20_000  # samples that the disk writes in half a second
_WAIT_S = 0.05
_PACE_S = 0.01  # length of a receive turn; a turn per message costs a third more CPU
_QUIET_S = 0.5
_STATUS_S = 1.0
_REMIND_S = 10.0
_RETRY_S = 5.0
_LOG = logging.getLogger("teamslam")


More = Callable[[], tuple[Recorder, Inventory]]
"""Open a further part of a log, with the earlier inventory. Raises `RecorderError`."""


class RecordLoop:
    """Write each bus sample once, request missing ones, and report progress.

    expected: nodes whose absence is a warning. inventory: of earlier parts. more: opens the next
    part after a write error, which is raised without it. peers: recording ends when each has
    concluded, or was given up or withdrawn, or with the centre's final map.
    """

    def __init__(
        self,
        bus: Bus,
        recorder: Recorder,
        expected: Collection[str],
        inventory: Inventory | None = None,
        more: More | None = None,
        peers: Collection[str] = (),
    ) -> None:
        self._bus = bus
        self._are_peers = bool(peers)
        self._unconcluded = set(peers)
        self._recorder: Recorder | None = recorder
        self._run = recorder.metadata.get(LOG_ID, "")
        self._more = more
        self._failure: RecorderError | None = None
        self._retry_s = 0.0
        self._inventory = Inventory() if inventory is None else inventory
        self._request_times: RequestTimes[NumberedStream] = RequestTimes()
        self._reported: dict[tuple[str, int], tuple[int, int]] = {}
        self._missing = set(expected)
        self._alive: set[str] = set()
        self._newest_ns = 0
        self._has_map = False
        self._messages = 0
        self._statuses = 0
        self._dropped = 0
        self._leaving: dict[str, m.Tally] = {}
        for channel in ch.CHANNELS:
            if channel.recorded and channel is not ch.ALIVE:
                bus.subscribe(channel, whole=True)
        orders = tuple(channel.name for channel in ch.ORDERS if channel.recorded)
        request = m.KeptRequest(stamp_ns=0, channels=orders)  # their publisher may have left
        bus.request(ch.KEPT, "", request)
        bus.watch_alive()
        bus.declare_alive(NODE)

    @property
    def written(self) -> int:
        """Number of messages written."""
        return self._messages + self._statuses

    @property
    def finished(self) -> bool:
        """Whether the final map is logged and no other process is present."""
        return self._has_ended and not self._alive

    @property
    def _has_ended(self) -> bool:
        return self._has_map or (self._are_peers and not self._unconcluded)

    def take(self, samples: list[Sample]) -> None:
        """Write samples; report progress of due robots, or of all without samples.

        A new submap is reported at once, since its robot stays until then. A writing thread far
        behind stops the reports, which are credit.
        """
        noted = [
            (each, self._note_sample(each)) for each in samples if ch.row_of(each.key) is not None
        ]
        self._dropped += len(samples) - len(noted)
        self._write([own for sample, own in noted if self._inventory.is_new(sample)])
        leaving = [each for each, _ in noted if ch.TALLY.owner(each.key) is not None]
        tallies = [message for _, _, message in open_valid(leaving) if isinstance(message, m.Tally)]
        self._leaving |= {tally.node: tally for tally in tallies}
        if self._is_far_behind:
            return
        for tally in tallies:
            self._report_lacking(tally)
        every = PROGRESS_EVERY if samples else 1
        for (robot, incarnation), (measurements, submaps) in self._inventory.counts().items():
            before = self._reported.get((robot, incarnation), (0, 0))
            if measurements - before[0] >= every or submaps > before[1]:
                progress = m.Progress(
                    stamp_ns=self._newest_ns,
                    node=NODE,
                    robot=robot,
                    incarnation=incarnation,
                    measurements=measurements,
                    submaps=submaps,
                )
                self._bus.publish(Outgoing(ch.RECORDER_PROGRESS, robot, progress))
                self._reported[robot, incarnation] = (measurements, submaps)

    @property
    def _is_far_behind(self) -> bool:
        return self._recorder is not None and self._recorder.waiting() > _FAR_BEHIND

    def _report_lacking(self, tally: m.Tally) -> None:
        found = self._inventory.received.lacking(tally, self._bus.find_awaited())
        has = msgspec.structs.replace(tally, keys=tuple(found), counts=tuple(found.values()))
        self._bus.publish(Outgoing(ch.RECORDED, tally.node, has))

    def _write(self, samples: list[Sample]) -> None:
        if self._recorder is None:
            return
        try:
            self._recorder.write(samples)
        except RecorderError as error:
            if self._more is None:
                raise
            _LOG.error("nothing is recorded any more: %s; trying again every %g s", error, _RETRY_S)
            self._recorder, self._failure = None, error
            self._retry_s = time.monotonic() + _RETRY_S
        else:
            self._messages += len(samples)

    def _open_next_part(self, now_s: float) -> None:
        if self._recorder is not None or self._more is None or now_s < self._retry_s:
            return
        self._retry_s = now_s + _RETRY_S
        try:
            self._recorder, self._inventory = self._more()
        except RecorderError as error:
            self._failure = error
            return
        self._failure = None
        self._reported.clear()
        self._bus.redeliver()
        _LOG.warning("recording goes on in %s", self._recorder.path)

    def close(self) -> None:
        """Complete the log; raises `RecorderError`."""
        try:
            if self._recorder is not None:
                self._recorder.close()
        except RecorderError as error:
            self._failure = error
        if self._failure is not None:
            raise self._failure

    def request_missing(self, now_s: float) -> None:
        """Request long-missing messages from sources and robots, without blocking."""
        self._open_next_part(now_s)
        for stream in self._request_times.due(self._inventory.gaps, now_s):
            kind, robot, incarnation = stream
            first, last = self._inventory.span(stream)
            _LOG.info("%s of %s are missing: asked for", f"{kind} {first} to {last}", robot)
            wanted = m.SubmapsRequest(
                stamp_ns=self._newest_ns, robot=robot, incarnation=incarnation, first=first
            )
            if kind == "submaps":
                self._bus.request(ch.SENT, robot, wanted)
                continue
            fields = msgspec.structs.asdict(wanted)
            requested = m.MeasurementsRequest(**fields, last=last, only=True)
            self._bus.request(ch.MEASUREMENTS, robot, requested)

    @property
    def lacking(self) -> list[str]:
        """Missing messages, as text."""
        numbered = [f"{key}: {what}" for key, what in self._inventory.findings()]
        others = [
            f"{key}: {describe_intervals(lost)}"
            for key, lost in self._bus.find_missing().items()
            if (found := ch.channel_of(key)) is None or found[0] not in (*ch.SENSORS, ch.SUBMAP)
        ]
        return [*numbered, *others]

    def _note_sample(self, sample: Sample) -> Sample:
        found = ch.channel_of(sample.key)
        if found is None:
            return sample
        channel, name = found
        if channel is ch.ALIVE:
            return self._note_liveliness(sample, name)
        self._newest_ns = max(self._newest_ns, sample.stamp_ns)
        self._has_map = self._has_map or channel is ch.FINAL_MAP
        if channel is ch.CONCLUDED or channel is ch.ORDER:
            self._unconcluded.discard(name)
        elif channel is ch.GIVEN_UP:
            self._unconcluded.discard(ch.robot_of(name) or "")
        return sample

    def _note_liveliness(self, sample: Sample, node: str) -> Sample:
        try:
            came = decoded(sample.payload, m.Liveliness).alive
        except WireError as error:  # not a node name: recorded unchanged
            _LOG.warning("%.80s: %s", sample.key, error)
            return msgspec.structs.replace(sample, stamp_ns=self._newest_ns)
        (self._alive.add if came else self._alive.discard)(node)
        if not came:
            self._leaving.pop(node, None)
        self._missing.discard(node)
        message = m.Liveliness(stamp_ns=self._newest_ns, node=node, alive=came)
        return msgspec.structs.replace(sample, payload=encoded(message), stamp_ns=self._newest_ns)

    def check_end(self, end: EndQuery) -> None:
        """Request a missed end, and remove processes that left unannounced."""
        missed = end.find_missed()
        if missed and not self._has_ended:
            self.take(missed)
        if missed and self._has_ended:
            self._alive = {node for node in self._alive if self._bus.is_alive(node)}

    def status(self, *, last: bool = False) -> m.Status:
        """Publish and log the recorder's status; the last one lists missing messages."""
        for tally in [] if last or self._is_far_behind else self._leaving.values():
            self._report_lacking(tally)
        waiting = 0 if self._recorder is None else self._recorder.waiting()
        figures = {"messages": float(self._messages), "waiting": float(waiting)}
        dropped = 0 if self._recorder is None else self._recorder.dropped
        if dropped := dropped + self._dropped + self._bus.dropped:
            figures["dropped_samples"] = float(dropped)
        failure = () if self._failure is None else (f"nothing is recorded: {self._failure}",)
        absent = tuple(f"{node} has not appeared yet" for node in sorted(self._missing))
        lacking = tuple(f"{MISSING}{what}" for what in self.lacking) if last else ()
        status = m.Status(
            stamp_ns=self._newest_ns,
            node=NODE,
            state="done" if last else "recording",
            figures=figures,
            warnings=(*failure, *absent, *lacking),
            run=self._run,
        )
        self._bus.publish(Outgoing(ch.STATUS, NODE, status))
        self._write([_own(ch.STATUS.key(NODE), status, self._statuses)])
        self._statuses += 1
        return status

    def run(self, stop: threading.Event, scenario: Sequence[m.Configuration] = ()) -> int:
        """Record until the final map is there and all nodes have left, or `stop`; count the
        messages.

        scenario: configurations logged for a team without a world. Raises `RecorderError` on a
        write error: at once without `more`, else at the end.
        """
        with closing(self):
            announced = [_own(ch.WORLD_CONFIG.key(), each, 0) for each in scenario]
            self._write([each for each in announced if self._inventory.is_new(each)])
            due = time.monotonic()
            remind_due = due + _REMIND_S
            end = EndQuery(self._bus, NODE, ch.ENDS if self._are_peers else (ch.FINAL_MAP,))
            while not stop.is_set():
                if self.finished:
                    # A token has priority over data: overtaken messages still arrive.
                    if not (samples := self._bus.receive(_QUIET_S)):
                        break
                    self.take(samples)
                self.take(samples := self._bus.receive(_WAIT_S))
                self.request_missing(time.monotonic())
                self.check_end(end)
                if time.monotonic() >= due:
                    due = time.monotonic() + _STATUS_S
                    status = self.status()
                    if status.warnings and time.monotonic() >= remind_due:
                        remind_due = time.monotonic() + _REMIND_S
                        _LOG.info("%s", "; ".join(status.warnings))
                if 0 < len(samples) < PROGRESS_EVERY:
                    stop.wait(_PACE_S)
            self.take(self._bus.receive(0.0))
            for warning in self.status(last=True).warnings:
                _LOG.warning("%s", warning)
        return self.written


def replay(bus: Bus, samples: Iterable[Sample], speed: float, stop: threading.Event) -> int:
    """Publish samples unchanged at `speed` × team time until `stop`; return their number."""
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


def _own(key: str, message: m.Message, counter: int) -> Sample:
    return Sample(key, encoded(message), message.stamp_ns, time.time_ns(), counter)
