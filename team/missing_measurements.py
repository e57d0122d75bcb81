"""Request missing measurements from their source."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from teamslam.team.containment import reply_of
from teamslam.team.shell import Shell
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import BusError
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.request_times import RequestTimes

ASK_TIMEOUT_S = 10.0
"""Longest time [s] for an answer; the request is repeated later."""
_LOG = logging.getLogger("teamslam")


class MissingMeasurements:
    """Request missing measurements for one node; call `look` periodically.

    confirm: called with each measurement of an answer before the node handles it.
    """

    def __init__(
        self, shell: Shell, confirm: Callable[[m.Measurement], None] = lambda _: None
    ) -> None:
        self._shell = shell
        self._confirm = confirm
        self._times: RequestTimes[Stream] = RequestTimes()

    def look(self, requested: Sequence[m.MeasurementsRequest]) -> None:
        """Send the requests that are due."""
        by_stream = {(each.robot, each.incarnation): each for each in requested}
        firsts = {stream: each.first for stream, each in by_stream.items()}
        for stream in self._times.due(firsts, time.monotonic()):
            each = by_stream[stream]
            _LOG.warning(
                "measurements %d to %d of %s, incarnation %d, are missing: asked for",
                each.first,
                each.last,
                each.robot,
                each.incarnation,
            )
            self.ask(each)

    def ask(self, requested: m.MeasurementsRequest) -> int:
        """Send one request; return the number of measurements received."""
        try:
            replies = self._shell.bus.ask(
                ch.MEASUREMENTS, requested.robot, requested, ASK_TIMEOUT_S
            )
        except BusError as error:
            _LOG.warning("%s", error)
            return 0
        for reply in replies:
            with suppress(WireError):  # the door counts it
                self._confirm(reply_of(reply, m.Measurement))
        self._shell.take_replies(ch.MEASUREMENTS, requested.robot, replies)
        return len(replies)
