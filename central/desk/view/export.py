"""Compute a recorded log's views."""

import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from teamslam.central.desk.peers_as_centre import LISTENS, PeersAsCentre
from teamslam.central.desk.view.node import ViewerNode
from teamslam.team.containment import Boundary
from teamslam.team.end_query import EndQuery
from teamslam.team.recording.reader import Log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.shell import STATUS_S, WAIT_S, judge
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, Outgoing, Sample, try_open
from teamslam.team.wire.messages import FusedMap, Status

VIEWED = frozenset((*ViewerNode.listens, ch.ALIVE))  # channels of a viewer


class Viewing:
    """Viewer node over samples, of peers also in a centre's name."""

    def __init__(self, peers: Collection[str] | None = None) -> None:
        self.node = ViewerNode()
        self._centre = PeersAsCentre(peers)
        self._counters = Counter[str]()

    def inputs(
        self, samples: Iterable[Sample], channels: Collection[ch.Channel] = VIEWED
    ) -> Iterator[tuple[Sample, ch.Channel, m.Message]]:
        """Yield the valid samples of these channels, decoded."""
        for sample in samples:
            for each in filter(None, (sample, self._centre.of(sample))):
                if ch.row_of(each.key) in channels and (sound := try_open(each)) is not None:
                    yield each, sound[0], sound[2]

    def draw(self, sample: Sample, channel: ch.Channel, message: m.Message) -> list[Sample]:
        """Views of a message, with their own counters."""
        out = []
        for shown in self.node.handle(channel, message):
            counter = self._counters[shown.key]
            self._counters[shown.key] += 1
            out.append(Sample(shown.key, shown.payload, shown.stamp_ns, sample.wall_ns, counter))
        return out


def with_views(samples: Iterable[Sample]) -> Iterator[Sample]:
    """Yield samples, each followed by its views, without recorded ones."""
    viewing = Viewing()
    for sample in samples:
        if ch.VIEW.owner(sample.key) is None:
            yield sample
            for each in viewing.inputs([sample]):
                yield from viewing.draw(*each)


class Drawn(NamedTuple):
    """Numbers of messages, of new views, and of recorded views."""

    own: int
    views: int
    before: int

    def __str__(self) -> str:
        text = f"{self.own + self.views} messages, {self.views} of them views"
        if self.before and self.before != self.views:
            text += (
                f" ({self.before} in the log: a viewer of the run draws only what it "
                "receives between joining and leaving)"
            )
        return text


def export_views(log: Log, out: Path) -> Drawn:
    """Write a log with its views redrawn. Raises LogError, RecorderError."""
    written, drawn, before = 0, 0, 0
    with Recorder(out, log.team, log.metadata) as recorder:

        def counted(samples: Iterable[Sample]) -> Iterator[Sample]:
            nonlocal before
            for sample in samples:
                before += ch.VIEW.owner(sample.key) is not None
                yield sample

        for sample in with_views(counted(log.samples())):
            recorder.write([sample])
            written += 1
            drawn += ch.VIEW.owner(sample.key) is not None
    return Drawn(written - drawn, drawn, before)


NODE = "viewer"


def run_viewer(bus: Bus, stop: threading.Event, peers: Collection[str] = ()) -> int:
    """Publish views until the final map is shown or `stop` is set; return their number.

    peers: robots whose agreed map is the final one. Raises FaultyRunError at the end.
    """
    viewing = Viewing(peers)
    for channel in (*viewing.node.listens, *LISTENS):
        bus.subscribe(channel)
    bus.watch_alive()
    bus.declare_alive(NODE)
    published = 0
    end = EndQuery(bus, NODE, ch.ENDS if peers else (ch.FINAL_MAP,))
    boundary = Boundary(NODE)
    due = 0.0
    final: FusedMap | None = None
    # After the end no map finishes the node.
    while not (viewing.node.finished or final is not None or stop.is_set()):
        if time.monotonic() >= due:
            due = time.monotonic() + STATUS_S
            figures = {"messages": float(published)}
            status = Status(stamp_ns=0, node=NODE, state="viewing", figures=figures)
            bus.publish(Outgoing(ch.STATUS, NODE, status))
        samples = (*bus.receive(WAIT_S), *end.find_missed())
        for sample, channel, message in viewing.inputs(samples):
            if ch.ALIVE.owner(sample.key) == NODE:
                continue
            if isinstance(message, FusedMap) and message.final:
                final = message
            try:
                views = viewing.draw(sample, channel, message)
            except Exception as error:  # omit a message that cannot be drawn
                bus.publish(boundary.note(error, sample, ""))
                continue
            for shown in views:
                bus.publish_raw(msgspec.structs.replace(shown, wall_ns=time.time_ns()))
                published += 1
    judge(boundary, final)
    return published
