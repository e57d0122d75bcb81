"""Viewer process: a bus around the node."""

import threading
import time
from collections.abc import Collection

import msgspec

from teamslam.central.desk.peers_as_centre import LISTENS, PeersAsCentre, with_centre_messages
from teamslam.central.desk.view.export import Viewing, for_viewer
from teamslam.team.containment import Boundary
from teamslam.team.end_query import EndQuery
from teamslam.team.shell import STATUS_S, WAIT_S, judge
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Bus, Outgoing
from teamslam.team.wire.messages import FusedMap, Status

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
            status = Status(
                stamp_ns=0, node=NODE, state="viewing", figures={"messages": float(published)}
            )
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
