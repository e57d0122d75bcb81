"""The central process: the node's shell, which delays the loss of a robot."""

import logging
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from teamslam.central.config import CentralConfig
from teamslam.central.node import make_centre
from teamslam.team.peers.members import CHANNELS, Member, member_of
from teamslam.team.peers.set_file import SetFile
from teamslam.team.shell import WAIT_S, MissingMeasurements, Shell, select_due
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import ids
from teamslam.team.wire.bus import Bus, Sample, opened
from teamslam.team.wire.codec import WireError, encoded
from teamslam.team.wire.intervals import RequestTimes

_STORED = tuple(each for each in CHANNELS if each not in (ch.CONCLUDED, ch.CERTIFICATE))


class StoredSet(SetFile):
    """A centre's set on disk, from which a restarted centre continues."""

    def __init__(self, path: Path | None) -> None:
        super().__init__(path)
        self._known = {member.hash for member in self.members}

    def note(self, samples: Iterable[Sample]) -> None:
        """Store the valid and new members among these samples."""
        news: dict[bytes, Member] = {}
        for sample in samples if self.path else ():
            found = ch.channel_of(sample.key)
            if found is not None and found[0] in _STORED:
                with suppress(WireError, ValueError):  # the door counts and names it
                    member = member_of(sample.key, sample.payload)
                    news[member.hash] = member
        self.append([member for hash_, member in news.items() if hash_ not in self._known])
        self._known.update(news)


LOST_S = 3.0
"""Time [s] after which a lost robot delays no broadcast; the final map still waits for it."""
FRESH_SHARE = 1.0 / 3.0
"""Share of the time for maps that are not due: a due map waits for at most two solutions."""
FAREWELL_S = 10.0
"""Longest delay [s] of the centre's exit after its final map: it leaves after the others."""
ORDERS_S = 30.0  # time [s] between two queries to the router for an operator's orders
_ORDERS = m.KeptRequest(
    stamp_ns=0, channels=tuple(each.name for each in ch.ORDERS if each is not ch.ORDER_SIGNATURE)
)
_LOG = logging.getLogger("teamslam")


