"""A robot that needs no centre: its estimator, its copy of the set, and its own fold of it.

The three nodes know nothing of each other. What the estimator sends for fusion goes into the set;
what the set has goes into the fold; the fold's prior goes back to the estimator for `team/pose`,
as a centre's would. Law 1 holds as ever: nothing of the fold reaches what the robot sends.
"""

from collections.abc import Iterable, Sequence

import msgspec

from central.config import CentralConfig
from central.peers.fold import FoldWhen, PeerFold
from team.config import Exchange, RobotConfig
from team.containment import Boundary, reply_sample
from team.peers.members import CHANNELS, Member, about
from team.peers.node import PeerNode
from team.peers.proofs import Proofs, Signs
from team.robot.node import RobotNode
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing, Sample
from team.wire.codec import encoded

_OF_THE_FOLD = {
    ch.FUSED_MAP: ch.TEAM_MAP,
    ch.PRIOR: ch.TEAM_PRIOR,
    ch.FINAL_MAP: ch.TEAM_FINAL,
    ch.TRAJECTORY: ch.TEAM_TRAJECTORY,
}
"""What the centre would say under its own name the robot says under its own."""
_TALK = (*CHANNELS, ch.SIGNATURE, ch.SET_SUMMARY, ch.CARRIED)
"""What the set costs a radio; questions for it, too."""
_NOT_HEARD = (ch.PRIOR, ch.FUSED_MAP, ch.FINAL_MAP, ch.CENTRAL_PROGRESS, ch.TEAM_END)
"""What a robot hears from a centre and a peer from its own fold."""


