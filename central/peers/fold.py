"""A peer's own fold: a centre's node that receives the peer's set.

The fold restarts when a folded member changes or the set grows after the final map.
"""

import hashlib
from typing import Literal

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode
from teamslam.team.containment import Boundary
from teamslam.team.door import MOST_COUNT
from teamslam.team.peers.node import PeerNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded

FoldWhen = Literal["always", "request", "end"]
"""Fold as the set grows; on request and once it is complete; or only then."""


class PeerFold:
    """Fold of the set of a `PeerNode`; final: the newest of `finals` final maps."""

    def __init__(
        self,
        config: CentralConfig,
        robots: tuple[str, ...],
        peer: PeerNode,
        when: FoldWhen = "always",
    ) -> None:
        self._robots = robots
        self._peer = peer
        self.boundary = Boundary(peer.node)
        self.centre = CentralNode(config, robots)
        self.restarts = 0
        self.final: m.FusedMap | None = None
        self.finals = 0
        self._when = when
        self._waits = when != "always"
        for robot in robots:  # a robot that was never in reach counts as lost
            for alive in (True, False):
                node = ch.robot_node(robot)
                self._give(m.Liveliness(stamp_ns=0, node=node, alive=alive))

    def note(self, message: m.Message) -> list[Outgoing]:
        """Process progress, liveliness or the end of the streams."""
        if isinstance(message, m.Liveliness) and ch.robot_of(message.node) not in self._robots:
            return []
        out: list[Outgoing] = []
        if isinstance(message, m.End | m.TeamEnd) and self._peer.rebuild:
            out += self._restart()  # the final map may follow
        return [*out, *self._give(message), *self.grow()]

    def _end_by_others(self) -> list[Outgoing]:
        """Infer the end of all streams from other peers' conclusions."""
        stated = self._peer.replica.statements
        gone = {("given_up", 0), ("withdrawal", 0)}
        here = [robot for robot in self._robots if not gone & stated[robot].keys()]
        if self.centre.attendance.world_end is not None or not here:
            return []
        if not set(here) <= self._peer.replica.concluded.keys():
            return []
        streams = []
        for robot in stated:
            statements = (each.message for each in stated[robot].values())
            last = [(d.incarnation, d.measurements) for d in statements if isinstance(d, m.Done)]
            if last:
                incarnation, count = max(last)
                streams.append(
                    m.StreamEnd(robot=robot, incarnation=incarnation, measurements=count)
                )
        return self._give(m.End(stamp_ns=0, streams=tuple(streams)))

    def grow(self) -> list[Outgoing]:
        """Fold the new members of the set."""
        if self._waits:
            if not self._whole:
                return []
            self._waits = False
        out = self._end_by_others()
        if self._peer.rebuild and (self.centre.finished or self._whole):
            return out + self._restart()
        for message in list(self._peer.new_messages()):
            if self.centre.finished and not isinstance(message, m.Concluded):
                return out + self._restart()
            out += self._give(message)
        if self._peer.rebuild and self.centre.finished:
            out += self._restart()
        return out

    def _restart(self) -> list[Outgoing]:
        self._peer.restart_fold()
        self.centre.restart()
        self.restarts += 1
        out: list[Outgoing] = []
        for message in list(self._peer.new_messages()):
            out += self._give(message)
        return out

    def ask(self) -> list[Outgoing]:
        """Fold the present set on request."""
        if self._when == "end" and self._waits:
            return []
        waits, self._waits = self._waits, False
        out = [*self._restart_if_changed(), *self.grow(), *self.centre.refresh()]
        self._waits = waits and self.final is None
        return out

    def refresh(self) -> list[Outgoing]:
        """Make a map of the whole set, if the last one lacks a member."""
        return [] if self._waits else [*self._restart_if_changed(), *self.centre.refresh()]

    def _restart_if_changed(self) -> list[Outgoing]:
        return self._restart() if self._peer.rebuild else []

    def _give(self, message: m.Message) -> list[Outgoing]:
        before = self.centre.finished
        out = self.boundary.hand(self.centre, message)
        if self.centre.finished and not before:
            self.final = self.centre.final
            self.finals += 1
        return out

    @property
    def _whole(self) -> bool:
        return any(all(map(self._has_stream, end.streams)) for end in self.centre.attendance.ends)

    def _has_stream(self, end: m.StreamEnd) -> bool:
        replica = self._peer.replica
        statements = replica.statements.get(end.robot, {})
        done = statements.get(("done", end.incarnation))
        if done is None or not isinstance(done.message, m.Done):
            return ("given_up", 0) in statements
        return replica.share_of((end.robot, end.incarnation)).count >= done.message.submaps

    def conclusion(self, robot: str) -> m.Concluded | None:
        """Make the `Concluded` message for this peer's final map."""
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
