"""Set and fold of a peer."""

from collections.abc import Iterable, Sequence

from teamslam.central.config import CentralConfig
from teamslam.central.peers.fold import FoldWhen, PeerFold
from teamslam.team.containment import Boundary, sample_of
from teamslam.team.peers.members import CHANNELS, Member, about
from teamslam.team.peers.node import PeerNode
from teamslam.team.peers.proofs import OPERATOR, Proofs
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample, open_valid
from teamslam.team.wire.codec import decoded, encoded

SET_CHANNELS = (*CHANNELS, ch.SIGNATURE, ch.ORDER_SIGNATURE, ch.SET_SUMMARY, ch.CARRIED)
"""Channels of the set's traffic figures."""
CENTRE = "central"  # the node name of a centre


class Peer:
    """The team's set at the node `name`, and its fold.

    carried: forwarded members until they are logged. ended: robots whose end the router stores.
    others: present robots and centre. unpublished: messages of a requested fold.
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
        self.ended: set[str] = set()
        self.others: set[str] = set()
        self.unpublished: list[Outgoing] = []
        self.newest: m.FusedMap | None = None
        self._maps: list[Outgoing] = []

    @property
    def overhears(self) -> tuple[ch.Channel, ...]:
        """Channels to subscribe to under every name."""
        signed = () if self.peer.proofs is None else (ch.SIGNATURE, ch.ORDER_SIGNATURE)
        others = (ch.ROBOT_PROGRESS, ch.HEAD, ch.END, ch.END_ORDER, *signed)
        return tuple(dict.fromkeys((*PeerNode.listens, *others)))

    @property
    def final(self) -> m.FusedMap | None:
        """Newest final map of its own fold."""
        return self.fold.final

    @property
    def all_concluded(self) -> bool:
        """Whether every robot that is not given up has this final map."""
        if self.final is None:
            return False
        lost = {*self.final.lost, *self.final.withdrawn}
        concluded = self.peer.replica.concluded
        return all(
            robot in lost or (robot in concluded and concluded[robot].digest == self.final.digest)
            for robot in self.peer.replica.robots
        )

    def load_maps(self, maps: Sequence[m.SavedMap]) -> None:
        """Add saved maps to the set, before `begin`."""
        self._maps = [Outgoing(ch.SAVED_MAP, saved.author, saved) for saved in maps]
        for each in self._maps:
            self.peer.take(member_in(each), self.name)

    def keep(self, members: Iterable[Member]) -> None:
        """Restore the stored set of an earlier process."""
        for member in members:
            self.peer.take(member, self.name)

    def news_of_set(self) -> list[Member]:
        """Remove and return the members that are not stored yet."""
        members, self.peer.unsaved = self.peer.unsaved, []
        return members

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Process a message without a key."""
        return self.handle_sample(message, sample_of(message))

    def handle_sample(self, message: m.Message, sample: Sample) -> list[Outgoing]:
        """Process a message of a robot, a peer, the world or an operator."""
        found = ch.channel_of(sample.key)
        channel, name = (None, "") if found is None else found
        if channel in SET_CHANNELS and channel.publisher(name) != self.name:
            self.downlink += len(sample.payload)
        answered = self._take_team_message(message, sample)
        return self._take(message, sample, channel, name) if answered is None else answered

    def _take_team_message(self, message: m.Message, sample: Sample) -> list[Outgoing] | None:
        match message:
            case m.Members():
                self.carried += self.peer.take_carried(message)
                return self.grown() + self.counted(self.peer.request_rest(message.node))
            case m.Signature():
                found = ch.channel_of(sample.key)
                if self.peer.proofs is not None and found is not None:
                    channel, name = found
                    operators = channel is ch.ORDER_SIGNATURE
                    if operators or channel.publisher(name) in self.peer.known:
                        self.peer.proofs.take_signature(message, OPERATOR if operators else name)
                return []
            case m.SetSummary():
                return self.counted(self.peer.take_summary(message))
            case m.Progress() | m.StreamHead() | m.TeamEnd() | m.End():
                return self._from_fold(self.fold.note(message))
            case m.Liveliness(node="world"):
                self.world_alive = message.alive
                return []
            case m.Liveliness():
                self._meet(message)
                return self._from_fold(self.fold.note(message))
            case _:
                return None

    def _meet(self, token: m.Liveliness) -> None:
        if token.node == self.name or token.node not in self.peer.known:
            return
        (self.others.add if token.alive else self.others.discard)(token.node)
        if token.alive:
            self.peer.greet()

    @property
    def is_left_alone(self) -> bool:
        """Whether all others have ended, and no present node has the missing members."""
        stated = self.peer.replica.statements
        others = {
            robot
            for robot in self.peer.replica.robots
            if ch.robot_node(robot) != self.name
            and not {("given_up", 0), ("withdrawal", 0)} & stated[robot].keys()
        }
        return bool(others) and others <= self.ended and self.final is None and not self.others

    def take_end(self, samples: Sequence[Sample]) -> None:
        """Note the ends of robots that the router stores."""
        for _, robot, message in open_valid(samples):
            if isinstance(message, m.Concluded):
                self.ended.add(robot)

    def _take(
        self, message: m.Message, sample: Sample, channel: ch.Channel | None, name: str
    ) -> list[Outgoing]:
        if channel is None or channel not in CHANNELS:
            return []
        self.peer.take_sample(sample, channel.publisher(name))
        return self.grown()

    def tick(self, now_s: float) -> list[Outgoing]:
        """Make the messages that are due at the monotonic time now_s [s]."""
        unpublished, self.unpublished = self.unpublished, []
        return [*unpublished, *self.counted(self.peer.tick(now_s))]

    def counted(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """Count the messages of the set's channels."""
        talk = [each for each in out if each.channel in (*SET_CHANNELS, ch.MEMBERS)]
        self.uplink += sum(len(encoded(each.message)) for each in talk)
        return list(out)

    def grown(self) -> list[Outgoing]:
        """Fold the new members of the set."""
        return self._from_fold(self.fold.grow())

    def _from_fold(self, messages: Sequence[Outgoing]) -> list[Outgoing]:
        return list(messages)

    def refresh(self) -> list[Outgoing]:
        """Make a map of the members since the last map."""
        return self._from_fold(self.fold.refresh())

    def answer(self, request: bytes) -> list[bytes]:
        """Answer a peer's `MembersRequest`."""
        answer = self.peer.answer(request)
        self.uplink += sum(len(batch) for batch in answer)
        self.downlink += len(request)
        return answer

    def answer_fold(self, request: bytes) -> list[bytes]:
        """Answer a `FoldRequest` with the newest map of all present members."""
        decoded(request, m.FoldRequest)
        self.unpublished += self._from_fold(self.fold.ask())
        maps = [each.message for each in self.unpublished if isinstance(each.message, m.FusedMap)]
        self.newest = maps[-1] if maps else self.newest
        return [] if self.newest is None else [encoded(self.newest)]

    def set_figures(self) -> dict[str, float]:
        """Figures of the set's size, sources and agreement."""
        replica = self.peer.replica
        figures = {
            "set_submaps": float(replica.submaps),
            "set_refused": float(self.peer.refused),
            "set_uplink_bytes": float(self.uplink),
            "set_downlink_bytes": float(self.downlink),
            "set_agrees": float(sum(self.peer.agrees.values())),
        }
        for robot in replica.robots:
            shares = [share for (name, _), share in replica.streams.items() if name == robot]
            figures[f"set_submaps.{robot}"] = float(sum(len(each.complete) for each in shares))
            newest_ns = max((each.newest_ns for each in shares), default=0)
            figures[f"set_newest_s.{robot}"] = newest_ns * 1e-9
        over = {f"set_over.{node}": float(n) for node, n in self.peer.carried.items()}
        return figures | over


def member_in(out: Outgoing) -> Member:
    """Convert a message of this node to a member of the set."""
    return Member(out.channel.key(about(out.message)), encoded(out.message), out.message)
