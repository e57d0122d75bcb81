"""The fold over the set in its canonical order, by ticks of team time, with its checkpoints.

Tick b takes the submaps that end in (b·tick, (b + 1)·tick]. Before the watermark every submap of a
tick has arrived, so the fold is final; a late submap rolls it back to the checkpoint before its
tick.

The fold itself withdraws a robot that contradicts the rest beyond chance, and begins again without
it. It tests this after the first tick of each broadcast's time and of the full solution, never when
a broadcast happens to be due. So a withdrawal depends on the set alone, not on the order or time of
arrival.

The running fold is bounded (`condensing`): its old submaps are condensed before each tick. The full
solution uses the raw submaps: it takes the condensed ticks again (but see FULL).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from central.config import CentralConfig
from central.members import Members
from central.withdrawal import convicted, suspects
from team.config import UNNAMED
from team.estimation.contribution import Stream, named
from team.estimation.hybrid_slam.sensitivity import BIASES
from team.estimation.map_joining import marginals
from team.estimation.map_joining.association.landmarks import Verdict
from team.estimation.map_joining.auditing import taken
from team.estimation.map_joining.condensing import condensed
from team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    Fold,
    InitialPoseFactor,
    JoinSettings,
    Tick,
    compacted,
    converged,
)
from team.estimation.map_joining.marginals import Agreement
from team.estimation.map_joining.relinearising import is_due, relinearised
from team.estimation.map_joining.submap_graph import CommonBias, CondensedError
from team.estimation.plausible import sighting_beyond, start_beyond, submap_beyond
from team.wire.digest import digest_of
from team.wire.messages import SightingFactor, Submap

COMMON: tuple[CommonBias, ...] = (*BIASES, "marker")
"""The errors that the whole team has."""
GROWTH = 1.25
"""Suspects that were not withdrawn are tested again once the number of submaps has grown by this
factor."""
FULL = 2000
"""The full solution of up to this many submaps takes all ticks again; with more it starts from
the running fold, since the ticks would take hours."""
NEWEST = 8
"""Number of newest ticks whose checkpoints are all kept; of older ones as many for each doubling
of the age."""


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
        association=config.association,
    )


@dataclass
class Checkpoint:
    """The fold after a tick; tried: its number of submaps when no suspect was last found.

    number: of the ticks that were taken, this one included.
    """

    tick: int
    fold: Fold
    tried: int
    number: int


def thinned(taken: list[Checkpoint]) -> list[Checkpoint]:
    """The checkpoints to keep: the newest, then ever fewer, and the last one of a raw fold.

    Of those that are n to 2n ticks old a quarter and more of every n: what comes late is taken from
    a checkpoint that is not much older than it, and there are no more than a few tens.
    """
    last = taken[-1].number
    raw = max((each.number for each in taken if not each.fold.departed), default=0)
    return [
        each
        for each in taken
        if each.number == raw or each.number % _spacing(last - each.number) == 0
    ]


def _spacing(age: int) -> int:
    return 1 << max(0, (age // NEWEST).bit_length())


class TickFold:
    """Holds the contributions by tick and the fold after each tick that has been taken.

    convicted: the robots that the fold has withdrawn, with the reason in words; none, unless
    `convicts`. bounded: old submaps are condensed, except in ticks up to `_raw_until`, since a
    condensed island's frame had to be turned there. verdicts: an operator's on unnamed landmarks.
    """

    def __init__(self, config: CentralConfig, bounded: bool = True) -> None:
        self._config = config
        self._bounded = bounded
        self._raw_until = -math.inf
        self.settings = join_settings(config)
        self.convicts = config.withdraw_above is not None
        self._ordered: set[str] = set()
        self.convicted: dict[str, str] = {}
        self._convicted_at = -math.inf
        self._tick_ns = round(config.tick_s * 1e9)
        self._period = max(1, math.ceil(config.broadcast_s / config.tick_s))
        self._members = Members(self._tick_ns)
        self._starts: dict[Stream, InitialPoseFactor] = {}
        self.verdicts: set[Verdict] = set()
        self._tick_with: dict[tuple[str, int, int], int] = {}
        self._taken: list[Checkpoint] = []
        self._agreed: tuple[Fold, Agreement] | None = None

    def know_start(self, start: InitialPoseFactor) -> None:
        """Take a stream's initial pose, before its first submap is added."""
        self._starts[(start.robot, start.incarnation)] = start

    def add(self, submap: Submap, digest: bytes, sightings: Sequence[SightingFactor] = ()) -> None:
        """Put a submap in its tick, with the inter-robot measurements from it, all of which
        `digest` names.

        The fold goes back to before that tick if it was taken.
        """
        tick = self._members.add(submap, digest, sightings)
        self._tick_with[submap.robot, submap.incarnation, submap.sequence] = tick
        if submap.robot not in self._gone or tick <= self._convicted_at:
            self._roll_back(tick)

    def judge(self, verdicts: Collection[Verdict]) -> None:
        """Take an operator's verdicts on pairs of unnamed landmarks, in present or future submaps.

        The fold goes back to before the first tick with both landmarks of a verdict that is new or
        withdrawn.
        """
        changed = self.verdicts.symmetric_difference(verdicts)
        if not changed:
            return
        until_ns = self._until_ns
        self.verdicts.symmetric_difference_update(changed)
        ticks = [tick for each in changed if (tick := self._tick_judging(each)) is not None]
        if ticks:
            self._roll_back(min(ticks))
            self.take_until(until_ns)

    def _tick_judging(self, verdict: Verdict) -> int | None:
        """The first tick by which both landmarks' submaps have arrived; None while one is
        missing.
        """
        ticks = [self._tick_with.get(each[:3]) for each in verdict[:2]]
        known = [tick for tick in ticks if tick is not None]
        return max(known) if len(known) == len(ticks) else None

    def withdraw(self, robot: str) -> None:
        """Leave out a robot's submaps, and the inter-robot measurements by it or of it, now and in
        future.

        The result is that of a team without the robot: the fold goes back to the checkpoint before
        the robot's first submap, or the first measurement of it, and takes the ticks again.
        """
        if robot in self._ordered:
            return
        until_ns = self._until_ns
        ticks = self._members.behind(-math.inf)
        touched = next((tick for tick in ticks if self._members.concerns(tick, robot)), None)
        if touched is not None:
            self._roll_back(touched)
        self._ordered.add(robot)
        self.take_until(until_ns)

    def without(self, robots: Collection[str]) -> "TickFold":
        """Another one of the same submaps without some robots' that has taken the same ticks.

        It withdraws no further robot.
        """
        other = self._other(self._bounded)
        other.convicts = False
        other._ordered = self._gone | set(robots)
        other.take_until(self._until_ns)
        return other

    def _other(self, bounded: bool) -> "TickFold":
        """Another one of the same members that has taken nothing yet."""
        other = TickFold(self._config, bounded)
        other._members, other._starts = self._members, self._starts
        other.verdicts, other._tick_with = self.verdicts, self._tick_with
        return other

    def _full(self) -> "TickFold":
        """Another one of the same members that condenses nothing, from the last raw checkpoint."""
        other = self._other(bounded=False)
        other.convicts, other._ordered = self.convicts, set(self._ordered)
        raw = [each for each in self._taken if not each.fold.departed]
        if raw and not self.convicted:
            other._taken = [replace(raw[-1])]
        return other

    @property
    def _gone(self) -> set[str]:
        return self._ordered | self.convicted.keys()

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The withdrawn robots."""
        return tuple(sorted(self._gone))

    @property
    def _until_ns(self) -> float:
        """The end of the last tick that was taken."""
        return (self._taken[-1].tick + 1) * self._tick_ns if self._taken else -math.inf

    def _roll_back(self, tick: int) -> None:
        """Forget what was folded from a tick on, and withdrawals caused by it.

        The robot was left out from the first tick on: there is no checkpoint that still has it.
        """
        if tick <= self._convicted_at:
            self.convicted, self._convicted_at = {}, -math.inf
            self._taken, self._raw_until = [], -math.inf
        if tick <= self._raw_until:
            self._raw_until = -math.inf
            self._taken = [each for each in self._taken if not each.fold.departed]
        while self._taken and self._taken[-1].tick >= tick:
            self._taken.pop()

    @property
    def fold(self) -> Fold:
        """The fold over the ticks that have been taken."""
        return self._taken[-1].fold if self._taken else EMPTY_FOLD

    def take_until(self, watermark_ns: float) -> bool:
        """Take every tick that ends at the watermark or before; True if there was one."""
        taken, again = False, True
        while again:
            again = False
            for tick in self._open_ticks():
                if (tick + 1) * self._tick_ns > watermark_ns:
                    break
                taken = True
                again = not self._take(tick)
                if again:
                    break
        return taken

    def _take(self, tick: int) -> bool:
        """Take a tick; False if ticks before it are to be taken again.

        If it withdraws a robot, all ticks are taken again; if it has to move a condensed island,
        those since it was condensed.
        """
        before = self._taken[-1] if self._taken else None
        try:
            fold = self._with_tick(self.fold, tick)
        except CondensedError:
            self._raw_until = tick
            self._taken = [each for each in self._taken if not each.fold.departed]
            return False
        taken = Checkpoint(
            tick, fold, *((0, 1) if before is None else (before.tried, before.number + 1))
        )
        if before is not None:
            before.fold = compacted(before.fold)
        self._taken = thinned([*self._taken, taken])
        asked = before is None or before.tick // self._period < tick // self._period
        if asked and taken.fold.size >= GROWTH * taken.tried:
            return not self._convict(taken.fold, tick)
        return True

    def _convict(self, fold: Fold, at: float) -> bool:
        """Whether a robot is withdrawn; it is then left out from the first tick on."""
        limit = self._config.withdraw_above
        if limit is None or not self.convicts or not fold.contributions:
            return False
        agreement = self.agreement(fold)
        if not suspects(agreement, limit):
            return False
        self._taken[-1].tried = fold.size
        found = convicted(agreement, limit, self._agreement_without)
        if found is None:
            return False
        robot, reason = found
        self.convicted[robot] = reason
        self._convicted_at = max(self._convicted_at, at)
        self._taken, self._raw_until = [], -math.inf
        return True

    def agreement(self, fold: Fold) -> Agreement:
        """The agreement of a fold; the last one's is kept, since a broadcast asks again."""
        if self._agreed is None or self._agreed[0] is not fold:
            self._agreed = fold, marginals.joint_cost(fold)
        return self._agreed[1]

    def _agreement_without(self, robots: Collection[str]) -> Agreement | None:
        fold = self.without(robots).fold
        if not fold.home:
            return None
        return marginals.joint_cost(fold if fold.departed else converged(fold, self.settings))

    def solved(self) -> Fold:
        """The full solution of everything that is here, without the robots that it withdraws."""
        self.take_until(math.inf)
        if self.fold.departed:
            raw = self._raw(self.fold, math.inf) if self.fold.size > FULL else self.fold
            if not raw.departed:
                fold = converged(raw, self.settings)
                return self.solved() if self._convict(fold, math.inf) else fold
            full = self._full()
            fold = full.solved()
            if full.convicted != self.convicted:
                self.convicted, self._convicted_at = full.convicted, full._convicted_at
                self._taken, self._raw_until = [], -math.inf
            return fold
        while True:
            self.take_until(math.inf)
            if not self.fold.contributions:
                return self.fold
            fold = converged(self.fold, self.settings)
            if not self._convict(fold, math.inf):
                return fold

    def provisional(self) -> Fold:
        """The fold over everything that is there, ahead of the watermark too."""
        fold = self.fold
        for tick in self._open_ticks():
            try:
                fold = self._with_tick(fold, tick)
            except CondensedError:
                whole = self.without(())
                whole.take_until(math.inf)
                return whole.fold
        return fold

    def _open_ticks(self) -> list[int]:
        """The ticks that are not taken yet and have a submap of a robot that is not withdrawn."""
        last = self._taken[-1].tick if self._taken else -math.inf
        gone = self._gone
        return [tick for tick in self._members.behind(last) if self._members.keys(tick, gone)]

    def _with_tick(self, fold: Fold, tick: int) -> Fold:
        """The fold with all of a tick; members beyond the bounds are refused before the others.

        Raises CondensedError where an island would have to be moved that is condensed, or comes to
        have unnamed landmarks.
        """
        if self._bounded and tick > self._raw_until:
            fold = self._condensed(fold, tick)
        gone = self._gone
        order = self._members.keys(tick, gone)
        members = [self._members.contribution(key) for key in order]
        unnamed = (each.stream for each in members if (each.local.ids >= UNNAMED).any())
        if fold.departed and (stream := next(unnamed, None)) is not None:
            raise CondensedError(stream)
        outside = {}
        for each in members:
            why = submap_beyond(each.local, self._config.bounds)
            if why is not None:
                outside[each.key] = why
        sightings, starts, set_aside = [], [], []
        for sighting in (each for key in order for each in self._members.sightings(key)):
            if sighting.teammate in gone:
                continue
            why = sighting_beyond(sighting, self._config.bounds)
            if why is None:
                sightings.append(sighting)
            else:
                of = f"{sighting.teammate} by {named(sighting.stream)}"
                set_aside.append(f"an inter-robot measurement of {of} refused: {why}")
        for start in (
            self._starts[m.stream] for m in members if m.sequence == 0 and m.stream in self._starts
        ):
            why = start_beyond(start, self._config.bounds)
            if why is None:
                starts.append(start)
            else:
                of = named(start.stream)
                set_aside.append(f"the initial pose of {of} refused, taken as unknown: {why}")
        verdicts = sorted(
            v
            for v in self.verdicts
            if self._tick_judging(v) == tick and not {v.first.robot, v.second.robot} & gone
        )
        news = Tick(members, sightings, starts, outside, tuple(set_aside), tuple(verdicts))
        return taken(fold, news, self.settings)

    def _condensed(self, fold: Fold, tick: int) -> Fold:
        """The fold that a tick is put on; linearised again where that is due."""
        coming = len(self._members.keys(tick, self._gone))
        if fold.departed and is_due(fold.size, fold.size + coming):
            fold = self._raw(fold, tick - 1)
        return condensed(fold)

    def _raw(self, fold: Fold, last: float) -> Fold:
        """A fold up to a tick, solved again from where it is with nothing condensed."""
        gone = self._gone
        keys = [
            key
            for tick in self._members.behind(-math.inf, last)
            for key in self._members.keys(tick, gone)
            if fold.home.get(key[1:3]) == fold.main_key
        ]
        contributions = [self._members.contribution(key) for key in keys]
        seen = (each for key in keys for each in self._members.sightings(key))
        return relinearised(fold, contributions, [s for s in seen if s.teammate not in gone])

    def digest(self, fold: Fold, *more: bytes) -> bytes:
        """The name of the fold's set: starts and submaps in canonical order, and `more`."""
        starts = [
            digest_of(
                robot.encode(),
                incarnation.to_bytes(8, "little"),
                start.pose.tobytes(),
                b"" if start.covariance is None else start.covariance.tobytes(),
            )
            for (robot, incarnation), start in sorted(self._starts.items())
            if (robot, incarnation) in fold.home
        ]
        gone = [f"without {robot}".encode() for robot in self.withdrawn]
        verdicts = sorted(
            f"{v.first} {v.second} {v.same}".encode() for v in fold.landmarks.verdicts
        )
        keys = [*(c.key for c in fold.contributions[-1:]), *fold.refused]
        last = max((self._members.tick_of(key[0]) for key in keys), default=-math.inf)
        closed = min(last, self._taken[-1].tick if self._taken else -math.inf)
        return self._members.digest((*more, *gone, *starts, *verdicts), closed, last, self._gone)

    def members(self, fold: Fold) -> Mapping[Stream, int]:
        """The version vector: the last sequence of each stream that was taken or refused."""
        last = {stream: fold.next_sequence(stream) - 1 for stream in fold.home}
        for _, robot, incarnation, sequence in fold.refused:
            last[robot, incarnation] = max(last.get((robot, incarnation), -1), sequence)
        return {stream: last[stream] for stream in sorted(last)}
