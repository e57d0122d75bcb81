"""The fold over the set in its canonical order, by ticks of team time, with its checkpoints.

Tick b takes the submaps that end in (b·tick, (b + 1)·tick]. Behind the watermark every submap of a
tick is there, so the fold is final; what comes late rolls it back to the checkpoint before.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence

from central.config import CentralConfig
from team import translate
from team.estimation.joining import (
    EMPTY_FOLD,
    Contribution,
    Fold,
    JoinSettings,
    Sighting,
    folded,
    lean,
    started,
)
from team.estimation.joining import Start as StartValue
from team.wire.messages import SightingFactor, Submap

Stream = tuple[str, int]


def join_settings(config: CentralConfig) -> JoinSettings:
    """The join's settings in a centre's configuration."""
    return JoinSettings(
        iterations_per_tick=config.gauss_newton_per_tick,
        robust_c=config.robust_c,
        covariance_factor=config.covariance_factor,
        bias_sigma={
            "bearing": config.bias_sigma.bearing,
            "forward_scale": config.bias_sigma.forward_scale,
            "range_scale": config.bias_sigma.range_scale,
        },
    )


class TickFold:
    """Holds the contributions by tick and the fold after each tick that has been taken."""

    def __init__(self, config: CentralConfig) -> None:
        self._config = config
        self.settings = join_settings(config)
        self._withdrawn: set[str] = set()
        self._tick_ns = round(config.tick_s * 1e9)
        self._ticks: dict[int, dict[tuple[int, str, int, int], Contribution]] = defaultdict(dict)
        self._sightings: dict[tuple[int, str, int, int], list[Sighting]] = {}
        self._digests: dict[tuple[int, str, int, int], bytes] = {}
        self._starts: dict[Stream, StartValue] = {}
        self._taken: list[tuple[int, Fold]] = []

    def know_start(self, start: StartValue) -> None:
        """Where a stream starts; to be told before its first submap is added."""
        self._starts[(start.robot, start.epoch)] = start

    def add(self, submap: Submap, digest: bytes, sightings: Sequence[SightingFactor] = ()) -> None:
        """Put a submap in its tick, with the sightings from it, all of which `digest` names.

        The fold goes back to before that tick if it was taken.
        """
        if submap.robot in self._withdrawn:
            return
        contribution = translate.contribution_of(submap)
        tick = self._tick_of(submap.stamp_ns)
        self._ticks[tick][contribution.key] = contribution
        self._sightings[contribution.key] = [
            translate.sighting_of(each)
            for each in sightings
            if each.teammate not in self._withdrawn
        ]
        self._digests[contribution.key] = digest
        self._roll_back(tick)

    def withdraw(self, robot: str) -> None:
        """Forget a robot's submaps, and the sightings by it or of it, now and in future.

        What is left is what there would be had the robot never been; the fold goes back to the
        checkpoint before it first said something, or was first seen, and takes the ticks again.
        """
        if robot in self._withdrawn:
            return
        self._withdrawn.add(robot)
        until_ns = (self._taken[-1][0] + 1) * self._tick_ns if self._taken else -math.inf
        for tick in sorted(self._ticks):
            touched = [key for key in [*self._ticks[tick]] if self._forget(tick, key, robot)]
            if touched:
                self._roll_back(tick)
            if not self._ticks[tick]:
                del self._ticks[tick]
        self.take_until(until_ns)

    def _forget(self, tick: int, key: tuple[int, str, int, int], robot: str) -> bool:
        """Whether the robot had to do with this submap."""
        if key[1] == robot:
            del self._ticks[tick][key], self._sightings[key], self._digests[key]
            return True
        kept = [each for each in self._sightings[key] if each.teammate != robot]
        touched = len(kept) < len(self._sightings[key])
        self._sightings[key] = kept
        return touched

    def without(self, robots: Collection[str]) -> "TickFold":
        """Another one of the same submaps without some robots' that has taken the same ticks."""
        other = TickFold(self._config)
        other._ticks = defaultdict(dict, {t: dict(found) for t, found in self._ticks.items()})
        other._sightings, other._digests = dict(self._sightings), dict(self._digests)
        other._starts, other._withdrawn = dict(self._starts), set(self._withdrawn)
        for robot in robots:
            other.withdraw(robot)
        other.take_until((self._taken[-1][0] + 1) * self._tick_ns if self._taken else -math.inf)
        return other

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the team goes on without."""
        return tuple(sorted(self._withdrawn))

    def _roll_back(self, tick: int) -> None:
        while self._taken and self._taken[-1][0] >= tick:
            self._taken.pop()

    def _tick_of(self, end_ns: int) -> int:
        return (end_ns - 1) // self._tick_ns

    @property
    def fold(self) -> Fold:
        """The fold over the ticks that have been taken."""
        return self._taken[-1][1] if self._taken else EMPTY_FOLD

    def take_until(self, watermark_ns: float) -> bool:
        """Take every tick that ends at the watermark or before; True if there was one."""
        taken = False
        for tick in self._open_ticks():
            if (tick + 1) * self._tick_ns > watermark_ns:
                break
            taken_fold = self._with_tick(self.fold, tick)
            if self._taken:
                self._taken[-1] = (self._taken[-1][0], lean(self._taken[-1][1]))
            self._taken.append((tick, taken_fold))
            taken = True
        return taken

    def provisional(self) -> Fold:
        """The fold over everything that is there, ahead of the watermark too."""
        fold = self.fold
        for tick in self._open_ticks():
            fold = self._with_tick(fold, tick)
        return fold

    def _open_ticks(self) -> list[int]:
        last = self._taken[-1][0] if self._taken else None
        return sorted(tick for tick in self._ticks if last is None or tick > last)

    def _with_tick(self, fold: Fold, tick: int) -> Fold:
        members = self._ticks[tick]
        for key in sorted(members):
            stream = members[key].stream
            if members[key].sequence == 0 and stream in self._starts:
                fold = started(fold, self._starts[stream])
        order = sorted(members)
        sightings = [each for key in order for each in self._sightings[key]]
        return folded(fold, [members[key] for key in order], self.settings, sightings)

    def digest(self, fold: Fold, *more: bytes) -> bytes:
        """The name of the fold's set: starts and submaps in canonical order, and `more`."""
        starts = [
            translate.digest_of(
                robot.encode(),
                epoch.to_bytes(8, "little"),
                start.pose.tobytes(),
                b"" if start.covariance is None else start.covariance.tobytes(),
            )
            for (robot, epoch), start in sorted(self._starts.items())
            if (robot, epoch) in fold.home
        ]
        members = [self._digests[c.key] for c in fold.contributions]
        gone = [f"without {robot}".encode() for robot in self.withdrawn]
        return translate.digest_of(*more, *gone, *starts, *members)

    def members(self, fold: Fold) -> Mapping[Stream, int]:
        """The version vector: the last sequence of each stream in the fold."""
        return {stream: fold.next_sequence(stream) - 1 for stream in sorted(fold.home)}
