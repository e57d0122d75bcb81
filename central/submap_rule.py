"""What rules on submaps share: the set, credit for each submap, orders, and who lacks what."""

from collections.abc import Sequence

from central.attendance import TeamAttendance
from central.config import CentralConfig
from central.rule import FusionRule, Stream
from central.submap_set import SubmapSet
from central.withdrawal_witnesses import WithdrawalWitnesses
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


class SubmapRule(FusionRule):
    """A set of submaps; every submap is acknowledged when nobody need send it any more."""

    listens = (ch.START, ch.SUBMAP, ch.SIGHTING_FACTOR, ch.ORDER, ch.WITHDRAWALS_HEARD, ch.VERDICT)

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str] = ()) -> None:
        super().__init__(config, digest, robots)
        self.withdrawal_witnesses = WithdrawalWitnesses(robots)
        self.reset()

    def admit(self, robot: str) -> None:
        """From now on the robot is in the team, and may be heard of others."""
        super().admit(robot)
        self.withdrawal_witnesses.admit(robot)

    def reset(self) -> None:
        """Nothing is here."""
        self.members = SubmapSet()
        self.starts: dict[Stream, m.InitialPose] = {}
        self.entered: dict[Stream, int] = {}
        self._refusals: dict[Stream, set[int]] = {}
        self.orders: set[str] = set()
        self.refused = 0

    def _enters(self, submap: m.Submap, sightings: Sequence[m.SightingFactor]) -> None:
        """A submap is there without a gap, and all inter-robot measurements from it."""

    def _began(self, start: m.InitialPose) -> None:
        """A stream begins."""

    def _goes(self, robot: str) -> None:
        """The team goes on without a robot."""

    def _judges(self, verdict: m.Verdict) -> None:
        """An operator says that two unnamed landmarks are one, or two."""

    # What comes.

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Admit a submap or an inter-robot measurement; the last inter-robot measurement of a
        submap completes it.
        """
        match message:
            case m.InitialPose():
                self.take_start(message)
            case m.Submap():
                return _credit(message, self.take_submap(message), now_ns)
            case m.SightingFactor():
                before = self.count((message.robot, message.incarnation))
                count = self.take_sighting(message)
                return _credit(message, count, now_ns) if count > before else []
            case m.Withdrawal():
                return self._follow(message)
            case m.Verdict():
                self._judges(message)
            case m.WithdrawalHeard():
                order = self.withdrawal_witnesses.take(message)
                return [] if order is None else self._follow(order)
            case _:
                pass
        return []

    def take_start(self, start: m.InitialPose) -> None:
        """A stream begins; its submaps wait for this."""
        stream = (start.robot, start.incarnation)
        if stream not in self.starts:
            self.starts[stream] = start
            self._began(start)
            self._enter(stream)

    def take_submap(self, submap: m.Submap) -> int:
        """Admit a submap; how many of its stream have been dealt with."""
        stream = (submap.robot, submap.incarnation)
        self._judge(submap, self.members.admit(submap))
        self._enter(stream)
        return self._dealt_with(stream, self.members.count(stream))

    def take_sighting(self, sighting: m.SightingFactor) -> int:
        """Admit an inter-robot measurement; how many submaps of its stream have been dealt with."""
        stream = (sighting.robot, sighting.incarnation)
        self._judge(sighting, self.members.admit_sighting(sighting))
        self._enter(stream)
        return self._dealt_with(stream, self.members.count(stream))

    def _enter(self, stream: Stream) -> None:
        """Hand on what now is there without a gap."""
        if stream not in self.starts:
            return
        chain = self.members.chain(stream)
        for submap in chain[self.entered.get(stream, 0) :]:
            self._enters(submap, self.members.sightings(submap))
        self.entered[stream] = len(chain)

    def take_withdrawal(self, withdrawal: m.Withdrawal) -> None:
        """The team goes on without a robot; its submaps are still admitted, for whoever asks."""
        robot, known = withdrawal.robot, self.withdrawn
        self._goes(robot)
        self.orders.add(robot)
        if robot not in known:
            said = f"{robot} withdrawn by {withdrawal.by}: {withdrawal.reason}"
            self.warnings.append(said)

    def _follow(self, order: m.Withdrawal) -> list[Outgoing]:
        """Who joins later hears of every order from the centre: an operator does not stay.

        What the centre itself has ordered, before it was started again, its fold finds again.
        """
        if order.by == "central":
            return []
        known = self.withdrawn
        self.take_withdrawal(order)
        return [] if order.robot in known else [Outgoing(ch.WITHDRAWAL, order.robot, order)]

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the team goes on without, ascending."""
        return tuple(sorted(self.orders))

    # What is refused.

    def refuse(self, message: m.Message, why: str, now_ns: int) -> list[Outgoing]:
        """Nobody need wait for a submap, or an inter-robot measurement from it, that raised."""
        if not isinstance(message, m.Submap | m.SightingFactor):
            return []
        self._judge(message, why)
        return _credit(message, self.count((message.robot, message.incarnation)), now_ns)

    def _judge(self, of: m.Submap | m.SightingFactor, reason: str | None) -> None:
        """A refused submap, or one with a refused inter-robot measurement, may never be in the
        map.
        """
        if reason is not None:
            self.refused += 1
            self.warnings.append(f"refused: {reason}")
            self._refusals.setdefault((of.robot, of.incarnation), set()).add(of.sequence)

    def _dealt_with(self, stream: Stream, count: int) -> int:
        """`count`, unless the next one was refused: then nobody need wait for it.

        What follows the refused one can not enter the map; it counts as far as it has come.
        """
        refused = self._refusals.get(stream, set())
        if count not in refused:
            return count
        return max(*refused, *self.members.streams.get(stream, {}), count) + 1

    # What is here.

    @property
    def streams(self) -> list[Stream]:
        """The streams that the set has submaps of."""
        return sorted(self.members.streams)

    def count(self, stream: Stream) -> int:
        """How many submaps of a stream are in the map's reach, or will never be."""
        return self._dealt_with(stream, self.entered.get(stream, 0))

    @property
    def submaps(self) -> int:
        """In the map's reach, or refused."""
        return sum(self.count(stream) for stream in self.streams)

    def dealt(self, done: m.Done) -> bool:
        """Every submap that the robot has sent is in the map's reach."""
        return self.count((done.robot, done.incarnation)) >= done.submaps

    def kept(self, robot: str) -> list[m.Message]:
        """What the robot's next process takes over, of each incarnation, the latest first.

        It is the initial pose, the submaps without a gap and the inter-robot factors from them.
        """
        found: list[m.Message] = []
        for stream in sorted((s for s in self.members.streams if s[0] == robot), reverse=True):
            chain, start = self.members.chain(stream), self.starts.get(stream)
            if chain and start is not None:
                found += [start, *chain]
                found += [each for submap in chain for each in self.members.sightings(submap)]
        return found

    def lacking(self, attendance: TeamAttendance) -> list[m.SubmapsRequest]:
        """What robots say that they have sent, and what is not in the map's reach."""
        said = (s for robot in attendance.robots.values() for s in (robot.progress, robot.done))
        sent: dict[Stream, int] = {}
        for each in said:
            if each is not None:
                stream = (each.robot, each.incarnation)
                sent[stream] = max(sent.get(stream, 0), each.submaps)
        here = {stream: self.count(stream) for stream in sent}
        return [
            m.SubmapsRequest(
                stamp_ns=attendance.now_ns,
                robot=stream[0],
                incarnation=stream[1],
                first=here[stream],
            )
            for stream in sorted(sent)
            if here[stream] < sent[stream]
        ]


def _credit(of: m.Submap | m.SightingFactor, count: int, now_ns: int) -> list[Outgoing]:
    progress = m.Progress(
        stamp_ns=now_ns,
        node="central",
        robot=of.robot,
        incarnation=of.incarnation,
        measurements=0,
        submaps=count,
    )
    return [Outgoing(ch.CENTRAL_PROGRESS, of.robot, progress)]
