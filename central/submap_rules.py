"""The rules on submaps as the node plays them: credit for each, and the watermark."""

from collections.abc import Mapping, Sequence

from central.baselines.svd_rule import SvdJoinRule
from central.config import CentralConfig
from central.hearsay import Hearsay
from central.join_rule import JoinRule
from central.roll import Roll
from central.submap_set import Stream
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


class SubmapRule:
    """A set of submaps and the map that it gives; every submap is acknowledged."""

    listens = (ch.START, ch.SUBMAP, ch.SIGHTING_FACTOR, ch.ORDER, ch.WITHDRAWALS_HEARD)

    def __init__(self, rule: JoinRule, robots: Sequence[str]) -> None:
        self.joined = rule
        self._hearsay = Hearsay(robots)

    @property
    def landmarks(self) -> int:
        """In the newest map."""
        return self.joined.landmarks

    @property
    def submaps(self) -> int:
        """In the fold's reach, or refused."""
        return sum(self.joined.count(stream) for stream in self.joined.streams)

    @property
    def figures(self) -> Mapping[str, float]:
        """Refused submaps, and what the monitor has found."""
        refused = self.joined.refused + self.joined.not_folded
        return {"refused": float(refused)} | self.joined.finding.figures

    @property
    def findings(self) -> tuple[str, ...]:
        """The monitor's, and why robots are not joined or the map is to be doubted, in words."""
        unconfirmed = self._hearsay.unconfirmed(self.joined.withdrawn)
        return (*self.joined.finding.warnings, *self.joined.reasons, *unconfirmed)

    @property
    def warnings(self) -> list[str]:
        """What was refused, and why."""
        return self.joined.warnings

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Admit a submap or a sighting; the last sighting of a submap completes it."""
        match message:
            case m.Start():
                self.joined.take_start(message)
            case m.Submap():
                return _credit(message, self.joined.take_submap(message), now_ns)
            case m.SightingFactor():
                before = self.joined.count((message.robot, message.epoch))
                count = self.joined.take_sighting(message)
                return _credit(message, count, now_ns) if count > before else []
            case m.Withdrawal():
                return self._follow(message)
            case m.WithdrawalHeard():
                order = self._hearsay.take(message)
                return [] if order is None else self._follow(order)
            case _:
                pass
        return []

    def _follow(self, order: m.Withdrawal) -> list[Outgoing]:
        """Who joins later hears of every order from the centre: an operator does not stay.

        What the centre itself has ordered, before it was started again, its fold finds again.
        """
        if order.by == "central":
            return []
        known = self.joined.withdrawn
        self.joined.take_withdrawal(order)
        return [] if order.robot in known else [Outgoing(ch.WITHDRAWAL, order.robot, order)]

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the team goes on without."""
        return self.joined.withdrawn

    def refuse(self, message: m.Message, why: str, now_ns: int) -> list[Outgoing]:
        """Nobody need wait for a submap, or a sighting from it, that raised."""
        if not isinstance(message, m.Submap | m.SightingFactor):
            return []
        return _credit(message, self.joined.refuse(message, why), now_ns)

    def dealt(self, done: m.Done) -> bool:
        """Every submap that the robot has sent is in the fold's reach."""
        return self.joined.count((done.robot, done.epoch)) >= done.submaps

    def complete(self, end: m.End) -> bool:
        """Only robots are waited for."""
        return True

    def advance(self, roll: Roll) -> list[Outgoing]:
        """A broadcast, when one is due."""
        watermark_ns = roll.watermark_ns(self.dealt, self.joined.count)
        return self.joined.advance(watermark_ns, roll.now_ns)

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The final map of everything that is here."""
        return self.joined.conclude(now_ns)

    def kept(self, robot: str) -> Sequence[m.Message]:
        """The robot's starts, submaps and sightings, its latest epoch first."""
        return self.joined.kept(robot)

    def lacking(self, roll: Roll) -> list[m.SubmapsWanted]:
        """What robots say that they have sent, and what is not in the fold's reach."""
        said = (s for robot in roll.robots.values() for s in (robot.progress, robot.done))
        sent: dict[Stream, int] = {}
        for each in said:
            if each is not None:
                stream = (each.robot, each.epoch)
                sent[stream] = max(sent.get(stream, 0), each.submaps)
        here = {stream: self.joined.count(stream) for stream in sent}
        return [
            m.SubmapsWanted(roll.now_ns, *stream, here[stream])
            for stream in sorted(sent)
            if here[stream] < sent[stream]
        ]

    def wanted(self, now_ns: int) -> list[m.ReadingsWanted]:
        """It takes no readings."""
        return []


def submap_rule(config: CentralConfig, digest: bytes, robots: Sequence[str]) -> SubmapRule:
    """The rule on submaps that the configuration names."""
    rule = JoinRule if config.fusion == "join" else SvdJoinRule
    return SubmapRule(rule(config, digest), robots)


def _credit(of: m.Submap | m.SightingFactor, count: int, now_ns: int) -> list[Outgoing]:
    progress = m.Progress(now_ns, "central", of.robot, of.epoch, 0, count)
    return [Outgoing(ch.CENTRAL_PROGRESS, of.robot, progress)]
