"""The inputs of a fold: submaps in canonical order, initial poses and verdicts.

They only grow, except for verdicts, and serve several folds. A contribution is several times as
large as its message, so it is decoded on demand and cached while some fold has it.
"""

import math
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple
from weakref import WeakValueDictionary

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.survey import station, survey_of
from teamslam.team import translate
from teamslam.team.config import GNSS, SURVEY
from teamslam.team.estimation import plausibility
from teamslam.team.estimation.association.landmark_sets import Verdict
from teamslam.team.estimation.contribution import (
    NO_OWN,
    Contribution,
    InitialPoseFactor,
    OwnBiases,
    Stream,
    is_map,
    named,
)
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.joining import Fold, Tick
from teamslam.team.estimation.map_joining.relinearising import restore_submaps
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import Digest, digest_of
from teamslam.team.wire.messages import MOST_SAVED, SightingFactor, Submap

Key = tuple[int, str, int, int]
"""(end [ns], robot, incarnation, sequence) of a submap; its order is the canonical one."""
STORED_DIGESTS = 4


class _Filed(NamedTuple):
    """A submap, measurements from it, digest of both, and the own errors in a saved map."""

    submap: Submap
    sightings: Sequence[InterRobotFactor]
    digest: bytes
    own: OwnBiases = NO_OWN


