"""A robot that needs no centre: estimator, copy of the set, and fold.

Law 1: the fold's prior reaches `team/pose`, and nothing of it the robot's messages for fusion.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.peers.fold import FoldWhen
from teamslam.central.peers.peer import Peer, member_in
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.peers.members import CHANNELS, Member
from teamslam.team.peers.proofs import Proofs, signed_by
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.codec import encoded

if TYPE_CHECKING:
    from teamslam.team.keys.signing import Signer

_OF_THE_FOLD = {
    ch.FUSED_MAP: ch.TEAM_MAP,
    ch.PRIOR: ch.TEAM_PRIOR,
    ch.FINAL_MAP: ch.TEAM_FINAL,
    ch.TRAJECTORY: ch.TEAM_TRAJECTORY,
}
"""Channels of the own fold's messages, in place of a centre's."""
_OF_A_CENTRE = (ch.PRIOR, ch.FUSED_MAP, ch.FINAL_MAP, ch.CENTRAL_PROGRESS, ch.TEAM_END)
"""Channels of a centre's messages, or of a peer's own fold."""


class PeerRobot(Peer):
    """One robot and its own centre."""

    def __init__(
        self,
        config: RobotConfig,
        central: CentralConfig,
        robots: Sequence[str],
        exchange: Exchange = "continuous",
        when: FoldWhen = "always",
        signer: "Signer | None" = None,
    ) -> None:
        proofs = None if signer is None else Proofs(config.id, signer)
        super().__init__(ch.robot_node(config.id), central, robots, when, proofs)
        self.config = config
        self._exchange: Exchange = exchange
        self.robot = config.id
        self.node = RobotNode(config, exchange)
        self._finals = 0

    @property
    def listens(self) -> tuple[ch.Channel, ...]:
        """Channels of its own stream and of the world."""
        return tuple(channel for channel in RobotNode.listens if channel not in _OF_A_CENTRE)

    @property
    def overhears(self) -> tuple[ch.Channel, ...]:
        """Channels to subscribe to under every name."""
        return tuple(dict.fromkeys((*super().overhears, *self.node.overhears)))

    def begin(self) -> list[Outgoing]:
        """Make the first messages: configurations and saved maps."""
        announced = msgspec.structs.replace(self.fold.centre.announcement, node=self.name)
        config = Outgoing(ch.TEAM_CONFIG, self.robot, announced)
        return [config, *self._maps, *self._certified(), *self._from_estimator(self.node.begin())]

    def _certified(self) -> list[Outgoing]:
        proofs = self.peer.proofs
        if proofs is None:
            return []
        certificate = Outgoing(ch.CERTIFICATE, self.robot, proofs.certificate())
        own = (
            member
            for member in self.peer.replica.members()
            if signed_by(member) == self.robot and not isinstance(member.message, m.Certificate)
        )
        signatures = [Outgoing(ch.SIGNATURE, self.robot, proofs.sign(each)) for each in own]
        self.peer.take(member_in(certificate), self.name)
        return [certificate, *signatures]

    def _vouched(self, outgoing: Outgoing) -> list[Outgoing]:
        member = member_in(outgoing)
        self.peer.take(member, self.name)
        proofs = self.peer.proofs
        if proofs is None:
            return []
        return [Outgoing(ch.SIGNATURE, self.robot, proofs.sign(member))]

    def restore(self, members: Iterable[Member]) -> bool:
        """Restore the stored set, before `begin`; return whether the own stream continues."""
        self.keep(members)
        stored = self._own_stored()
        if not stored:
            return False
        try:
            self.node.take_over(stored)
        except Exception:  # submaps are estimated again from the stream
            self.node = RobotNode(self.config, self._exchange)
            return False
        return True

    def _own_stored(self) -> list[m.Message]:
        found: list[m.Message] = []
        own = (s for s in self.peer.replica.streams if s[0] == self.robot)
        for stream in sorted(own, reverse=True):
            share = self.peer.replica.share_of(stream)
            if share.start is not None and share.count:
                parcels = [share.parcel(k) for k in range(share.count)]
                found += [share.start.message, *(parcel[-1].message for parcel in parcels)]
                found += [each.message for parcel in parcels for each in parcel[:-1]]
        return found

    def _take_team_message(self, message: m.Message, sample: Sample) -> list[Outgoing] | None:
        own_head = isinstance(message, m.StreamHead) and message.robot == self.robot
        if own_head or isinstance(message, m.End):
            return self._to_estimator(message, sample) + self._from_fold(self.fold.note(message))
        if isinstance(message, m.Liveliness) and message.node == ch.source_node(self.robot):
            return self._to_estimator(message, sample)
        return super()._take_team_message(message, sample)

    def _take(
        self, message: m.Message, sample: Sample, channel: ch.Channel | None, name: str
    ) -> list[Outgoing]:
        out: list[Outgoing] = []
        if channel is not None and channel in CHANNELS:
            self.peer.take_sample(sample, channel.publisher(name))
            if isinstance(message, m.InitialPose) and name == self.robot:
                out += self._vouched(Outgoing(ch.START, name, message))
            out += self.grown()
        own = isinstance(message, m.Measurement) and message.robot == self.robot
        if own or isinstance(message, m.Rendezvous):
            out = self._to_estimator(message, sample) + out
        return out

    def _to_estimator(self, message: m.Message, sample: Sample) -> list[Outgoing]:
        return self._from_estimator(self.counted(self.boundary.hand(self.node, message, sample)))

    def _from_estimator(self, messages: Sequence[Outgoing]) -> list[Outgoing]:
        out = list(messages)
        for each in messages:
            if each.channel in CHANNELS:
                out += self._vouched(each)
            elif isinstance(each.message, m.Progress):
                out += self._from_fold(self.fold.note(each.message))
        return out + self.grown()

    def _from_fold(self, messages: Sequence[Outgoing]) -> list[Outgoing]:
        """Rename the fold's messages; hand the prior to the estimator first."""
        out: list[Outgoing] = []
        for each in messages:
            channel, message = _OF_THE_FOLD.get(each.channel), each.message
            if each.channel is ch.FAULT:
                out.append(each)
            elif each.channel is ch.TEAM_END:
                out += self._to_estimator(message, _sample_of(each))
            elif isinstance(message, m.Withdrawal) and message.by == "central":
                own = msgspec.structs.replace(message, by=f"the fold of {self.robot}")
                out.append(Outgoing(ch.TEAM_WITHDRAWAL, self.robot, own))
            elif channel is not None and each.name in ("", self.robot):
                if channel is ch.TEAM_PRIOR:
                    handled = self.boundary.hand(self.node, message, _sample_of(each))
                    out += self._from_estimator(handled)
                out.append(Outgoing(channel, self.robot, message))
        if self.fold.finals > self._finals:
            self._finals = self.fold.finals
            concluded = self.fold.conclusion(self.robot)
            assert concluded is not None
            statement = Outgoing(ch.CONCLUDED, self.robot, concluded)
            out += [statement, *self._vouched(statement)]
        return out

    def status(self) -> m.Status:
        """Report the estimator's status, with figures of set and fold."""
        own, fold = self.node.status(), self.fold.centre.status()
        figures = {f"fold.{name}": value for name, value in fold.figures.items()}
        faults = [*self.boundary.warnings, *self.fold.boundary.warnings]
        warnings = (*own.warnings, *fold.warnings, *faults)
        state = "done" if self.final is not None else own.state
        figures = {**own.figures, **self.set_figures(), **figures}
        return msgspec.structs.replace(own, state=state, figures=figures, warnings=warnings)


def _sample_of(out: Outgoing) -> Sample:
    return Sample(out.key, encoded(out.message), out.message.stamp_ns, 0, -1)
