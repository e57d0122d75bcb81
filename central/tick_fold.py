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

The running fold is bounded (`condensing`): its old submaps are condensed before each tick. Where a
condensed island has to move, the ticks since it was condensed are taken again raw. The full
solution uses the raw submaps: it begins where the running fold has its nodes. Only where not all
of it can be restored, or landmarks have no names (but see FULL_UNNAMED), it takes the condensed
ticks again.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from central.checkpoints import Checkpoints
from central.config import CentralConfig
from central.fold_inputs import FoldInputs
from central.withdrawal import convicted, suspects
from team.config import UNNAMED
from team.estimation.contribution import Stream
from team.estimation.hybrid_slam.sensitivity_kernel import BIASES
from team.estimation.map_joining import marginals
from team.estimation.map_joining.association.landmarks import Verdict
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
    """The robots that a fold has withdrawn, with the reason in words, and the last tick for it."""

    robots: Mapping[str, str] = field(default_factory=dict)
    at: float = -math.inf


class TickFold:
    """Folds a set of submaps tick by tick.

    ordered: robots withdrawn by an order. conviction: those withdrawn by the fold itself; none,
    unless `convicts`. bounded: old submaps are condensed, except in ticks up to `_raw_until`, where
    a condensed island had to move. inputs: those of another fold, which are then only read.
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
    def _gone(self) -> frozenset[str]:
        return self._ordered.union(self.convicted)

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The withdrawn robots."""
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
        if is_tested and fold.size >= GROWTH * self.checkpoints.tested:
            return not self._convict(fold, tick)
        return True

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
        """Whether a robot is withdrawn; it is then left out from the first tick on."""
        limit = self._config.withdraw_above
        if limit is None or not self.convicts or not fold.contributions:
            return False
        agreement = self.agreement(fold)
        if not suspects(agreement, limit):
            return False
        self.checkpoints.note_tested(fold.size)
        found = convicted(agreement, limit, self._agreement_without)
        if found is None:
            return False
        robot, reason = found
        robots = {**self.convicted, robot: reason}
        self._begin_again(Conviction(robots, max(self._conviction.at, at)))
        return True

    def _agreement_without(self, robots: Collection[str]) -> Agreement | None:
        fold = self.without(robots).fold
        if not fold.home:
            return None
        return marginals.joint_cost(fold if fold.departed else converged(fold, self.settings))

    def without(self, robots: Collection[str]) -> "TickFold":
        """Another fold of the same inputs without some robots', with the same ticks taken.

        It withdraws no further robot.
        """
        other = TickFold(self._config, self._bounded, self._inputs)
        other.convicts = False
        other._ordered = self._gone.union(robots)
        other.take_until(self._until_ns)
        return other

    # Solutions beyond the closed ticks.

    def provisional(self) -> Fold:
        """The fold over everything that is there, ahead of the watermark too."""
        fold = self.fold
        for tick in self._open_ticks():
            try:
                fold, _ = self._with_tick(fold, tick)
            except CondensedError:
                whole = self.without(())
                whole.take_until(math.inf)
                return whole.fold
        return fold

    def solved(self) -> Fold:
        """The full solution of everything that is here, without the robots that it withdraws."""
        while True:
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
            if not self._convict(fold, math.inf):
                return fold

    def _solved_raw(self) -> Fold:
        """The full solution by a fold of the same inputs that condenses nothing, from the last raw
        checkpoint; its conviction is taken over.
        """
        other = TickFold(self._config, False, self._inputs)
        other.convicts, other._ordered = self.convicts, self._ordered
        if not self.convicted:
            other.checkpoints = Checkpoints(self.checkpoints.raw().taken[-1:])
        fold = other.solved()
        if other.convicted != self.convicted:
            self._begin_again(other._conviction)
        return fold

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
