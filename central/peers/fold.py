"""A peer's own fold: a centre's node that receives the peer's set instead of the network's
messages.

So its maps are the centre's, byte for byte, wherever the set is the same. The fold begins anew
where a folded member changes (a robot has contradicted itself), or where the set grows after the
final map. For a changed member it does so when there is time, or once the set is complete, so that
a robot that contradicts itself again and again does not keep its peers from their own work.
"""

import hashlib
from collections.abc import Callable
from typing import Literal

from central.config import CentralConfig
from central.node import CentralNode
from central.robot_attendance import note
from team.containment import Boundary
from team.door import MOST_COUNT
from team.peers.node import PeerNode
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import encoded
from team.wire.newer import further, later_end, later_head

FoldWhen = Literal["always", "request", "end"]
"""When a peer folds: as the set grows; on request and once the set is complete; or only then."""


class PeerFold:
    """Folds the set of a `PeerNode`.

    centre: the node that folds; it is made anew where the fold begins anew. final: the newest final
    map; finals: number of final maps.
    """

    def __init__(
        self,
        config: CentralConfig,
        robots: tuple[str, ...],
        peer: PeerNode,
        when: FoldWhen = "always",
        make: Callable[[CentralConfig, tuple[str, ...]], CentralNode] = CentralNode,
    ) -> None:
        self._make, self._config, self._robots = make, config, robots
        self._peer = peer
        self.boundary = Boundary(peer.node)
        self._end: m.End | None = None
        self._ends: list[m.End] = []
        self._progress: dict[str, m.Progress] = {}
        self._alive: dict[str, bool] = {}
        self._heads: dict[str, m.StreamHead] = {}
        self._ordered: m.TeamEnd | None = None
        self.final: m.FusedMap | None = None
        self.finals = 0
        self._when = when
        self._waits = when != "always"
        self._begin()

    def _begin(self) -> None:
        self.centre = self._make(self._config, self._robots)
        for robot in self._robots:  # a robot that was never in reach counts as lost
            for alive in (True, self._alive.get(robot, False)):
                node = ch.robot_node(robot)
                self._give(m.Liveliness(stamp_ns=0, node=node, alive=alive))
        ends = (self._end, *self._ends, self._ordered)
        known = (*self._heads.values(), *(e for e in ends if e is not None))
        for message in (*known, *self._progress.values()):
            self._give(message)

    def note(self, message: m.Message) -> list[Outgoing]:
        """Take a message that is no member: progress, liveliness, the end of the streams."""
        refused = self.centre.refusal(message)
        if refused is None and not self._stored(message):
            return []
        if isinstance(message, m.End):
            note(message, self._ends)  # the robots' `Done` messages may confirm it
        out: list[Outgoing] = []
        if isinstance(message, m.End | m.TeamEnd) and self._peer.rebuild:
            out += self._again()  # the final map may follow
        return [*out, *self._give(message), *self.grow()]

    def _stored(self, message: m.Message) -> bool:
        """Store a message for a fold that begins anew, unless it has a later one; returns whether
        the message was of use.
        """
        match message:
            case m.End():
                self._end = later_end(message, self._end)
            case m.StreamHead():
                self._heads[message.robot] = later_head(message, self._heads.get(message.robot))
            case m.TeamEnd():
                self._ordered = message
            case m.Progress():
                known = self._progress.get(message.robot)
                self._progress[message.robot] = further(message, known)
            case m.Liveliness():
                robot = ch.robot_of(message.node)
                if robot not in self._robots:
                    return False
                self._alive[robot] = message.alive
            case _:
                return False
        return True

    def _end_by_others(self) -> list[Outgoing]:
        """Infer from other peers' conclusions that all streams have ended, where the message was
        missed.
        """
        stated = self._peer.replica.statements
        here = [r for r in stated if not {("given_up", 0), ("withdrawal", 0)} & stated[r].keys()]
        if self._end is not None or not here:
            return []
        if not set(here) <= self._peer.replica.concluded.keys():
            return []
        streams = []
        for robot in stated:
            statements = (each.message for each in stated[robot].values())
            last = [(d.incarnation, d.measurements) for d in statements if isinstance(d, m.Done)]
            if last:
                incarnation, count = max(last)
                end = m.StreamEnd(robot=robot, incarnation=incarnation, measurements=count)
                streams.append(end)
        self._end = m.End(stamp_ns=0, streams=tuple(streams))
        return self._give(self._end)

    def grow(self) -> list[Outgoing]:
        """Fold the new members of the set; returns the messages to publish."""
        if self._waits:
            if not self._whole:
                return []
            self._waits = False
        out = self._end_by_others()
        if self._peer.rebuild and (self.centre.finished or self._whole):
            return out + self._again()
        for message in list(self._peer.new_messages()):
            if self.centre.finished and not isinstance(message, m.Concluded):
                return out + self._again()
            out += self._give(message)
        if self._peer.rebuild and self.centre.finished:
            out += self._again()
        return out

    def _again(self) -> list[Outgoing]:
        """Fold the whole set from the beginning: as `Done` is given last, all of it is in the final
        map.
        """
        self._peer.again()
        self._begin()
        out: list[Outgoing] = []
        for message in list(self._peer.new_messages()):
            out += self._give(message)
        return out

    def ask(self) -> list[Outgoing]:
        """Fold what is here now, without waiting; returns the messages to publish."""
        if self._when == "end" and self._waits:
            return []
        waits, self._waits = self._waits, False
        out = [*self._renewed(), *self.grow(), *self.centre.refresh()]
        self._waits = waits and self.final is None
        return out

    def refresh(self) -> list[Outgoing]:
        """A map of everything that is here, if the last one lacks something."""
        return [] if self._waits else [*self._renewed(), *self.centre.refresh()]

    def _renewed(self) -> list[Outgoing]:
        """Begin the fold anew if a folded member has changed."""
        return self._again() if self._peer.rebuild else []

    def _give(self, message: m.Message) -> list[Outgoing]:
        before = self.centre.finished
        out = self.boundary.give(self.centre, message)
        if self.centre.finished and not before:
            self.final = self.centre.final
            self.finals += 1
        return out

    @property
    def _whole(self) -> bool:
        """Whether everything that any node has announced is here."""
        return any(self._is_here(end) for end in (self._end, *self._ends) if end is not None)

    def _is_here(self, end: m.End) -> bool:
        replica = self._peer.replica
        for each in end.streams:
            done = replica.statements.get(each.robot, {}).get(("done", each.incarnation))
            gone = ("given_up", 0) in replica.statements.get(each.robot, {})
            if done is None or not isinstance(done.message, m.Done):
                if not gone:
                    return False
                continue
            if replica.share_of((each.robot, each.incarnation)).count < done.message.submaps:
                return False
        return True

    def conclusion(self, robot: str) -> m.Concluded | None:
        """The `Concluded` message of a robot's peer about its final map."""
        final = self.final
        if final is None:
            return None
        before = self._peer.replica.concluded.get(robot)
        return m.Concluded(
            stamp_ns=final.stamp_ns,
            robot=robot,
            serial=1 if before is None else min(before.serial + 1, MOST_COUNT),
            digest=final.digest,
            sha256=hashlib.sha256(encoded(final)).digest(),
            submaps=self._peer.replica.submaps,
        )