class CentralShell:
    """The centre's process; patience_s: a robot lost for this long is given up; None: only by an
    order.
    """

    def __init__(
        self,
        bus: Bus,
        config: CentralConfig,
        robots: Sequence[str],
        stop: threading.Event,
        patience_s: float | None = None,
        *,
        admit: bool = False,
        store: Path | None = None,
        maps: Sequence[m.SavedMap] = (),
    ) -> None:
        self._bus = bus
        self._stored = StoredSet(store)
        self.node = make_centre(config, robots, admit=admit, maps=maps)
        self._shell = Shell(bus, self.node, "central", stop)
        self._patience_s = patience_s
        self._shell.notes = self._awaited
        self._shell.believed = self._store_and_filter
        self._shell.refresh_by(self.node.refresh, FRESH_SHARE)
        self._lost: dict[str, Sample] = {}  # tokens of lost robots that the node has not received
        self._since: dict[str, float] = {}
        self._alive: set[str] = set()
        self._stop = stop
        self._missing = MissingMeasurements(self._shell)
        self._request_times: RequestTimes[tuple[str, int]] = RequestTimes()
        self._greeted: set[str] = set()
        self._orders_due = 0.0

    def run(self) -> None:
        """Run until the final map, and leave last."""
        for channel in self.node.listens:
            self._bus.subscribe(channel)
        self._bus.watch_alive()
        self._shell.answer(ch.SUBMAPS, "", self.node.answer_submaps)
        if self.node.config.fusion == "join":
            self._shell.answer(ch.SITE, "", self.node.answer_site)
        self._request_orders()
        self._shell.query_end()
        self._restore()
        self._shell.run(self._duty)
        self._stored.close()
        final = self.node.final
        if final is None:
            _LOG.info("ended without a final map")
        else:
            digest = final.digest.hex()
            _LOG.info("final map of %d landmarks, set %s", len(ids(final.ids, "ids")), digest)
        self._leave_last()
        self._shell.wait_for_recorder(lambda: False)
        self._shell.end(final)

    def _restore(self) -> None:
        members, self._stored.members = self._stored.members, []
        if members and self._shell.going:
            now_ns = time.time_ns()
            self._shell.take(each.as_sample(now_ns) for each in members)
            _LOG.info("%d members of the set are stored in %s", len(members), self._stored.path)

    def _store_and_filter(self, samples: Sequence[Sample]) -> list[Sample]:
        self._stored.note(samples)
        return self._patient(samples)

    def _duty(self) -> None:
        self._shell.take(self._long_lost())
        self._give_up()
        self._request_orders()
        self._shell.contain("requests", lambda: self._missing.look(self.node.requests()))
        self._shell.contain("requests", self._gather)

    def _patient(self, samples: Sequence[Sample]) -> list[Sample]:
        """Drop the tokens of lost robots that may return within LOST_S."""
        now = time.monotonic()
        passed = []
        for sample in samples:
            if sample.key.endswith("/alive"):
                try:
                    _, node, message = opened(sample)
                except WireError:
                    passed.append(sample)  # the door counts it
                    continue
                assert isinstance(message, m.Liveliness)
                (self._alive.add if message.alive else self._alive.discard)(node)
                self._lost.pop(node, None)
                self._since.pop(node, None)
                left = node.startswith("robot/") and not message.alive
                if left and not self.node.finished:
                    _LOG.warning("%s is lost", node)
                    self._lost[node] = sample
                    self._since[node] = now
                    continue
            passed.append(sample)
        return passed

    def _long_lost(self) -> list[Sample]:
        return [self._lost.pop(node) for node in self._away(LOST_S) if node in self._lost]

    def _away(self, for_s: float) -> list[str]:
        now = time.monotonic()
        return [node for node, since in self._since.items() if now - since >= for_s]

    def _give_up(self) -> None:
        for node in [] if self._patience_s is None else self._away(self._patience_s):
            del self._since[node]
            why = f"lost for {self._patience_s:g} s, the centre's --patience"
            _LOG.warning("%s is given up: %s", node, why)
            order = m.GivenUp(stamp_ns=0, node=node, by="central", reason=why)
            key = ch.GIVEN_UP.key(node)
            self._shell.take([Sample(key, encoded(order), 0, time.time_ns(), 0)])

    def _awaited(self) -> tuple[str, ...]:
        now = time.monotonic()
        warnings = [*self._stored.warnings]
        for robot in self.node.awaited:
            since = self._since.get(ch.robot_node(robot))
            if since is None and self.node.ends:
                state = "is not there, and the final map waits for it"
            elif since is not None and now - since >= LOST_S:
                state = f"is lost for {now - since:.0f} s"
            else:
                continue
            warnings.append(
                f"{robot} {state}: start it again, or go on without it by `teamslam withdraw` "
                f"or `teamslam end --without {robot}`"
            )
        return tuple(warnings)

    def _request_orders(self) -> None:
        """Query the router for operators' orders that this process may have missed."""
        now = time.monotonic()
        if now >= self._orders_due:
            self._orders_due = now + ORDERS_S
            self._bus.request(ch.KEPT, "", _ORDERS)

    def _gather(self) -> None:
        """Request submaps that the centre lacks; of robots that appear, all of them."""
        robots = {n.removeprefix("robot/") for n in self._alive if n.startswith("robot/")}
        for robot in sorted(robots.intersection(self.node.robots) - self._greeted):
            self._bus.request(ch.SENT, robot, m.SubmapsRequest(stamp_ns=0, robot=robot))
        self._greeted |= robots.intersection(self.node.robots)
        for each in select_due(self.node.lacking(), self._request_times):
            _LOG.warning("submaps of %s from %d on are missing: asked for", each.robot, each.first)
            self._bus.request(ch.SENT, each.robot, each)

    def _leave_last(self) -> None:
        """Wait until all have left, to answer requests for the final map."""
        deadline = time.monotonic() + FAREWELL_S
        while not self._stop.is_set() and time.monotonic() < deadline:
            self._shell.note(self._patient(self._bus.receive(WAIT_S)))
            if not any(n.startswith(("world", "robot/", "source/")) for n in self._alive):
                return
