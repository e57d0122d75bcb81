"""The submaps of a team: the set, the credit for each of them, orders, and missing submaps."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from central.attendance import TeamAttendance
from central.config import CentralConfig
from central.intake import Inputs, Instant, Intake
from central.reach import Reach
from central.submap_set import SubmapSet
from central.unnamed_landmarks import verdict_of
from team.estimation.association.landmark_sets import Verdict
from team.estimation.contribution import Stream
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


def _none(_submap: m.Submap) -> Sequence[m.SightingFactor]:
    return ()


@dataclass(frozen=True, kw_only=True)
class SubmapInputs(Inputs):
    """A set of submaps, and orders and verdicts about it.

    starts: of every stream. submaps: of each stream from sequence 0 on, without a gap. sightings:
    from a submap. reached: the stream of each submap, in the order in which they came; none where
    that is not known. withdrawn: robots withdrawn by an order. verdicts: an operator's on unnamed
    landmarks. missing: what streams wait for. arrived: number of submaps, orders and verdicts that
    have arrived, to compare maps by. priors_of: the streams whose priors are recorded with the
    map.
    """

    starts: Mapping[Stream, m.InitialPose] = field(default_factory=dict)
    submaps: Mapping[Stream, Sequence[m.Submap]] = field(default_factory=dict)
    reached: Sequence[Stream] = ()
    sightings: Callable[[m.Submap], Sequence[m.SightingFactor]] = _none
    withdrawn: Collection[str] = ()
    verdicts: Collection[Verdict] = ()
    missing: tuple[m.VersionEntry, ...] = ()
    arrived: int = 0
    priors_of: Collection[Stream] = ()


class SubmapIntake(Intake[SubmapInputs]):
    """Collects a set of submaps; every submap is acknowledged when nobody need send it any more."""

    listens = (ch.START, ch.SUBMAP, ch.SIGHTING_FACTOR, ch.ORDER, ch.VERDICT)

    def __init__(self, config: CentralConfig, robots: Sequence[str]) -> None:
        super().__init__(config, robots)
        self._set = SubmapSet()
        self._starts: dict[Stream, m.InitialPose] = {}
        self._reach = Reach()
        self._refusals: dict[Stream, set[int]] = {}
        self._verdicts: set[Verdict] = set()
        self._no_more: set[Verdict] = set()

    # What goes into a map.

    def inputs(self, closed_ns: float, now_ns: int) -> SubmapInputs:
        """The set as it is now; what is returned grows with it."""
        return SubmapInputs(
            closed_ns=closed_ns,
            now_ns=now_ns,
            starts=self._starts,
            submaps=self._reach.chains,
            reached=self._reach.order,
            sightings=self._set.sightings,
            withdrawn=self.orders,
            verdicts=self._verdicts,
            missing=self._set.missing(),
            arrived=self._arrived,
        )

    @property
    def _arrived(self) -> int:
        """Submaps in the map's reach, orders, and verdicts and their withdrawals."""
        verdicts = len(self._verdicts | self._no_more) + len(self._no_more)
        return len(self._reach.order) + len(self.orders) + verdicts

    def _note_reached(self, stream: Stream) -> None:
        """Note the submaps of a stream that has begun that have come into the map's reach."""
        if stream in self._starts:
            self._reach.note(stream, self._set.chain(stream))

    def instants(self, attendance: TeamAttendance) -> Iterator[Instant[SubmapInputs]]:
        """Now: what the least progress of the live robots has closed, and what is ahead of it."""
        watermark_ns = attendance.watermark_ns(self.dealt, self.count)
        yield Instant(attendance.now_ns, self.inputs(watermark_ns, attendance.now_ns))

    def members(self, until_ns: float) -> Mapping[Stream, int]:
        """The last submap of each stream that ends up to a time."""
        return self._reach.members(until_ns)

    # What comes.

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Admit a submap or an inter-robot factor; the last factor of a submap completes it."""
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
                self._judge_landmarks(message)
            case _:
                pass
        return []

    def take_start(self, start: m.InitialPose) -> None:
        """Begin a stream, for which its submaps wait."""
        stream = (start.robot, start.incarnation)
        self._starts.setdefault(stream, start)
        self._note_reached(stream)

    def take_submap(self, submap: m.Submap) -> int:
        """Admit a submap; returns how many of its stream have been dealt with."""
        stream = (submap.robot, submap.incarnation)
        self._judge(submap, self._set.admit(submap))
        self._note_reached(stream)
        return self._dealt_with(stream, self._set.count(stream))

    def take_sighting(self, sighting: m.SightingFactor) -> int:
        """Admit an inter-robot factor; returns how many submaps of its stream have been dealt
        with.
        """
        stream = (sighting.robot, sighting.incarnation)
        self._judge(sighting, self._set.admit_sighting(sighting))
        self._note_reached(stream)
        return self._dealt_with(stream, self._set.count(stream))

    def take_withdrawal(self, withdrawal: m.Withdrawal) -> None:
        """Withdraw a robot by an order; its submaps are still admitted, since others may request
        them.
        """
        robot, known = withdrawal.robot, self.withdrawn
        self.orders.add(robot)
        if robot not in known:
            self.withdrawn = tuple(sorted({*known, robot}))
            warning = f"{robot} withdrawn by {withdrawal.by}: {withdrawal.reason}"
            self.warnings.append(warning)

    def _judge_landmarks(self, verdict: m.Verdict) -> None:
        """Take an operator's verdict that two unnamed landmarks are one or two, or its
        withdrawal.
        """
        judged = verdict_of(verdict.judgement)
        if verdict.withdrawn:
            self._no_more.add(judged)
            self._verdicts.discard(judged)
        elif judged not in self._no_more:
            self._verdicts.add(judged)

    def _follow(self, order: m.Withdrawal) -> list[Outgoing]:
        """Repeat an order for robots that join later, since the operator's command has ended.

        An order that this centre itself gave in an earlier process is found again by its fold.
        """
        if order.by == "central":
            return []
        known = self.withdrawn
        self.take_withdrawal(order)
        return [] if order.robot in known else [Outgoing(ch.WITHDRAWAL, order.robot, order)]

    # What is refused.

    def refuse(self, message: m.Message, why: str, now_ns: int) -> list[Outgoing]:
        """Mark a submap as refused if its handling, or that of an inter-robot factor from it, has
        raised, so that nothing waits for it.
        """
        if not isinstance(message, m.Submap | m.SightingFactor):
            return []
        self._judge(message, why)
        return _credit(message, self.count((message.robot, message.incarnation)), now_ns)

    def _judge(self, of: m.Submap | m.SightingFactor, reason: str | None) -> None:
        """Mark a refused submap, or one with a refused inter-robot factor: it may never be in the
        map.
        """
        if reason is not None:
            self.refused += 1
            self.warnings.append(f"refused: {reason}")
            self._refusals.setdefault((of.robot, of.incarnation), set()).add(of.sequence)

    def _dealt_with(self, stream: Stream, count: int) -> int:
        """`count`, unless the next submap was refused: then those after it count, too, since
        nothing waits for them.
        """
        refused = self._refusals.get(stream, set())
        if count not in refused:
            return count
        return max(*refused, *self._set.streams.get(stream, {}), count) + 1

    # What is here.

    def count(self, stream: Stream) -> int:
        """How many submaps of a stream are in the map's reach, or will never be."""
        return self._dealt_with(stream, self._set.count(stream) if stream in self._starts else 0)

    @property
    def submaps(self) -> int:
        """Number of submaps in the map's reach, or refused."""
        return sum(self.count(stream) for stream in self._set.streams)

    def dealt(self, done: m.Done) -> bool:
        """True once every submap that the robot has sent is in the map's reach."""
        return self.count((done.robot, done.incarnation)) >= done.submaps

    def stored_messages(self, robot: str) -> list[m.Message]:
        """The messages that the robot's next process takes over, of each incarnation, the latest
        first.

        These are the initial pose, the submaps without a gap and the inter-robot factors from them.
        """
        found: list[m.Message] = []
        for stream in sorted((s for s in self._set.streams if s[0] == robot), reverse=True):
            chain, start = self._set.chain(stream), self._starts.get(stream)
            if chain and start is not None:
                found += [start, *chain]
                found += [each for submap in chain for each in self._set.sightings(submap)]
        return found

    def lacking(self, attendance: TeamAttendance) -> list[m.SubmapsRequest]:
        """Requests for submaps that robots have announced and that are not in the map's reach."""
        announced = (
            s for robot in attendance.robots.values() for s in (robot.progress, robot.done)
        )
        sent: dict[Stream, int] = {}
        for each in announced:
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
