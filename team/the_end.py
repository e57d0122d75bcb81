"""The end of a team: the router keeps the final map for processes that were absent at the end."""

import logging
import os
import time

from team.wire.bus import Bus, BusError, Sample
from team.wire.channels import FINAL_KEPT, FINAL_MAP
from team.wire.codec import WireError, decoded
from team.wire.messages import FinalMapReply, FinalMapRequest, FusedMap

FINAL_S = 3.0
"""Time [s] between two queries to the router for a missed final map."""
FINAL_ASK_S = 2.0
SINCE = "TEAMSLAM_SINCE"
"""Environment variable: start of this process' run [ns, wall clock], where that is earlier than
the process."""
_LOG = logging.getLogger("teamslam")


_STARTED = time.monotonic()


def _forked() -> None:
    """Set the start of a forked process to the fork."""
    global _STARTED
    _STARTED = time.monotonic()


os.register_at_fork(after_in_child=_forked)


class TheEnd:
    """Finds out from the router whether the team of this process has ended.

    A process that starts again, or that was stopped or cut off while the centre left, learns of the
    end in this way. A map that is older than the process is another run's, unless whoever started
    it says that the run began earlier (SINCE), or the router knows an earlier process of this node
    that was in that run and ended without a `Tally`.
    """

    def __init__(self, bus: Bus, node: str = "") -> None:
        self._bus = bus
        self._node = node
        self._due = 0.0
        began = os.environ.get(SINCE)
        self._before_s = 0.0 if began is None else time.time() - 1e-9 * int(began)
        self._began = _STARTED

    def missed(self) -> list[Sample]:
        """The final map, if the router has it; it is asked at most every FINAL_S."""
        now = time.monotonic()
        if now < self._due:
            return []
        self._due = now + FINAL_S
        try:
            # Before the question: its age is told as of the answer, which may take its time.
            life_s = time.monotonic() - self._began + max(self._before_s, 0.0)
            replies = self._bus.ask(
                FINAL_KEPT, "", FinalMapRequest(stamp_ns=0, node=self._node), FINAL_ASK_S
            )
            replied = [decoded(reply, FinalMapReply) for reply in replies]
            return [_sample(k.final) for k in replied[:1] if k.missed or 1e-9 * k.age_ns <= life_s]
        except (BusError, WireError) as error:
            _LOG.debug("%s", error)
            return []


def _sample(final: bytes) -> Sample:
    stamp_ns = decoded(final, FusedMap).stamp_ns
    return Sample(FINAL_MAP.key(), final, stamp_ns, time.time_ns(), 0)
