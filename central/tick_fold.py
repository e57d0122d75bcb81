"""The fold over the set in its canonical order, by ticks of team time, with its checkpoints.

Tick b takes the submaps that end in (b·tick, (b + 1)·tick]. Behind the watermark every submap of a
tick is there, so the fold is final; what comes late rolls it back to the checkpoint before.

Who contradicts the rest beyond doubt is withdrawn by the fold itself: it is asked after the first
tick of each broadcast's time and of the full solution, never when a broadcast happens to be due,
and begins again without the robot. So who is withdrawn depends on the set alone, whenever and in
whichever order it came.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from central.config import CentralConfig
from central.withdrawal import convicted, suspects
from team import translate
from team.estimation.contribution import named
from team.estimation.hybrid_slam.sensitivity import BIASES
from team.estimation.map_joining import marginals
from team.estimation.map_joining.auditing import taken
from team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    Contribution,
    Fold,
    InitialPoseFactor,
    JoinSettings,
    Sighting,
    Tick,
    compacted,
    converged,
)
from team.estimation.map_joining.marginals import Agreement
from team.estimation.plausible import sighting_beyond, start_beyond, submap_beyond
from team.wire.messages import SightingFactor, Submap

Stream = tuple[str, int]
Key = tuple[int, str, int, int]

GROWTH = 1.25
"""Suspects whom nothing convicted are tried again when there are so many times the submaps."""


def join_settings(config: CentralConfig) -> JoinSettings:
    """The join's settings in a centre's configuration."""
    return JoinSettings(
        iterations_per_tick=config.gauss_newton_per_tick,
        robust_c=config.robust_c,
        covariance_factor=config.covariance_factor,
        bias_sigma={bias: getattr(config.bias_sigma, bias) for bias in BIASES},
        common_bias_sigma={
            bias: sigma
            for bias in BIASES
            if (sigma := getattr(config.common_bias_sigma, bias)) > 0.0
        },
        joined_ranges=config.joined_ranges,
        association=config.association,
    )


@dataclass
class _Taken:
    """The fold after a tick; tried: its submaps when suspects were last tried in vain."""

    tick: int
    fold: Fold
    tried: int


class TickFold:
    """Holds the contributions by tick and the fold after each tick that has been taken.

    convicted: whom the fold found to be wrong, with the reason in words; nobody, unless `convicts`.
    """

    def __init__(self, config: CentralConfig) -> None:
        self._config = config
        self.settings = join_settings(config)
        self.convicts = config.withdraw_above is not None
        self._ordered: set[str] = set()
        self.convicted: dict[str, str] = {}
        self._convicted_at = -math.inf
        self._tick_ns = round(config.tick_s * 1e9)
        self._period = max(1, math.ceil(config.broadcast_s / config.tick_s))
        self._ticks: dict[int, dict[Key, Contribution]] = defaultdict(dict)
        self._sightings: dict[Key, list[Sighting]] = {}
        self._digests: dict[Key, bytes] = {}
        self._starts: dict[Stream, InitialPoseFactor] = {}
        self._taken: list[_Taken] = []
        self._agreed: tuple[Fold, Agreement] | None = None

    def know_start(self, start: InitialPoseFactor) -> None:
        """Where a stream starts; to be told before its first submap is added."""
        self._starts[(start.robot, start.incarnation)] = start

    def add(self, submap: Submap, digest: bytes, sightings: Sequence[SightingFactor] = ()) -> None:
        """Put a submap in its tick, with the sightings from it, all of which `digest` names.

        The fold goes back to before that tick if it was taken.
        """
        contribution = translate.contribution_of(submap)
        tick = self._tick_of(submap.stamp_ns)
        self._ticks[tick][contribution.key] = contribution
        self._sightings[contribution.key] = [translate.sighting_of(each) for each in sightings]
        self._digests[contribution.key] = digest
        if submap.robot not in self._gone or tick <= self._convicted_at:
            self._roll_back(tick)

    def withdraw(self, robot: str) -> None:
        """Leave out a robot's submaps, and the sightings by it or of it, now and in future.

        What is left is what there would be had the robot never been; the fold goes back to the
        checkpoint before it first said something, or was first seen, and takes the ticks again.
        """
        if robot in self._ordered:
            return
        until_ns = self._until_ns
        touched = [tick for tick in sorted(self._ticks) if self._concerns(tick, robot)]
        if touched:
            self._roll_back(touched[0])
        self._ordered.add(robot)
        self.take_until(until_ns)

    def _concerns(self, tick: int, robot: str) -> bool:
        """Whether a tick has something by a robot or of it."""
        return any(
            key[1] == robot or any(each.teammate == robot for each in self._sightings[key])
            for key in self._ticks[tick]
        )

    def without(self, robots: Collection[str]) -> "TickFold":
        """Another one of the same submaps without some robots' that has taken the same ticks.

        It convicts nobody.
        """
        other = TickFold(self._config)
        other.convicts = False
        other._ticks = defaultdict(dict, {t: dict(found) for t, found in self._ticks.items()})
        other._sightings, other._digests = dict(self._sightings), dict(self._digests)
        other._starts, other._ordered = dict(self._starts), self._gone | set(robots)
        other.take_until(self._until_ns)
        return other

    @property
    def _gone(self) -> set[str]:
        return self._ordered | self.convicted.keys()

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the team goes on without."""
        return tuple(sorted(self._gone))

    @property
    def _until_ns(self) -> float:
        """The end of the last tick that was taken."""
        return (self._taken[-1].tick + 1) * self._tick_ns if self._taken else -math.inf

    def _roll_back(self, tick: int) -> None:
        """Forget what was folded from a tick on, and with it who was convicted by it.

        The robot was left out from the first tick on: there is no checkpoint that still has it.
        """
        if tick <= self._convicted_at:
            self.convicted, self._convicted_at = {}, -math.inf
            self._taken = []
        while self._taken and self._taken[-1].tick >= tick:
            self._taken.pop()

    def _tick_of(self, end_ns: int) -> int:
        return (end_ns - 1) // self._tick_ns

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
                self._take(tick)
                again = not self._taken
                if again:
                    break
        return taken

    def _take(self, tick: int) -> None:
        """Take a tick; if it convicts a robot there is none that is taken any more."""
        before = self._taken[-1] if self._taken else None
        taken = _Taken(
            tick, self._with_tick(self.fold, tick), 0 if before is None else before.tried
        )
        if before is not None:
            before.fold = compacted(before.fold)
        self._taken.append(taken)
        asked = before is None or before.tick // self._period < tick // self._period
        if asked and len(taken.fold.contributions) >= GROWTH * taken.tried:
            self._convict(taken.fold, tick)

    def _convict(self, fold: Fold, at: float) -> bool:
        """Whether somebody is wrong beyond doubt; he is left out from the first tick on."""
        limit = self._config.withdraw_above
        if limit is None or not self.convicts or not fold.contributions:
            return False
        agreement = self.agreement(fold)
        if not suspects(agreement, limit):
            return False
        self._taken[-1].tried = len(fold.contributions)
        found = convicted(agreement, limit, self._agreement_without)
        if found is None:
            return False
        robot, reason = found
        self.convicted[robot] = reason
        self._convicted_at = max(self._convicted_at, at)
        self._taken = []
        return True

    def agreement(self, fold: Fold) -> Agreement:
        """The agreement of a fold; the last one's is kept, since a broadcast asks again."""
        if self._agreed is None or self._agreed[0] is not fold:
            self._agreed = fold, marginals.joint_cost(fold)
        return self._agreed[1]

    def _agreement_without(self, robots: Collection[str]) -> Agreement | None:
        fold = self.without(robots).fold
        return marginals.joint_cost(converged(fold, self.settings)) if fold.home else None

    def solved(self) -> Fold:
        """The full solution of everything that is there, without whom it convicts."""
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
            fold = self._with_tick(fold, tick)
        return fold

    def _open_ticks(self) -> list[int]:
        """The ticks that are not taken yet and have a submap of a robot that is not withdrawn."""
        last, gone = self._taken[-1].tick if self._taken else -math.inf, self._gone
        return sorted(
            tick
            for tick, members in self._ticks.items()
            if tick > last and any(key[1] not in gone for key in members)
        )

    def _with_tick(self, fold: Fold, tick: int) -> Fold:
        """The fold with all of a tick; members beyond the bounds are refused before the others."""
        gone = self._gone
        order = sorted(key for key in self._ticks[tick] if key[1] not in gone)
        members = [self._ticks[tick][key] for key in order]
        outside = {}
        for each in members:
            why = submap_beyond(each.local, self._config.bounds)
            if why is not None:
                outside[each.key] = why
        sightings, starts, set_aside = [], [], []
        for sighting in (each for key in order for each in self._sightings[key]):
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
        news = Tick(members, sightings, starts, outside, tuple(set_aside))
        return taken(fold, news, self.settings)

    def digest(self, fold: Fold, *more: bytes) -> bytes:
        """The name of the fold's set: starts and submaps in canonical order, and `more`."""
        starts = [
            translate.digest_of(
                robot.encode(),
                incarnation.to_bytes(8, "little"),
                start.pose.tobytes(),
                b"" if start.covariance is None else start.covariance.tobytes(),
            )
            for (robot, incarnation), start in sorted(self._starts.items())
            if (robot, incarnation) in fold.home
        ]
        keys = [*(c.key for c in fold.contributions), *fold.refused]
        members = [self._digests[key] for key in sorted(keys)]
        gone = [f"without {robot}".encode() for robot in self.withdrawn]
        return translate.digest_of(*more, *gone, *starts, *members)

    def members(self, fold: Fold) -> Mapping[Stream, int]:
        """The version vector: the last sequence of each stream that was taken or refused."""
        last = {stream: fold.next_sequence(stream) - 1 for stream in fold.home}
        for _, robot, incarnation, sequence in fold.refused:
            last[robot, incarnation] = max(last.get((robot, incarnation), -1), sequence)
        return {stream: last[stream] for stream in sorted(last)}
