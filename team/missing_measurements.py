"""Request missing measurements from their source."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from teamslam.team.containment import reply_of
from teamslam.team.shell import Shell
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import BusError
from teamslam.team.wire.codec import WireError

PATIENCE_S = 0.5
"""Time [s] for which a gap may stay open before it is requested."""
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
        self._since_s: float | None = None

    def look(self, requested: Sequence[m.MeasurementsRequest]) -> None:
        """Send the requests once one has been open for PATIENCE_S."""
        now_s = time.monotonic()
        if not requested:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = now_s
        elif now_s - self._since_s > PATIENCE_S:
            self._since_s = now_s
            for each in requested:
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
