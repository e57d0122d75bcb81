"""What a robot without a centre and a centre among peers have in common: the set and its fold.

A peer takes members from wherever they come, hands what is news to its own fold, and says what the
fold says under its own name. What it does besides (an estimator, say) is its subclass's.
"""

from collections.abc import Iterable, Sequence

from central.config import CentralConfig
from central.peers.fold import FoldWhen, PeerFold
from team.containment import Boundary, reply_sample
from team.peers.members import CHANNELS, Member, about
from team.peers.node import PeerNode
from team.peers.proofs import OPERATOR, Proofs
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing, Sample
from team.wire.codec import decoded, encoded

TALK = (*CHANNELS, ch.SIGNATURE, ch.ORDER_SIGNATURE, ch.SET_SUMMARY, ch.CARRIED)
"""What the set costs a radio; questions for it, too."""
CENTRE = "central"
"""The node name of a centre."""


class Peer:
    """Keeps the team's set as the node `name` and folds it.

    finished: whether it may leave: by its shell's word. carried: members that others have brought,
    since somebody has last cleared it. uplink, downlink: bytes of the set's talk that were said,
    each once, and heard. world_alive: None while no world was heard of. ended: whether somebody has
    had a final map. others: the robots and the centre that are there, but for this node. unsaid: of
    a fold that was asked for; newest: the last map that was.
    """

    def __init__(
        self,
        name: str,
        central: CentralConfig,
        robots: Sequence[str],
        when: FoldWhen = "always",
        proofs: Proofs | None = None,
    ) -> None:
        self.name = name
        self.peer = PeerNode(name, robots, proofs)
        self.fold = PeerFold(central, tuple(sorted(robots)), self.peer, when)
        self.boundary = Boundary(name)
        self.finished = False
        self.uplink = self.downlink = 0
        self.carried: list[Member] = []
        self.world_alive: bool | None = None
        self.ended = False
        self.others: set[str] = set()
        self.unsaid: list[Outgoing] = []
        self.newest: m.FusedMap | None = None

    @property
    def overhears(self) -> tuple[ch.Channel, ...]:
        """The channels to subscribe to whoever they name: members, summaries, progress."""
        signed = () if self.peer.proofs is None else (ch.SIGNATURE, ch.ORDER_SIGNATURE)
        others = (ch.ROBOT_PROGRESS, ch.HEAD, ch.END, ch.END_ORDER, *signed)
        return tuple(dict.fromkeys((*PeerNode.listens, *others)))

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
        concluded = self.peer.replica.concluded
        return all(
            robot in lost or (robot in concluded and concluded[robot].digest == self.final.digest)
            for robot in self.peer.replica.robots
        )

    def keep(self, members: Iterable[Member]) -> None:
        """Take what an earlier life has kept."""
        for member in members:
            self.peer.take(member, self.name)

    def news_of_set(self) -> list[Member]:
        """The members that are new since this was asked last."""
        members, self.peer.unsaved = self.peer.unsaved, []
        return members

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take a message without its key: as `handle_sample` of a reply."""
        return self.handle_sample(message, reply_sample(m.tag_of(type(message)), encoded(message)))

    def handle_sample(self, message: m.Message, sample: Sample) -> list[Outgoing]:
        """Take one message of a robot, a peer, the world or an operator."""
        found = ch.channel_of(sample.key)
        channel, name = (None, "") if found is None else found
        if channel in TALK and channel.publisher(name) != self.name:
            self.downlink += len(sample.payload)
        answered = self._hear(message, sample)
        return self._take(message, sample, channel, name) if answered is None else answered

    def _hear(self, message: m.Message, sample: Sample) -> list[Outgoing] | None:
        """Take what others say of themselves; None: it is something else."""
        match message:
            case m.Members():
                self.carried += self.peer.take_carried(message)
                return self.grown() + self.counted(self.peer.more_of(message.node))
            case m.Signature():
                found = ch.channel_of(sample.key)
                if self.peer.proofs is not None and found is not None:
                    channel, name = found
                    publisher = OPERATOR if channel is ch.ORDER_SIGNATURE else name
                    self.peer.proofs.hear(message, publisher)
                return []
            case m.SetSummary():
                return self.counted(self.peer.hear(message))
            case m.Progress() | m.StreamHead() | m.TeamEnd() | m.End():
                return self._of_fold(self.fold.note(message))
            case m.Liveliness(node="world"):
                self.world_alive = message.alive
                return []
            case m.FusedMap():
                self.ended = self.ended or message.final
                return []
            case m.Liveliness():
                self._meet(message)
                return self._of_fold(self.fold.note(message))
            case _:
                return None

    def _meet(self, token: m.Liveliness) -> None:
        """Somebody comes, who may lack something, or goes."""
        if token.node == self.name or not (token.node.startswith("robot/") or token.node == CENTRE):
            return
        (self.others.add if token.alive else self.others.discard)(token.node)
        if token.alive:
            self.peer.greet()

    @property
    def is_left_alone(self) -> bool:
        """The team has ended, and nobody is there who has what is missing here."""
        return self.ended and self.final is None and not self.others

    def _take(
        self, message: m.Message, sample: Sample, channel: ch.Channel | None, name: str
    ) -> list[Outgoing]:
        """Take a member."""
        if channel is None or channel not in CHANNELS:
            return []
        self.peer.take_sample(sample, channel.publisher(name))
        return self.grown()

    def tick(self, now_s: float) -> list[Outgoing]:
        """What there is to say by now, by any clock that goes on."""
        unsaid, self.unsaid = self.unsaid, []
        return [*unsaid, *self.counted(self.peer.tick(now_s))]

    def counted(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """Count what goes out of the set's talk."""
        talk = (each.message for each in out if each.channel in TALK or each.channel is ch.MEMBERS)
        self.uplink += sum(len(encoded(message)) for message in talk)
        return list(out)

    def grown(self) -> list[Outgoing]:
        """Fold what the set has more; what the fold says."""
        return self._of_fold(self.fold.grow())

    def _of_fold(self, messages: Sequence[Outgoing]) -> list[Outgoing]:
        """What the fold says, as this node says it."""
        return list(messages)

    def refresh(self) -> list[Outgoing]:
        """What there is to say of what has come since the last map; for when there is time."""
        return self._of_fold(self.fold.refresh())

    def answer(self, request: bytes) -> list[bytes]:
        """The answer to a peer's `MembersRequest`."""
        answer = self.peer.answer(request)
        self.uplink += sum(len(batch) for batch in answer)
        self.downlink += len(request)
        return answer

    def answer_fold(self, request: bytes) -> list[bytes]:
        """The answer to a `FoldRequest`: the newest map, once all that is here has been folded."""
        decoded(request, m.FoldRequest)
        self.unsaid += self._of_fold(self.fold.ask())
        maps = [each.message for each in self.unsaid if isinstance(each.message, m.FusedMap)]
        self.newest = maps[-1] if maps else self.newest
        return [] if self.newest is None else [encoded(self.newest)]

    def set_figures(self) -> dict[str, float]:
        """How much of the set is here, how new, over whom it came, and who has the same."""
        replica = self.peer.replica
        figures = {
            "set_submaps": float(replica.submaps),
            "set_refused": float(self.peer.refused),
            "set_uplink_bytes": float(self.uplink),
            "set_downlink_bytes": float(self.downlink),
            "set_agrees": float(sum(self.peer.agrees.values())),
        }
        for robot in replica.robots:
            have = replica.have(robot)
            figures[f"set_submaps.{robot}"] = float(have.submaps)
            figures[f"set_newest_s.{robot}"] = have.newest_ns * 1e-9
        for node, over in self.peer.carried.items():
            figures[f"set_over.{node}"] = float(over.members)
            figures[f"set_over_bytes.{node}"] = float(over.bytes)
        return figures


def member_in(out: Outgoing) -> Member:
    """What a node says, as a member of the set."""
    return Member(out.channel.key(about(out.message)), encoded(out.message), out.message)
