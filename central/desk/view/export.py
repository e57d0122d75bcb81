"""Compute a recorded log's views."""

import threading
import time
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from teamslam.central.desk.peers_as_centre import LISTENS, PeersAsCentre, with_centre_messages
from teamslam.central.desk.view.node import ViewerNode
from teamslam.team.containment import Boundary
from teamslam.team.end_query import EndQuery
from teamslam.team.recording.reader import Log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.shell import STATUS_S, WAIT_S, judge
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Bus, Outgoing, Sample, try_open
from teamslam.team.wire.messages import FusedMap, Status

VIEWED = frozenset((*ViewerNode.listens, ch.ALIVE))
"""Channels of a viewer."""


def for_viewer(
    sample: Sample, channels: Collection[ch.Channel] = VIEWED
) -> tuple[ch.Channel, m.Message] | None:
    """Channel and message of a sample of these channels."""
    if ch.row_of(sample.key) not in channels:
        return None
    sound = try_open(sample)
    return None if sound is None else (sound[0], sound[2])


class Viewing:
    """Viewer node over samples."""

    def __init__(self) -> None:
        self.node = ViewerNode()
        self._counters: dict[str, int] = {}

    def take(self, sample: Sample, input_: tuple[ch.Channel, m.Message] | None) -> list[Sample]:
        """Views of a sample's message, with their own counters."""
        out = []
        for shown in [] if input_ is None else self.node.handle(*input_):
            counter = self._counters.get(shown.key, 0)
            self._counters[shown.key] = counter + 1
            out.append(Sample(shown.key, shown.payload, shown.stamp_ns, sample.wall_ns, counter))
        return out


def with_views(samples: Iterable[Sample]) -> Iterator[Sample]:
    """Yield samples, each followed by its views, without recorded ones."""
    viewing, centre = Viewing(), PeersAsCentre()
    for sample in samples:
        if ch.VIEW.owner(sample.key) is None:
            yield sample
            for each in with_centre_messages(centre, [sample]):
                yield from viewing.take(each, for_viewer(each))


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

    peers: robots whose agreed map is the final one. Raises FaultyRunError at the end if the map
    lacks a robot or a message could not be drawn.
    """
    viewing = Viewing()
    centre = PeersAsCentre(peers)
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
        for sample in with_centre_messages(centre, (*bus.receive(WAIT_S), *end.find_missed())):
            if ch.ALIVE.owner(sample.key) == NODE:
                continue
            try:
                input_ = for_viewer(sample)
                if input_ is not None and isinstance(input_[1], FusedMap) and input_[1].final:
                    final = input_[1]
                views = viewing.take(sample, input_)
            except Exception as error:  # omit a message that cannot be drawn
                bus.publish(boundary.note(error, sample, ""))
                continue
            for shown in views:
                bus.publish_raw(msgspec.structs.replace(shown, wall_ns=time.time_ns()))
                published += 1
    judge(boundary, final)
    return published