class PeerRobot:
    """One robot and its own centre: `begin`, then `handle_sample` and `tick`, until `finished`.

    finished: whether it may leave: by its shell's word. node: the estimator's.
    carried: members that others have brought, since somebody has last cleared it.
    uplink, downlink: bytes of the set's talk that were said, each once, and heard.
    world_alive: None while no world was heard of.
    """

    def __init__(
        self,
        config: RobotConfig,
        central: CentralConfig,
        robots: Sequence[str],
        exchange: Exchange = "continuous",
        when: FoldWhen = "always",
        signer: Signs | None = None,
    ) -> None:
        self.config = config
        self._exchange: Exchange = exchange
        self.robot = config.id
        self.name = ch.robot_node(config.id)
        self.node = RobotNode(config, exchange)
        proofs = None if signer is None else Proofs(config.id, signer)
        self.peer = PeerNode(self.name, robots, proofs)
        self.fold = PeerFold(central, tuple(sorted(robots)), self.peer, when)
        self._boundary = Boundary(self.name)
        self._finals = 0
        self.finished = False
        self.uplink = self.downlink = 0
        self.carried: list[Member] = []
        self.world_alive: bool | None = None

    @property
    def listens(self) -> tuple[ch.Channel, ...]:
        """The channels of its own stream, and of the world, to subscribe to under its name."""
        return tuple(channel for channel in RobotNode.listens if channel not in _NOT_HEARD)

    @property
    def overhears(self) -> tuple[ch.Channel, ...]:
        """The channels to subscribe to whoever they name: members, summaries, progress."""
        own = (each for each in self.node.overhears if each is not ch.WITHDRAWAL)
        signed = () if self.peer.proofs is None else (ch.SIGNATURE,)
        others = (ch.ROBOT_PROGRESS, ch.HEAD, ch.END_ORDER, *signed)
        return tuple(dict.fromkeys((*PeerNode.listens, *others, *own)))

    @property
    def final(self) -> m.FusedMap | None:
        """The newest final map of its own fold."""
        return self.fold.final

    @property
    def all_concluded(self) -> bool:
        """Whether every robot that is not given up has the final map that is here."""
        if self.final is None:
            return False
        lost = {*self.final.lost, *self.final.withdrawn}
        said = self.peer.replica.concluded
        return all(
            robot in lost or (robot in said and said[robot].digest == self.final.digest)
            for robot in self.peer.replica.robots
        )

    def begin(self) -> list[Outgoing]:
        """What it says first: its configuration, and that of its fold."""
        announced = msgspec.structs.replace(self.fold.centre.announcement, node=self.name)
        config = Outgoing(ch.TEAM_CONFIG, self.robot, announced)
        return [config, *self._certified(), *self._of_robot(self.node.begin())]

    def _certified(self) -> list[Outgoing]:
        """With keys: what its signatures are checked by."""
        proofs = self.peer.proofs
        if proofs is None:
            return []
        self.peer.take(_member(ch.CERTIFICATE, proofs.certificate()), self.name)
        return [Outgoing(ch.CERTIFICATE, self.robot, proofs.certificate())]

    def _vouched(self, member: Member) -> list[Outgoing]:
        """Take a member of its own into the set; with keys its signature goes out behind it."""
        self.peer.take(member, self.name)
        proofs = self.peer.proofs
        if proofs is None:
            return []
        return [Outgoing(ch.SIGNATURE, self.robot, proofs.signed(member))]

    def restore(self, members: Iterable[Member]) -> bool:
        """Take what an earlier life has kept, before `begin`; whether its stream goes on there."""
        for member in members:
            self.peer.take(member, self.name)
        kept = self._kept()
        if not kept:
            return False
        try:
            self.node.take_over(kept)
        except Exception:  # the same submaps once more, from the stream
            self.node = RobotNode(self.config, self._exchange)
            return False
        return True

    def _kept(self) -> list[m.Message]:
        """Of each incarnation of its own stream, the latest first: what `take_over` takes."""
        found: list[m.Message] = []
        own = (s for s in self.peer.replica.streams if s[0] == self.robot)
        for stream in sorted(own, reverse=True):
            share = self.peer.replica.share_of(stream)
            if share.start is not None and share.count:
                parcels = [share.parcel(k) for k in range(share.count)]
                found += [share.start.message, *(parcel[-1].message for parcel in parcels)]
                found += [each.message for parcel in parcels for each in parcel[:-1]]
        return found

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take a message without its key: as `handle_sample` of a reply."""
        return self.handle_sample(message, reply_sample(m.tag_of(type(message)), encoded(message)))

    def handle_sample(self, message: m.Message, sample: Sample) -> list[Outgoing]:
        """Take one message from its stream, a teammate, the world or an operator."""
        found = ch.channel_of(sample.key)
        channel, name = (None, "") if found is None else found
        if channel in _TALK and name not in (self.robot, self.name):
            self.downlink += len(sample.payload)
        heard = self._hear(message, sample)
        return self._take(message, sample, channel, name) if heard is None else heard

    def _hear(self, message: m.Message, sample: Sample) -> list[Outgoing] | None:
        """Take what others say of themselves; None: it is something else."""
        match message:
            case m.Members():
                self.carried += self.peer.take_carried(message)
                return self._grown() + self._said(self.peer.more_of(message.node))
            case m.Signature():
                if self.peer.proofs is not None:
                    self.peer.proofs.hear(message)
                return []
            case m.SetSummary():
                return self._said(self.peer.hear(message))
            case m.Progress():
                return self._of_fold(self.fold.note(message))
            case m.StreamHead() | m.TeamEnd():
                own = isinstance(message, m.StreamHead) and message.robot == self.robot
                said = self._tell_robot(message, sample) if own else []
                return said + self._of_fold(self.fold.note(message))
            case m.Liveliness() if message.node == ch.source_node(self.robot):
                return self._tell_robot(message, sample)
            case m.Liveliness(node="world"):
                self.world_alive = message.alive
                return []
            case m.Liveliness():
                if message.node.startswith("robot/") and message.alive:
                    self.peer.greet()
                return self._of_fold(self.fold.note(message))
            case m.End():
                return self._tell_robot(message, sample) + self._of_fold(self.fold.note(message))
            case _:
                return None

    def _take(
        self, message: m.Message, sample: Sample, channel: ch.Channel | None, name: str
    ) -> list[Outgoing]:
        """Take a member, a measurement, or what else an estimator hears."""
        out: list[Outgoing] = []
        if channel is not None and channel in CHANNELS:
            self.peer.take_sample(sample, channel.speaker(name))
            if isinstance(message, m.InitialPose) and name == self.robot:
                out += self._vouched(_member(ch.START, message))
            out += self._grown()
        elif isinstance(message, m.InitialPose) and message.robot == self.robot:
            # a reply of the source: it has no key
            out = self._vouched(_member(ch.START, message)) + self._grown()
        own = isinstance(message, m.Measurement) and message.robot == self.robot
        if own or isinstance(message, m.KnownMap | m.Rendezvous | m.Withdrawal):
            out = self._tell_robot(message, sample) + out
        return out

    def tick(self, now_s: float) -> list[Outgoing]:
        """What there is to say by now, by any clock that goes on."""
        return self._said(self.peer.tick(now_s))

    def _said(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """Count what goes out of the set's talk."""
        talk = (each.message for each in out if each.channel in _TALK or each.channel is ch.MEMBERS)
        self.uplink += sum(len(encoded(message)) for message in talk)
        return list(out)

    def _tell_robot(self, message: m.Message, sample: Sample) -> list[Outgoing]:
        return self._of_robot(self._said(self._boundary.hand(self.node, message, sample)))

    def _of_robot(self, said: Sequence[Outgoing]) -> list[Outgoing]:
        """What the estimator says goes out; what of it is for fusion goes into the set, too."""
        out = list(said)
        for each in said:
            if each.channel in CHANNELS:
                out += self._vouched(_member(each.channel, each.message))
            elif isinstance(each.message, m.Progress):
                out += self._of_fold(self.fold.note(each.message))
        return out + self._grown()

    def _grown(self) -> list[Outgoing]:
        return self._of_fold(self.fold.grow())

    def _of_fold(self, said: Sequence[Outgoing]) -> list[Outgoing]:
        """What the fold says, under this robot's name; the prior goes to the estimator first."""
        out: list[Outgoing] = []
        for each in said:
            channel = _OF_THE_FOLD.get(each.channel)
            if each.channel is ch.FAULT:
                out.append(each)
            elif each.channel is ch.TEAM_END:
                sample = Sample(each.key, encoded(each.message), each.message.stamp_ns, 0, -1)
                out += self._tell_robot(each.message, sample)
            elif channel is None or each.name not in ("", self.robot):
                continue
            else:
                if channel is ch.TEAM_PRIOR:
                    sample = Sample(each.key, encoded(each.message), each.message.stamp_ns, 0, -1)
                    out += self._of_robot(self._boundary.hand(self.node, each.message, sample))
                out.append(Outgoing(channel, self.robot, each.message))
        if self.fold.finals > self._finals:
            self._finals = self.fold.finals
            concluded = self.fold.conclusion(self.robot)
            assert concluded is not None
            out.append(Outgoing(ch.CONCLUDED, self.robot, concluded))
            out += self._vouched(_member(ch.CONCLUDED, concluded))
        return out

    def answer(self, request: bytes) -> list[bytes]:
        """The answer to a peer's `MembersRequest`."""
        answer = self.peer.answer(request)
        self.uplink += sum(len(batch) for batch in answer)
        self.downlink += len(request)
        return answer

    def status(self) -> m.Status:
        """The estimator's status with how much of the set is here, and what the fold finds."""
        own, fold = self.node.status(), self.fold.centre.status()
        replica = self.peer.replica
        figures = dict(own.figures)
        figures["set_submaps"] = float(replica.submaps)
        figures["set_refused"] = float(self.peer.refused)
        figures["set_uplink_bytes"] = float(self.uplink)
        figures["set_downlink_bytes"] = float(self.downlink)
        agreeing = self.peer.agrees
        figures["set_agrees"] = float(sum(agreeing.values()))
        for robot in replica.robots:
            have = replica.have(robot)
            figures[f"set_submaps.{robot}"] = float(have.submaps)
            figures[f"set_newest_s.{robot}"] = have.newest_ns * 1e-9
        for node, over in self.peer.carried.items():
            figures[f"set_over.{node}"] = float(over.members)
            figures[f"set_over_bytes.{node}"] = float(over.bytes)
        figures |= {f"fold.{name}": value for name, value in fold.figures.items()}
        faults = [*self._boundary.warnings, *self.fold.boundary.warnings]
        warnings = (*own.warnings, *fold.warnings, *faults)
        state = "done" if self.final is not None else own.state
        return msgspec.structs.replace(own, state=state, figures=figures, warnings=warnings)


def _member(channel: ch.Channel, message: m.Message) -> Member:
    return Member(channel.key(about(message)), encoded(message), message)
