"""The inputs of a fold by ticks of team time: submaps, initial poses and verdicts.

They only grow, except for verdicts, and depend on no fold: a fold without some robots reads the
same inputs. A contribution is several times as large as its message, so it is decoded on demand and
cached while some fold has it.
"""

import math
from bisect import insort
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from weakref import WeakValueDictionary

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.survey import station, survey_of
from teamslam.team import translate
from teamslam.team.config import GNSS
from teamslam.team.estimation.association.landmark_sets import Verdict
from teamslam.team.estimation.contribution import (
    NO_OWN,
    Contribution,
    OwnBiases,
    Stream,
    is_map,
    named,
)
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.joining import Fold, InitialPoseFactor, Tick
from teamslam.team.estimation.map_joining.relinearising import restore_submaps
from teamslam.team.estimation.plausibility import (
    sighting_beyond,
    start_beyond,
    submap_beyond,
    with_least_spread,
)
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import Digest, digest_of
from teamslam.team.wire.messages import MOST_SAVED, SightingFactor, Submap

Key = tuple[int, str, int, int]
STORED_DIGESTS = 4


class FoldInputs:
    """The set of submaps by ticks, with their inter-robot measurements and the digests of both,
    initial poses and an operator's verdicts.

    Tick b has the submaps that end in (b·tick, (b + 1)·tick].
    """

    def __init__(self, config: CentralConfig) -> None:
        self.robots: set[str] = set()
        self.tick_ns = round(config.tick_s * 1e9)
        self._config = config
        self._bounds_of_map = msgspec.structs.replace(
            config.bounds, submap_landmarks=MOST_SAVED, extent_m=config.bounds.coordinate_m
        )
        self._raised: set[Key] = set()
        self._ticks: dict[int, dict[Key, Submap]] = {}
        self._order: list[int] = []
        self._sightings: dict[Key, tuple[InterRobotFactor, ...]] = {}
        self._digests: dict[Key, bytes] = {}
        self._own: dict[Key, OwnBiases] = {}
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
        """Add a submap with the inter-robot measurements from it; return the first tick that this
        changes. own: the errors of single robots in a saved map.

        The first fix adds the station, before all of the team's time.
        """
        key = (submap.stamp_ns, submap.robot, submap.incarnation, submap.sequence)
        tick = self._file(key, submap, digest)
        if sightings:
            self._sightings[key] = tuple(translate.sighting_of(each) for each in sightings)
        if own.errors:
            self._own[key] = own
        self.robots.add(submap.robot)
        self._tick_with[key[1:]] = tick
        if not self._has_station and any(each.teammate == GNSS for each in sightings):
            self._has_station = True
            tick = min(tick, self._add_known(*station()))
        return tick

    def _add_known(self, submap: Submap, start: InitialPoseFactor) -> int:
        self.add_start(start)
        key = (submap.stamp_ns, submap.robot, submap.incarnation, submap.sequence)
        return self._file(key, submap, digest_of(encoded(submap)))

    def _file(self, key: Key, submap: Submap, digest: bytes) -> int:
        tick = self._tick_of(submap.stamp_ns)
        if tick not in self._ticks:
            self._ticks[tick] = {}
            insort(self._order, tick)
        self._ticks[tick][key] = submap
        self._digests[key] = digest
        self._made.pop(key, None)
        self._raised.discard(key)
        self._named = {at: each for at, each in self._named.items() if each[0] < tick}
        return tick

    def _tick_of(self, end_ns: int) -> int:
        return (end_ns - 1) // self.tick_ns

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

    def ticks_after(
        self, after: float, without: Collection[str] = (), last: float = math.inf
    ) -> list[int]:
        """List the ticks in (after, last] with a submap of any other robot, ascending."""
        found = []
        for tick in reversed(self._order):
            if tick <= after:
                break
            if tick <= last and any(key[1] not in without for key in self._ticks[tick]):
                found.append(tick)
        return found[::-1]

    def first_tick_of(self, robot: str) -> float:
        """Return the first tick with a submap or an inter-robot measurement of a robot, else
        infinity.
        """
        for tick in self._order:
            for key in self._ticks[tick]:
                sightings = self._sightings.get(key, ())
                if key[1] == robot or any(each.teammate == robot for each in sightings):
                    return tick
        return math.inf

    def keys(self, tick: int, without: Collection[str]) -> list[Key]:
        """List the submaps of a tick without some robots, in canonical order."""
        return sorted(key for key in self._ticks[tick] if key[1] not in without)

    def contribution(self, key: Key) -> Contribution:
        """Decode a submap, its covariance raised to the least; that of a saved map without the
        factor on the covariances of submaps, which it contains.
        """
        found = self._made.get(key)
        if found is None:
            found = translate.contribution_of(self._ticks[self._tick_of(key[0])][key])
            local = found.local
            if is_map(found.stream):
                own = self._own.get(key, NO_OWN)
                if own.errors:
                    local, by_own = own.given(local)
                    found = replace(found, own=own, by_own=by_own)
                factor = self._config.covariance_factor
                local = replace(local, covariance=local.covariance / factor)
            else:
                local = with_least_spread(local, self._config.least_sigma)
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
        for tick in self._order:
            for key in self.keys(tick, ()):
                if key[1] == robot:
                    each = self.contribution(key)
                    if self._beyond(each) is None:
                        found.setdefault(each.stream, []).append(each)
        return found

    def _beyond(self, submap: Contribution) -> str | None:
        bounds = self._bounds_of_map if is_map(submap.stream) else self._config.bounds
        return submap_beyond(submap.local, bounds)

    def tick(self, tick: int, without: Collection[str]) -> Tick:
        """Return the members of a tick without some robots' submaps and measurements of these;
        refuse those beyond the bounds.
        """
        order = self.keys(tick, without)
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
            why = start_beyond(start, self._config.bounds)
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
        for sighting in (each for key in order for each in self._sightings.get(key, ())):
            if sighting.teammate in without:
                continue
            why = sighting_beyond(sighting, self._config.bounds)
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
        ticks = self.ticks_after(-math.inf, without, last)
        order = [key for tick in ticks for key in self.keys(tick, without)]
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
        last = max((self._tick_of(key[0]) for key in keys), default=-math.inf)
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
        ticks = self.ticks_after(after, without, last)
        return [self._digests[key] for tick in ticks for key in self.keys(tick, without)]
