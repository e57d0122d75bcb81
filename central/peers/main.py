"""Processes of peers: a robot that is its own centre, and a centre among peers."""

import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.peers.fold import FoldWhen
from teamslam.central.peers.peer import CENTRE, Peer
from teamslam.central.peers.robot import PeerRobot
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.peers.members import Member
from teamslam.team.peers.proofs import Proofs
from teamslam.team.peers.set_file import SetFile
from teamslam.team.robot.main import SECOND_PATIENCE_S, RobotShell
from teamslam.team.shell import Shell
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, Outgoing, Tap

if TYPE_CHECKING:
    from teamslam.team.keys.signing import Signer


class PeerCentre(Peer):
    """The centre's peer, which has no estimator and may join and leave at any time."""

    def __init__(
        self, central: CentralConfig, robots: Sequence[str], signer: "Signer | None" = None
    ) -> None:
        proofs = None if signer is None else Proofs("", signer)
        super().__init__(CENTRE, central, robots, proofs=proofs)

    def begin(self) -> list[Outgoing]:
        """Make the first messages: configuration and saved maps."""
        return [*self.fold.centre.begin(), *self._maps]

    def _from_fold(self, messages: Sequence[Outgoing]) -> list[Outgoing]:
        return [each for each in messages if each.channel is not ch.CENTRAL_PROGRESS]

    def status(self) -> m.Status:
        """Report a centre's status with the figures of the set."""
        own = self.fold.centre.status()
        faults = (*self.boundary.warnings, *self.fold.boundary.warnings)
        figures = {**own.figures, **self.set_figures()}
        return msgspec.structs.replace(own, figures=figures, warnings=(*own.warnings, *faults))


LINGER_S = 5.0  # time [s] for which a robot stays once all have concluded
FRESH_SHARE = 0.2  # share of the time for maps that are not due
WORLD_GONE_S = 1.0  # delay [s] after the world's end before a peer leaves, longer than a restart
_ENDS = (ch.CONCLUDED,)  # channels that end a team of peers
_ORDERS = m.KeptRequest(stamp_ns=0, channels=tuple(each.name for each in ch.ORDERS))
_LOG = logging.getLogger("teamslam")


class Lasting:
    """How long a condition has held."""

    def __init__(self) -> None:
        self._since: float | None = None

    def seconds(self, now: float, *, holds: bool) -> float:
        """Return the duration until now [s]; −1: the condition does not hold."""
        self._since = (now if self._since is None else self._since) if holds else None
        return -1.0 if self._since is None else now - self._since


def _is_abandoned(alone: Lasting, peer: Peer) -> bool:
    left = alone.seconds(time.monotonic(), holds=peer.is_left_alone) >= LINGER_S
    if left:
        _LOG.warning("the team has ended, and nobody is there who has the rest of the set")
    return left


def _make_shell(
    bus: Bus, peer: PeerRobot | PeerCentre, stop: threading.Event, stored: SetFile
) -> Shell:
    shell = Shell(bus, peer, peer.name, stop, _ENDS)
    shell.take_end = peer.take_end
    shell.refresh_by(peer.refresh, FRESH_SHARE)
    shell.notes = lambda: stored.warnings
    return shell


class PeerShell(RobotShell):
    """Process of a robot without a centre; store: file of its set."""

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
        signer: "Signer | None" = None,
        maps: Sequence[m.SavedMap] = (),
        patience_s: float = SECOND_PATIENCE_S,
    ) -> None:
        super().__init__(bus, config, stop, patience_s, exchange)
        self._peer = PeerRobot(config, central, robots, exchange, when, signer)
        self._peer.load_maps(maps)
        self.node = self._peer.node
        self._keeper = SetFile(store)
        self.run_in(_make_shell(bus, self._peer, stop, self._keeper))
        self._over, self._alone = Lasting(), Lasting()

    def run(self) -> None:
        """Run until no other peer needs this one."""
        try:
            super().run()
        finally:
            self._keeper.close()

    def _subscribe(self) -> None:
        everyones = self._peer.overhears
        for channel in self._peer.listens:
            if channel not in everyones:
                self.bus.subscribe(channel, self.node.robot)
        for channel in everyones:
            self.bus.subscribe(channel)
        self.bus.watch_alive()
        self.bus.request(ch.KEPT, "", _ORDERS)
        self.shell.answer(ch.MEMBERS, self._peer.name, self._peer.answer)
        self.shell.answer(ch.FOLD, self._peer.robot, self._peer.answer_fold)

    def _resume(self) -> bool:
        stored = self._keeper.members
        if not stored:
            return False
        goes_on = self._peer.restore(stored)
        self._peer.peer.unsaved.clear()
        self.node = self._peer.node
        maps = m.InitialPose | m.Submap | m.SightingFactor
        self._log([each for each in stored if isinstance(each.message, maps)])
        _LOG.info(
            "%d members of the set are kept, of this robot %d submaps",
            len(stored),
            self.node.submaps,
        )
        return goes_on

    @property
    def _final(self) -> m.FusedMap | None:
        return self._peer.final

    def _duty(self) -> None:
        self.look_for_gaps()
        now = time.monotonic()
        self.shell.publish(self._peer.tick(now))
        self._log_carried()
        self._keeper.append(self._peer.news_of_set())
        self._peer.finished = self._may_leave(now)

    def _log_carried(self) -> None:
        """Log forwarded members under their first publisher's key, for merging logs."""
        members, self._peer.carried = self._peer.carried, []
        self._log(members)

    def _log(self, members: Sequence[Member]) -> None:
        tap: Tap | None = getattr(self.bus, "tap", None)
        if tap is not None and members:
            now_ns = time.time_ns()
            tap([member.as_sample(now_ns) for member in members])

    def _may_leave(self, now: float) -> bool:
        if _is_abandoned(self._alone, self._peer):
            return True
        gone = self._peer.world_alive is False
        is_over = self._peer.final is not None and (self._peer.all_concluded or gone)
        return self._over.seconds(now, holds=is_over) >= (WORLD_GONE_S if gone else LINGER_S)


class CentreShell:
    """Process of a centre among peers. Raises BusError when the bus is lost."""

    def __init__(
        self,
        bus: Bus,
        config: CentralConfig,
        robots: Sequence[str],
        stop: threading.Event,
        *,
        store: Path | None = None,
        signer: "Signer | None" = None,
        maps: Sequence[m.SavedMap] = (),
    ) -> None:
        self._bus = bus
        self._peer = PeerCentre(config, robots, signer)
        self._peer.load_maps(maps)
        self._keeper = SetFile(store)
        self._shell = _make_shell(bus, self._peer, stop, self._keeper)
        self._alone = Lasting()

    def run(self) -> None:
        """Run until all peers have the same final map."""
        for channel in self._peer.overhears:
            self._bus.subscribe(channel)
        self._bus.watch_alive()
        self._shell.answer(ch.MEMBERS, CENTRE, self._peer.answer)
        self._peer.keep(self._keeper.members)
        self._peer.peer.unsaved.clear()
        if self._keeper.members:
            _LOG.info("%d members of the set are kept", len(self._keeper.members))
        try:
            self._shell.run(self._duty)
        finally:
            self._keeper.close()
        self._shell.wait_for_recorder(lambda: False)
        self._shell.end(self._peer.final)

    def _duty(self) -> None:
        self._shell.publish(self._peer.tick(time.monotonic()))
        self._keeper.append(self._peer.news_of_set())
        is_abandoned = _is_abandoned(self._alone, self._peer)
        self._peer.finished = self._peer.all_concluded or is_abandoned
