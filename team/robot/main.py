"""The robot process: the node's shell, with recovery of what it missed and of an earlier life."""

import logging
import threading
import time

from team.config import RobotConfig
from team.robot.node import RobotNode
from team.shell import Shell
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Bus, BusError
from team.wire.codec import decoded

GAP_PATIENCE_S = 0.5
"""A reading that is missing for so long is asked for at its source."""
ASK_TIMEOUT_S = 10.0
_LOG = logging.getLogger("teamslam")


class RobotShell:
    """A robot's process: subscribe, resume an earlier life if there was one, run."""

    def __init__(self, bus: Bus, config: RobotConfig, stop: threading.Event) -> None:
        self._bus = bus
        self.node = RobotNode(config)
        self._shell = Shell(bus, self.node, ch.robot_node(config.id), stop)
        self._gap_since: float | None = None

    def run(self) -> None:
        """Until the final map."""
        name = self.node.robot
        for channel in self.node.listens:
            self._bus.subscribe(channel, name)
        self._bus.watch_alive("central")
        if self._resume():
            self._catch_up()
        self._shell.run(self._mend)

    def _resume(self) -> bool:
        """Take over the submaps of an earlier life that the centre has; False if there are none."""
        wanted = m.SubmapsWanted(0, self.node.robot)
        replies = self._bus.ask(ch.SUBMAPS, "", wanted, ASK_TIMEOUT_S)
        if not replies:
            return False
        start = decoded(replies[0], m.Start)
        submaps = [decoded(reply, m.Submap) for reply in replies[1:]]
        self.node.resume(start, submaps)
        _LOG.info("resumed after submap %d of epoch %d", submaps[-1].sequence, start.epoch)
        return True

    def _catch_up(self) -> None:
        """Ask the source for everything since the last submap that it has published already."""
        while True:
            first = self.node.next_reading
            replies = self._ask(m.ReadingsWanted(0, self.node.robot, self.node.epoch, first, -1))
            if not replies or self.node.next_reading == first:
                return

    def _mend(self) -> None:
        """Ask for readings that have been missing for GAP_PATIENCE_S."""
        wanted = self.node.wanted()
        now = time.monotonic()
        if wanted is None:
            self._gap_since = None
        elif self._gap_since is None:
            self._gap_since = now
        elif now - self._gap_since > GAP_PATIENCE_S:
            self._gap_since = now
            _LOG.warning("readings %d to %d are missing: asked for", wanted.first, wanted.last)
            self._ask(wanted)

    def _ask(self, wanted: m.ReadingsWanted) -> int:
        try:
            replies = self._bus.ask(ch.READINGS, wanted.robot, wanted, ASK_TIMEOUT_S)
        except BusError as error:
            _LOG.warning("%s", error)
            return 0
        for reply in replies:
            self._shell.publish(self.node.handle(decoded(reply), 0))
        return len(replies)
