"""The end of a team, which the router stores for absent processes."""

import logging
import os
import time
from collections.abc import Collection

from teamslam.team.wire.bus import Bus, BusError, Sample, read_reply
from teamslam.team.wire.channels import FINAL_MAP, KEPT, Channel, channel_of
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.messages import KeptRequest

FINAL_S = 3.0  # time [s] between two queries to the router for a missed end
FINAL_ASK_S = 2.0
SINCE = "TEAMSLAM_SINCE"
"""Environment variable: start of the run [ns, wall clock], if earlier than that of the process."""
_STARTED = time.monotonic()
_LOG = logging.getLogger("teamslam")


class EndQuery:
    """Query the router for the samples that end the team of this process.

    An end older than the process belongs to another run, unless SINCE is earlier, or an earlier
    process of this node was in that run and left without a `Tally`. robot: the robot of interest;
    "*": all.
    """

    def __init__(
        self,
        bus: Bus,
        node: str = "",
        ends: Collection[Channel] = (FINAL_MAP,),
        robot: str = "*",
    ) -> None:
        self._bus = bus
        self._node = node
        self._ends = tuple(channel.name for channel in ends)
        self._robot = robot
        self._due = 0.0
        began = os.environ.get(SINCE)
        self._before_s = 0.0 if began is None else time.time() - 1e-9 * int(began)

    def find_missed(self) -> list[Sample]:
        """Return the samples that end the team; query every FINAL_S."""
        now = time.monotonic()
        if now < self._due:
            return []
        self._due = now + FINAL_S
        # Before the query: ages are counted at its arrival, which may take its time.
        run_s = time.monotonic() - _STARTED + max(self._before_s, 0.0)
        request = KeptRequest(
            stamp_ns=0, channels=self._ends, node=self._node, run_ns=round(1e9 * run_s)
        )
        try:
            replies = self._bus.ask(KEPT, "", request, FINAL_ASK_S)
        except BusError as error:
            _LOG.debug("%s", error)
            return []
        return [sample for reply in replies for sample in self._ending(reply)]

    def _ending(self, reply: bytes) -> list[Sample]:
        try:
            sample = read_reply(KEPT, "", reply, 0)
        except WireError as error:
            _LOG.debug("%s", error)
            return []
        found = channel_of(sample.key)
        wanted = (
            found is not None
            and found[0].name in self._ends
            and (self._robot in ("*", found[1]) or not found[1])
        )
        return [sample] if wanted else []
