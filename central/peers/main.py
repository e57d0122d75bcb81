"""The process of a robot that is its own centre: a robot's shell, with its set on disk."""

import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from central.config import CentralConfig
from central.peers.fold import FoldWhen
from central.peers.robot import PeerRobot
from team.config import Exchange, RobotConfig
from team.peers.members import Member
from team.peers.proofs import Signs
from team.peers.store import Store, StoreError
from team.robot.main import SECOND_PATIENCE_S, RobotShell
from team.shell import Shell
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import NO_COUNTER, Bus, Sample

LINGER_S = 5.0
"""A robot that knows that all others have concluded stays so long, so that they know of it, too."""
WORLD_GONE_S = 1.0
"""The world leaves when everyone has concluded; one that died is there again sooner."""
_LOG = logging.getLogger("teamslam")


def _as_heard(member: Member) -> Sample:
    stamp_ns = member.message.stamp_ns
    return Sample(member.key, member.payload, stamp_ns, time.time_ns(), NO_COUNTER)


class PeerShell(RobotShell):
    """A robot's process without a centre: subscribe, go on with what is on disk, run, stay for
    others.

    store: where its set is kept; None: nowhere.
    """

    def __init__(
        self,
        bus: Bus,
        config: RobotConfig,
        stop: threading.Event,
        *,
        central: CentralConfig,
        robots: Sequence[str],
        store: Path | None = None,
        exchange: Exchange = "continuous",
        when: FoldWhen = "always",
        signer: Signs | None = None,
        patience_s: float = SECOND_PATIENCE_S,
    ) -> None:
        super().__init__(bus, config, stop, patience_s, exchange)
        self._peer = PeerRobot(config, central, robots, exchange, when, signer)
        self.node = self._peer.node
        self._shell = Shell(bus, self._peer, self._peer.name, stop)
        self._store = None if store is None else Store(store)
        self._over_since: float | None = None

    def run(self) -> None:
        """Until nobody needs this peer any more."""
        try:
            super().run()
        finally:
            if self._store is not None:
                self._store.close()

    def _subscribe(self) -> None:
        everyones = self._peer.overhears
        for channel in self._peer.listens:
            if channel not in everyones:
                self._bus.subscribe(channel, self.node.robot)
        for channel in everyones:
            self._bus.subscribe(channel)
        self._bus.watch_alive()
        self._shell.answer(ch.MEMBERS, self._peer.name, self._peer.answer)

    def _resume(self) -> bool:
        """Take over what is on disk; whether the stream goes on behind it."""
        if self._store is None or not self._store.kept:
            return False
        goes_on = self._peer.restore(self._store.kept)
        self._peer.peer.unsaved.clear()
        self.node = self._peer.node
        _LOG.info(
            "%d members of the set from %s, of this robot %d submaps",
            len(self._store.kept),
            self._store.path,
            self.node.submaps,
        )
        return goes_on

    @property
    def _final(self) -> m.FusedMap | None:
        return self._peer.final

    def _duty(self) -> None:
        self._mend()
        now = time.monotonic()
        self._shell.publish(self._peer.tick(now))
        self._log_carried()
        self._save()
        self._peer.finished = self._may_leave(now)

    def _log_carried(self) -> None:
        """What others have brought stands in the robot's own log as who first said it had said it:
        so the log proves the robot's maps, and logs of a team can be merged.
        """
        members, self._peer.carried = self._peer.carried, []
        tap = getattr(self._bus, "tap", None)
        if tap is not None and members:
            tap([_as_heard(member) for member in members])

    def _save(self) -> None:
        members, self._peer.peer.unsaved = self._peer.peer.unsaved, []
        if self._store is None or not members:
            return
        try:
            self._store.append(members)
        except StoreError as error:
            _LOG.error("the set is not kept any more: %s", error)
            self._store.close()
            self._store = None

    def _may_leave(self, now: float) -> bool:
        """Nobody needs this peer any more: all have concluded, or the world has left."""
        if self._peer.final is None:
            self._over_since = None
            return False
        known = self._peer.all_concluded
        if not known and self._peer.world_alive is not False:
            self._over_since = None
            return False
        self._over_since = now if self._over_since is None else self._over_since
        gone = self._peer.world_alive is False
        return now - self._over_since >= (WORLD_GONE_S if gone else LINGER_S)
