"""The fold over the set of submaps in its canonical order, by ticks of team time.

Tick b takes the submaps that end in (b·tick, (b + 1)·tick]. Before the watermark every submap of a
tick has arrived, so the fold is final; a late submap rolls it back to the checkpoint before its
tick.

    add, judge ───> FoldInputs ───tick───> taken(fold, tick) ───> Checkpoints.push
    (grow only)         ^                        ^                      │
                        │                  condensed(fold) <──fold──────┤
                        │ without the robot                             v
                        └──────────────── Conviction <──────────── agreement(fold)

There are three pieces of state, each with one owner. The inputs know no fold. The checkpoints are
a stack that `_take` pushes and `_roll_back` pops. The conviction, the robots that contradict the
rest beyond chance (`central.withdrawal`), is replaced as a whole; whenever it changes all ticks are
taken again without these robots. It is tested after the first tick of each broadcast's time and
after the full solution, never when a broadcast happens to be due. So a withdrawal depends on the
set alone, not on the order or time of arrival.

A robot with few submaps is suspended: running maps leave it out at once, so that it does not move
its teammates' poses, but it is withdrawn only once it has enough of them, or by the full solution.
Until then it is tested again, with all its submaps, whenever the set has grown by GROWTH. A
provisional map is tested by itself.

The running fold is bounded (`condensing`): its old submaps are condensed before each tick. Where a
condensed island has to move, the ticks since it was condensed are taken again raw. The full
solution uses the raw submaps: it begins where the running fold has its nodes. Only where not all
of it can be restored, or landmarks have no names (but see FULL_UNNAMED), it takes the condensed
ticks again.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from central.carried_off import CarriedOff, carried_off
from central.checkpoints import Checkpoints
from central.config import CentralConfig
from central.fold_inputs import FoldInputs
from central.withdrawal import LEAST_SUBMAPS, Trial, convicted, suspects
from team.config import UNNAMED
from team.estimation.association.landmark_sets import Verdict
from team.estimation.contribution import Stream
from team.estimation.hybrid_slam.sensitivity_kernel import BIASES
from team.estimation.map_joining import marginals
from team.estimation.map_joining.auditing import taken
from team.estimation.map_joining.condensing import condensed
from team.estimation.map_joining.joining import Fold, InitialPoseFactor, JoinSettings, converged
from team.estimation.map_joining.marginals import Agreement
from team.estimation.map_joining.relinearising import is_due
from team.estimation.map_joining.submap_graph import CommonBias, CondensedError
from team.wire.messages import SightingFactor, Submap

COMMON: tuple[CommonBias, ...] = (*BIASES, "marker")
"""The biases that the whole team may have in common."""
GROWTH = 1.25
"""Suspects that were not withdrawn are tested again once the number of submaps has grown by this
factor."""
FULL_UNNAMED = 1000
"""Where landmarks have no names, the full solution of up to this many submaps takes all ticks
again: what counts as one landmark is decided by the ticks. With more it starts from the running
fold, since the ticks would take hours."""


def join_settings(config: CentralConfig) -> JoinSettings:
    """The join's settings in a centre's configuration."""
    return JoinSettings(
        iterations_per_tick=config.gauss_newton_per_tick,
        robust_c=config.robust_c,
        covariance_factor=config.covariance_factor,
        bias_sigma={bias: getattr(config.bias_sigma, bias) for bias in BIASES},
        common_bias_sigma={
            name: sigma
            for name in COMMON
            if (sigma := getattr(config.common_bias_sigma, name)) > 0.0
        },
        joined_ranges=config.joined_ranges,
        landmark_sigma=config.landmark_sigma,
        association=config.association,
    )


@dataclass(frozen=True)
class Conviction:
    """The robots that a fold leaves out by itself, each with the reason in words.

    robots: withdrawn. suspended: left out until they are tested again. retried: of the suspended
    robots, the number of submaps of the set from which each is tested again. at: the last tick that
    all this is based on. tested_from: the first tick that is tested under it.
    """

    robots: Mapping[str, str] = field(default_factory=dict)
    suspended: Mapping[str, str] = field(default_factory=dict)
    retried: Mapping[str, float] = field(default_factory=dict)
    at: float = -math.inf
    tested_from: float = -math.inf

    def with_withdrawn(self, robot: str, reason: str, at: float) -> "Conviction":
        """The conviction with one more robot withdrawn."""
        without = self.without_suspended(robot, at, -math.inf)
        return replace(without, robots={**self.robots, robot: reason})

    def with_suspended(self, robot: str, reason: str, retried: float, at: float) -> "Conviction":
        """The conviction with one more robot suspended."""
        return replace(
            self,
            suspended={**self.suspended, robot: reason},
            retried={**self.retried, robot: retried},
            at=max(self.at, at),
            tested_from=-math.inf,
        )

    def without_suspended(self, robot: str, at: float, tested_from: float) -> "Conviction":
        """The conviction under which a suspended robot is tested again."""
        return replace(
            self,
            suspended={each: why for each, why in self.suspended.items() if each != robot},
            retried={each: size for each, size in self.retried.items() if each != robot},
            at=max(self.at, at),
            tested_from=tested_from,
        )


class TickFold:
    """Folds a set of submaps tick by tick.

    ordered: robots withdrawn by an order. conviction: those withdrawn by the fold itself; none,
    unless `convicts`. bounded: old submaps are condensed, except in ticks up to `_raw_until`, where
    a condensed island had to move. inputs: those of another fold, which are then only read.
    undecided: in words, robots that contradict each other at the last test, of which none can be
    told wrong.
    """

    def __init__(
        self, config: CentralConfig, bounded: bool = True, inputs: FoldInputs | None = None
    ) -> None:
        self._config = config
        self._bounded = bounded
        self._inputs = FoldInputs(config) if inputs is None else inputs
        self._period = max(1, math.ceil(config.broadcast_s / config.tick_s))
        self.settings = join_settings(config)
        self.convicts = config.withdraw_above is not None
        self._ordered: frozenset[str] = frozenset()
        self._agreed: tuple[Fold, Agreement] | None = None
        self.undecided = ""
        self._begin_again(Conviction())

    def _begin_again(self, conviction: Conviction) -> None:
        """Forget every tick that was taken, under another conviction."""
        self._conviction = conviction
        self.checkpoints = Checkpoints()
        self._raw_until = -math.inf

    # What goes in.

    def know_start(self, start: InitialPoseFactor) -> None:
        """Take a stream's initial pose, before its first submap is added."""
        self._inputs.know_start(start)

    def add(self, submap: Submap, digest: bytes, sightings: Sequence[SightingFactor] = ()) -> None:
        """Put a submap in its tick, with the inter-robot measurements from it, all of which
        `digest` names.

        The fold goes back to before that tick if it was taken.
        """
        tick = self._inputs.add(submap, digest, sightings)
        if submap.robot not in self._gone or tick <= self._conviction.at:
            self._roll_back(tick)

    def judge(self, verdicts: Collection[Verdict]) -> None:
        """Take an operator's verdicts on pairs of unnamed landmarks, in present or future submaps.

        The fold goes back to before the first tick with both landmarks of a verdict that is new or
        withdrawn.
        """
        tick = self._inputs.judge(verdicts)
        if math.isfinite(tick):
            self._fold_again(tick)

    def withdraw(self, robot: str) -> None:
        """Leave out a robot's submaps, and the inter-robot measurements by it or of it, now and in
        future.

        The result is that of a team without the robot: the fold goes back to the checkpoint before
        the robot's first submap, or the first measurement of it, and takes the ticks again.
        """
        if robot not in self._ordered:
            self._fold_again(self._inputs.first_tick_of(robot), self._ordered | {robot})

    def _fold_again(self, tick: float, ordered: frozenset[str] | None = None) -> None:
        """Take the ticks from this one on again, with other robots withdrawn if there are any."""
        until_ns = self._until_ns
        if math.isfinite(tick):
            self._roll_back(tick)
        self._ordered = self._ordered if ordered is None else ordered
        self.take_until(until_ns)

    def _roll_back(self, tick: float) -> None:
        """Forget what was folded from a tick on, and a conviction that is based on it.

        A convicted robot was left out from the first tick on: no checkpoint has it still.
        """
        if tick <= self._conviction.at:
            self._begin_again(Conviction())
        if tick <= self._raw_until:
            self._raw_until = -math.inf
            self.checkpoints = self.checkpoints.raw()
        self.checkpoints.back_to(tick)

    # What has been folded.

    @property
    def fold(self) -> Fold:
        """The fold over the ticks that have been taken."""
        return self.checkpoints.fold

    @property
    def convicted(self) -> Mapping[str, str]:
        """The robots that the fold has withdrawn, with the reason in words."""
        return self._conviction.robots

    @property
    def suspended(self) -> Mapping[str, str]:
        """The robots that running maps leave out for now, with the reason in words."""
        return self._conviction.suspended

    @property
    def _gone(self) -> frozenset[str]:
        return self._ordered.union(self.convicted, self.suspended)

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the fold is without: withdrawn ones, and suspended ones."""
        return tuple(sorted(self._gone))

    @property
    def _until_ns(self) -> float:
        """The end of the last tick that was taken."""
        return (self.checkpoints.tick + 1) * self._inputs.tick_ns

    def take_until(self, watermark_ns: float) -> bool:
        """Take every tick that ends at the watermark or before; True if there was one."""
        took, again = False, True
        while again:
            again = False
            for tick in self._open_ticks():
                if (tick + 1) * self._inputs.tick_ns > watermark_ns:
                    break
                took = True
                again = not self._take(tick)
                if again:
                    break
        return took

    def _open_ticks(self) -> list[int]:
        """The ticks that are not taken yet and have a submap of a robot that is not withdrawn."""
        return self._inputs.ticks_behind(self.checkpoints.tick, self._gone)

    def _take(self, tick: int) -> bool:
        """Take a tick; False if ticks before it are to be taken again.

        If it withdraws a robot, all ticks are taken again; if it has to move a condensed island,
        those since it was condensed.
        """
        before = self.checkpoints.tick
        try:
            fold, is_raw = self._with_tick(self.fold, tick)
        except CondensedError:
            self._raw_until = tick
            self.checkpoints = self.checkpoints.raw()
            return False
        self.checkpoints.push(tick, fold, is_raw=is_raw)
        is_tested = math.isinf(before) or before // self._period < tick // self._period
        if not is_tested or tick < self._conviction.tested_from:
            return True
        if (robot := self._retried(tick)) is not None:
            first = tick // self._period * self._period
            self._begin_again(self._conviction.without_suspended(robot, tick, first))
            return False
        if fold.size >= GROWTH * self.checkpoints.tested:
            return not self._convict(fold, tick)
        return True

    def _retried(self, tick: int) -> str | None:
        """A suspended robot that is tested again at a tick; None if there is none."""
        if not self.suspended:
            return None
        size = self._size_until(tick)
        due = (r for r, size_then in sorted(self._conviction.retried.items()) if size >= size_then)
        return next(due, None)

    def _size_until(self, tick: float) -> int:
        """Number of submaps up to a tick, those of suspended robots included."""
        gone = self._gone.difference(self.suspended)
        ticks = self._inputs.ticks_behind(-math.inf, gone)
        return sum(self._inputs.size(each, gone) for each in ticks if each <= tick)

    def _with_tick(self, fold: Fold, tick: int) -> tuple[Fold, bool]:
        """The fold with all of a tick, and whether nothing was condensed for it; members beyond the
        bounds are refused before the others.

        A closure moves what is condensed too far for its linearisation: then nothing is condensed.
        Raises CondensedError where an island would have to be moved that is condensed, or comes to
        have unnamed landmarks.
        """
        if self._bounded and tick > self._raw_until:
            fold = self._condensed(fold, tick)
        members = self._inputs.tick(tick, self._gone)
        submaps = members.contributions
        unnamed = (each.stream for each in submaps if (each.local.ids >= UNNAMED).any())
        is_named = not fold.landmarks.are_there
        if fold.departed and is_named and (stream := next(unnamed, None)) is not None:
            raise CondensedError(stream)
        after, is_raw = taken(fold, members, self.settings), not fold.departed
        if fold.departed and after.landmarks.opened:
            fold = self._inputs.relinearised(fold, tick - 1, self._gone)
            after = after if fold.departed else taken(fold, members, self.settings)
        return after, is_raw

    def _condensed(self, fold: Fold, tick: int) -> Fold:
        """The fold that a tick is added to; relinearised where that is due."""
        coming = self._inputs.size(tick, self._gone)
        if fold.departed and is_due(fold.size, fold.size + coming):
            fold = self._inputs.relinearised(fold, tick - 1, self._gone)
        return self.checkpoints.ahead(fold, condensed)

    # Who contradicts the rest.

    def agreement(self, fold: Fold) -> Agreement:
        """The agreement of a fold; the last one's is cached, since a broadcast asks again."""
        if self._agreed is None or self._agreed[0] is not fold:
            self._agreed = fold, marginals.joint_cost(fold)
        return self._agreed[1]

    def _convict(self, fold: Fold, at: float) -> bool:
        """Whether a robot is withdrawn or suspended; it is then left out from the first tick on.

        at: the tick; infinity for the full solution, which suspends nobody. Its warning is part of
        the map, so a fold that withdraws nobody computes it, too.
        """
        self.undecided = ""
        if not self.convicts and math.isfinite(at):
            return False
        found = self._trial(fold, self._until_ns)
        if found is None:
            return False
        if fold is self.fold:
            self.checkpoints.note_tested(fold.size)
        self.undecided = found.undecided
        if found.robot is None or not self.convicts:
            return False
        own = sum(n + 1 for stream, n in self.members(fold).items() if stream[0] == found.robot)
        before = self._conviction
        if math.isinf(at) or own >= LEAST_SUBMAPS:
            self._begin_again(before.with_withdrawn(found.robot, found.reason, at))
        else:
            retried = GROWTH * self._size_until(at)
            self._begin_again(before.with_suspended(found.robot, found.reason, retried, at))
        return True

    def _trial(self, fold: Fold, until_ns: float) -> Trial | None:
        """The trial of a fold up to this time; None where nobody is suspect."""
        limit = self._config.withdraw_above
        if limit is None or not fold.contributions:
            return None
        if not suspects(self.agreement(fold), limit):
            return None
        at_rest = fold if fold.departed else converged(fold, self.settings)

        def without(robots: Collection[str]) -> Agreement | None:
            rest = self.without(robots, until_ns).fold
            if not rest.home:
                return None
            return marginals.joint_cost(rest if rest.departed else converged(rest, self.settings))

        return convicted(marginals.joint_cost(at_rest), limit, without)

    def without(self, robots: Collection[str], until_ns: float | None = None) -> "TickFold":
        """Another fold of the same inputs without some robots', with the same ticks taken, or those
        up to a time.

        It withdraws no further robot.
        """
        other = TickFold(self._config, self._bounded, self._inputs)
        other.convicts = False
        other._ordered = self._gone.union(robots)
        other.take_until(self._until_ns if until_ns is None else until_ns)
        return other

    # Solutions beyond the closed ticks.

    def provisional(self) -> Fold:
        """The fold over everything that is there, ahead of the watermark too."""
        fold = self.fold
        for tick in self._open_ticks():
            try:
                fold, _ = self._with_tick(fold, tick)
            except CondensedError:
                return self.without((), math.inf).fold
        return fold

    def accused(self, provisional: Fold) -> Mapping[str, str]:
        """The robot that contradicts the rest in a provisional fold, with the reason in words; none
        where nothing is ahead of the watermark, since the ticks behind it are tested by themselves.
        """
        if provisional is self.fold or not self.convicts:
            return {}
        found = self._trial(provisional, math.inf)
        return {} if found is None or found.robot is None else {found.robot: found.reason}

    def solved(self) -> Fold:
        """The full solution of everything that is here, without the robots that it withdraws.

        Suspended robots are tested with all that they sent, one after the other.
        """
        while True:
            self.take_until(math.inf)
            if self.suspended:
                robot = min(self.suspended)
                self._begin_again(self._conviction.without_suspended(robot, math.inf, math.inf))
                self.take_until(math.inf)
            fold = self.fold
            if not self.checkpoints.is_raw:
                again = fold.landmarks.are_there and fold.size <= FULL_UNNAMED
                if fold.departed and not again:
                    fold = self._inputs.relinearised(fold, math.inf, self._gone)
                if fold.departed or again:
                    return self._solved_raw()
            if not fold.contributions:
                return fold
            fold = converged(fold, self.settings)
            if not self._convict(fold, math.inf) and not self.suspended:
                return fold

    def _solved_raw(self) -> Fold:
        """The full solution by a fold of the same inputs that condenses nothing, from the last raw
        checkpoint; its conviction is taken over.
        """
        other = TickFold(self._config, False, self._inputs)
        other.convicts, other._ordered = self.convicts, self._ordered
        if not self._gone.difference(self._ordered):
            other.checkpoints = Checkpoints(self.checkpoints.raw().taken[-1:])
        fold = other.solved()
        if other._gone != self._gone:
            self._begin_again(other._conviction)
        self.undecided = other.undecided
        return fold

    def carried_off(self, fold: Fold) -> list[CarriedOff]:
        """Where the robots that the fold has withdrawn were carried off, as far as their submaps
        show it; fold: one without them.
        """
        limit = self._config.withdraw_above
        if limit is None:
            return []
        found = (
            carried_off(fold, chain, limit)
            for robot in sorted(self.convicted)
            for _, chain in sorted(self._inputs.chains(robot).items())
        )
        return [each for each in found if each is not None]

    @property
    def raised(self) -> Mapping[str, int]:
        """By robot, how many folded submaps have had their covariance raised to the least one."""
        return self._inputs.raised(self._gone)

    # The names of a fold.

    def digest(self, fold: Fold, *more: bytes) -> bytes:
        """The name of the fold's set: starts and submaps in canonical order, and `more`."""
        return self._inputs.digest(fold, more, self.checkpoints.tick, self._gone)

    def members(self, fold: Fold) -> Mapping[Stream, int]:
        """The version vector: the last sequence of each stream that was taken or refused."""
        last = {stream: fold.next_sequence(stream) - 1 for stream in fold.home}
        for _, robot, incarnation, sequence in fold.refused:
            last[robot, incarnation] = max(last.get((robot, incarnation), -1), sequence)
        return {stream: last[stream] for stream in sorted(last)}
