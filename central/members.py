"""The members of a fold by ticks of team time: encoded messages, decoded on demand.

A contribution (a decoded submap) is several times as large as its message; it is cached while some
fold has it.
"""

import math
from bisect import insort
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from weakref import WeakValueDictionary

from teamslam.team import translate
from teamslam.team.estimation.contribution import Contribution, is_map
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.plausibility import with_least_spread
from teamslam.team.wire.digest import Digest
from teamslam.team.wire.messages import SightingFactor, Submap

Key = tuple[int, str, int, int]
STORED_DIGESTS = 4


class Members:
    """Submaps by tick, with the inter-robot measurements from them and the digests of both.

    Tick b has the submaps that end in (b·tick, (b + 1)·tick].
    """

    def __init__(
        self, tick_ns: int, least_sigma: tuple[float, float] = (0.0, 0.0), factor: float = 1.0
    ) -> None:
        """File members. factor: the join's on the covariances of submaps, which a saved map's
        covariance contains.
        """
        self.tick_ns = tick_ns
        self._factor = factor
        self._least_sigma = least_sigma
        self._raised: set[Key] = set()
        self._ticks: dict[int, dict[Key, Submap]] = {}
        self._order: list[int] = []
        self._sightings: dict[Key, tuple[InterRobotFactor, ...]] = {}
        self._digests: dict[Key, bytes] = {}
        self._made: WeakValueDictionary[Key, Contribution] = WeakValueDictionary()
        self._named: dict[tuple[bytes, ...], tuple[float, Digest]] = {}

    def add(self, submap: Submap, digest: bytes, sightings: Sequence[SightingFactor]) -> int:
        """File a submap, named by `digest`, with the `sightings` from it; return its tick."""
        key = (submap.stamp_ns, submap.robot, submap.incarnation, submap.sequence)
        tick = self.tick_of(submap.stamp_ns)
        if tick not in self._ticks:
            self._ticks[tick] = {}
            insort(self._order, tick)
        self._ticks[tick][key] = submap
        self._digests[key] = digest
        if sightings:
            self._sightings[key] = tuple(translate.sighting_of(each) for each in sightings)
        self._made.pop(key, None)
        self._raised.discard(key)
        self._named = {at: each for at, each in self._named.items() if each[0] < tick}
        return tick

    def tick_of(self, end_ns: int) -> int:
        """Return the tick of a submap that ends at this time."""
        return (end_ns - 1) // self.tick_ns

    def behind(self, after: float, last: float = math.inf) -> list[int]:
        """List the ticks with members after this one, up to the last, ascending."""
        found = []
        for tick in reversed(self._order):
            if tick <= after:
                break
            if tick <= last:
                found.append(tick)
        return found[::-1]

    def has(self, tick: int, gone: Collection[str]) -> bool:
        """Whether a tick has a submap of a robot that is not withdrawn."""
        return any(key[1] not in gone for key in self._ticks[tick])

    def keys(self, tick: int, gone: Collection[str]) -> list[Key]:
        """List the submaps of a tick in canonical order, without withdrawn robots."""
        return sorted(key for key in self._ticks[tick] if key[1] not in gone)

    def contribution(self, key: Key) -> Contribution:
        """Decode a submap, with its covariance raised to the least one."""
        found = self._made.get(key)
        if found is None:
            found = translate.contribution_of(self._ticks[self.tick_of(key[0])][key])
            local = found.local
            if is_map(found.stream):
                local = replace(local, covariance=local.covariance / self._factor)
            else:
                local = with_least_spread(local, self._least_sigma)
                if local is not found.local:
                    self._raised.add(key)
            found = found if local is found.local else replace(found, local=local)
            self._made[key] = found
        return found

    def raised(self, gone: Collection[str]) -> Mapping[str, int]:
        """Count, by robot, the decoded submaps with a raised covariance."""
        robots = sorted(key[1] for key in self._raised if key[1] not in gone)
        return Counter(robots)

    def sightings(self, key: Key) -> tuple[InterRobotFactor, ...]:
        """Return the inter-robot measurements from a submap."""
        return self._sightings.get(key, ())

    def concerns(self, tick: int, robot: str) -> bool:
        """Whether a tick has a submap of a robot or an inter-robot measurement of it."""
        return any(
            key[1] == robot or any(each.teammate == robot for each in self.sightings(key))
            for key in self._ticks[tick]
        )

    def digest(
        self, before: tuple[bytes, ...], closed: float, last: float, gone: Collection[str]
    ) -> bytes:
        """Digest these parts and the members up to a tick, in canonical order.

        The digest of the ticks up to `closed` is cached, by the parts before them.
        """
        until, digest = self._named.pop(before, (math.inf, Digest()))
        if until > closed:
            until, digest = -math.inf, Digest()
            digest.update(*before)
        digest.update(*self._digests_between(until, closed, gone))
        self._named[before] = closed, digest
        for oldest in list(self._named)[:-STORED_DIGESTS]:
            del self._named[oldest]
        whole = digest.copy()
        whole.update(*self._digests_between(closed, last, gone))
        return whole.value

    def _digests_between(self, after: float, last: float, gone: Collection[str]) -> list[bytes]:
        ticks = self.behind(after, last)
        return [self._digests[key] for tick in ticks for key in self.keys(tick, gone)]