class FoldInputs:
    """The set of a fold. Tick b has the submaps that end in (b·tick, (b + 1)·tick]."""

    def __init__(self, config: CentralConfig) -> None:
        self.tick_ns = round(config.tick_s * 1e9)
        self._config = config
        self._bounds_of_map = msgspec.structs.replace(
            config.bounds, submap_landmarks=MOST_SAVED, extent_m=config.bounds.coordinate_m
        )
        self._raised: set[Key] = set()
        self._filed: dict[Key, _Filed] = {}
        self._order: list[Key] = []
        self._made: WeakValueDictionary[Key, Contribution] = WeakValueDictionary()
        self._named: dict[tuple[bytes, ...], tuple[float, Digest]] = {}
        self._starts: dict[Stream, InitialPoseFactor] = {}
        self._verdicts: set[Verdict] = set()
        self._tick_with: dict[tuple[str, int, int], int] = {}
        self._has_station = False
        if config.surveyed:
            self._add_known(*survey_of(config.surveyed))

    def add_start(self, start: InitialPoseFactor) -> None:
        """Add a stream's initial pose, before its submaps."""
        self._starts[(start.robot, start.incarnation)] = start

    def add_submap(
        self,
        submap: Submap,
        digest: bytes,
        sightings: Sequence[SightingFactor],
        own: OwnBiases = NO_OWN,
    ) -> int:
        """Add a submap, and with the first fix the station; return the first tick that this
        changes.
        """
        factors = [translate.sighting_of(each) for each in sightings]
        tick = self._file(_Filed(submap, factors, digest, own))
        if not self._has_station and any(each.teammate == GNSS for each in sightings):
            self._has_station = True
            tick = min(tick, self._add_known(*station()))
        return tick

    def _add_known(self, submap: Submap, start: InitialPoseFactor) -> int:
        self.add_start(start)
        return self._file(_Filed(submap, (), digest_of(encoded(submap))))

    def _file(self, filed: _Filed) -> int:
        submap = filed.submap
        key = (submap.stamp_ns, submap.robot, submap.incarnation, submap.sequence)
        if key not in self._filed:
            insort(self._order, key)
        self._filed[key] = filed
        self._made.pop(key, None)
        self._raised.discard(key)
        tick = self._tick_with[key[1:]] = self._tick_of(key)
        self._named = {at: each for at, each in self._named.items() if each[0] < tick}
        return tick

    def _tick_of(self, key: Key) -> int:
        return (key[0] - 1) // self.tick_ns

    def set_verdicts(self, verdicts: Collection[Verdict]) -> float:
        """Replace the verdicts; return the first tick that judges a changed one, else infinity."""
        changed = self._verdicts.symmetric_difference(verdicts)
        self._verdicts = set(verdicts)
        ticks = (self._tick_judging(each) for each in changed)
        return min((tick for tick in ticks if tick is not None), default=math.inf)

    def _tick_judging(self, verdict: Verdict) -> int | None:
        """Return the first tick with both landmarks' submaps."""
        ticks = [self._tick_with.get(each[:3]) for each in verdict[:2]]
        known = [tick for tick in ticks if tick is not None]
        return max(known) if len(known) == len(ticks) else None

    # Ticks.

    @property
    def robots(self) -> set[str]:
        """The robots and saved maps with a submap, but for the survey and the station."""
        return {robot for _, robot, *_ in self._order} - {SURVEY, GNSS}

    def keys(
        self, after: float, last: float = math.inf, without: Collection[str] = ()
    ) -> list[Key]:
        """List the submaps in the ticks (after, last] without some robots."""
        begin, end = (
            len(self._order)
            if tick == math.inf
            else bisect_left(self._order, (tick + 1) * self.tick_ns + 1, key=_end_ns)
            for tick in (after, last)
        )
        return [key for key in self._order[begin:end] if key[1] not in without]

    def ticks_after(self, after: float, without: Collection[str]) -> list[int]:
        """List the later ticks with a submap of any other robot."""
        return list(dict.fromkeys(map(self._tick_of, self.keys(after, without=without))))

    def first_tick_of(self, robot: str) -> float:
        """Return the first tick with a submap or a measurement of a robot, else infinity."""
        for key in self._order:
            if key[1] == robot or any(
                each.teammate == robot for each in self._filed[key].sightings
            ):
                return self._tick_of(key)
        return math.inf

    def contribution(self, key: Key) -> Contribution:
        """Decode a submap, its covariance raised to the least; a saved map's contains the factor
        already.
        """
        found = self._made.get(key)
        if found is None:
            filed = self._filed[key]
            found = translate.contribution_of(filed.submap)
            local, own = found.local, filed.own
            if is_map(found.stream):
                if own.errors:
                    local, by_own = own.given(local)
                    found = replace(found, own=own, by_own=by_own)
                factor = self._config.covariance_factor
                local = replace(local, covariance=local.covariance / factor)
            else:
                local = plausibility.with_least_spread(local, self._config.least_sigma)
                if local is not found.local:
                    self._raised.add(key)
            found = found if local is found.local else replace(found, local=local)
            self._made[key] = found
        return found

    def raised(self, without: Collection[str]) -> Mapping[str, int]:
        """Count, by robot, the decoded submaps of raised covariance."""
        return Counter(sorted(key[1] for key in self._raised if key[1] not in without))

    def chains(self, robot: str) -> Mapping[Stream, Sequence[Contribution]]:
        """Return the submaps of each of a robot's streams within the bounds."""
        found: dict[Stream, list[Contribution]] = {}
        for key in self._order:
            if key[1] == robot and self._beyond(each := self.contribution(key)) is None:
                found.setdefault(each.stream, []).append(each)
        return found

    def _beyond(self, submap: Contribution) -> str | None:
        bounds = self._bounds_of_map if is_map(submap.stream) else self._config.bounds
        return plausibility.submap_beyond(submap.local, bounds)

    def tick(self, tick: int, without: Collection[str]) -> Tick:
        """Return the members of a tick without some robots, and those refused beyond the bounds."""
        order = self.keys(tick - 1, tick, without)
        submaps = [self.contribution(key) for key in order]
        outside = {}
        for each in submaps:
            why = self._beyond(each)
            if why is not None:
                outside[each.key] = why
        sightings, set_aside = self._sightings_of(order, without)
        starts = []
        first = (m.stream for m in submaps if m.sequence == 0 and m.stream in self._starts)
        for start in (self._starts[stream] for stream in first):
            why = plausibility.start_beyond(start, self._config.bounds)
            if why is None:
                starts.append(start)
            else:
                of = named(start.stream)
                set_aside.append(f"the initial pose of {of} refused, taken as unknown: {why}")
        verdicts = sorted(
            v
            for v in self._verdicts
            if self._tick_judging(v) == tick and not {v.first.robot, v.second.robot} & {*without}
        )
        return Tick(submaps, sightings, starts, outside, tuple(set_aside), tuple(verdicts))

    def _sightings_of(
        self, order: Sequence[Key], without: Collection[str]
    ) -> tuple[list[InterRobotFactor], list[str]]:
        sightings, refused = [], []
        for sighting in (each for key in order for each in self._filed[key].sightings):
            if sighting.teammate in without:
                continue
            why = plausibility.sighting_beyond(sighting, self._config.bounds)
            if why is None:
                sightings.append(sighting)
            else:
                of = f"{sighting.teammate} by {named(sighting.stream)}"
                refused.append(f"an inter-robot measurement of {of} refused: {why}")
        return sightings, refused

    def restore_submaps(self, fold: Fold, last: float, without: Collection[str]) -> Fold:
        """Restore the condensed submaps of a fold up to this tick."""
        if not fold.condensed_count:
            return fold
        order = self.keys(-math.inf, last, without)
        submaps = [self.contribution(key) for key in order]
        return restore_submaps(fold, submaps, self._sightings_of(order, without)[0])

    def digest(
        self, fold: Fold, more: Sequence[bytes], closed: float, without: Collection[str]
    ) -> bytes:
        """Digest a fold's set: `more`, the robots left out, initial poses and verdicts, then the
        submaps in canonical order. closed: the last tick worth caching.
        """
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
        gone = [f"without {robot}".encode() for robot in sorted(without)]
        judged = fold.landmarks.verdicts
        verdicts = sorted(f"{v.first} {v.second} {v.same}".encode() for v in judged)
        keys = [*(c.key for c in fold.contributions[-1:]), *fold.refused]
        last = max(map(self._tick_of, keys), default=-math.inf)
        before, closed = (*more, *gone, *starts, *verdicts), min(last, closed)
        until, digest = self._named.pop(before, (math.inf, Digest()))
        if until > closed:
            until, digest = -math.inf, Digest()
            digest.update(*before)
        digest.update(*self._digests_between(until, closed, without))
        self._named[before] = closed, digest
        for oldest in list(self._named)[:-STORED_DIGESTS]:
            del self._named[oldest]
        whole = digest.copy()
        whole.update(*self._digests_between(closed, last, without))
        return whole.value

    def _digests_between(self, after: float, last: float, without: Collection[str]) -> list[bytes]:
        return [self._filed[key].digest for key in self.keys(after, last, without)]


def _end_ns(key: Key) -> int:
    return key[0]
