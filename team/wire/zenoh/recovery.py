"""Request missing publications from their publisher's cache.

Zenoh's advanced subscriber gives some late joiners only a part of the history. A publisher numbers
its publications on a key from 0 and repeats the last number in its heartbeats, so the arrivals are
counted and gaps older than half a second are requested (docs/decisions/07-delivery-by-counts.md). A
team of 100 robots, each restarted 30 times, is within the bounds.
"""

import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Generic, TypeVar

import zenoh
from zenoh.handlers import Callback

from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import row_of
from teamslam.team.wire.intervals import LONGEST_S, PATIENCE_S, IntervalSet
from teamslam.team.wire.logs import LOG

ADVANCED = "/@adv/pub/"  # part of the keys of advanced publishers' heartbeats
_BEAT = struct.Struct("<I")  # payload of a heartbeat: the number of the last publication
_LOOK_S = 0.1  # interval of the checks for missing samples
_ANSWER_S = 10.0
_SEVERAL = ""  # replaces a publisher's key: its samples arrived on several
MOST_OF_A_NODE = 4_096  # most tracked publishers on the keys of one node, each on one key
MOST_PUBLISHERS = 131_072  # most tracked publishers in all: some 100 MB
MOST_BEATS = 131_072  # most stored heartbeats; then they are cleared
LONGEST_KEY = 512  # longest key [characters] on which missing samples are requested
MOST_ASKED = 256  # most cache requests in one check

_UNTRACKED = "%.80s: too many publishers there, what is missing is not requested (%d so far)"
DELAY_S = 2.0  # longest delay [s] of publications after a gap
MOST_GAPS = 4096  # most gaps per publisher and key; then the oldest is given up
T = TypeVar("T")
Work = Callable[[], list[Sample]]
"""Work of Zenoh's threads for the receiving one, which delivers the samples that it returns."""


@dataclass
class Arrivals(Generic[T]):
    """Publications of one publisher on one key; those before `first` are not requested.

    in_order: delay publications after a gap until it is closed or overdue. newest: last number
    received.
    """

    first: int
    in_order: bool = True
    newest: int = -1
    _settled: IntervalSet = field(default_factory=IntervalSet, init=False)
    """Numbers from `first` on that arrived or are gone."""
    _gone: IntervalSet = field(default_factory=IntervalSet, init=False)
    """Numbers that the publisher no longer has, and gaps given up."""
    _delayed: dict[int, T] = field(default_factory=dict, init=False)
    _since_s: float | None = field(default=None, init=False)
    _due_s: float = field(default=0.0, init=False)
    _asked: int = field(default=0, init=False)
    _loose: bool = field(default=False, init=False)

    def take(self, number: int, item: T) -> list[T]:
        """Record an arrival; return the items to deliver now, none for a duplicate."""
        if number < self.first:  # not requested: Zenoh delivers it once
            return [item]
        if number in self._settled:
            return []
        if number <= self.newest:
            self._since_s = None  # a gap closes: its age starts anew
        self.newest = max(self.newest, number)
        self._settled.add(number, number)
        if len(self._settled) > MOST_GAPS:
            self._give_up(*self._open()[0])
        if self._loose or not self.in_order:
            return [item]
        self._delayed[number] = item
        return self._release(self._whole)

    def know(self, newest: int) -> None:
        """Record the last number of a heartbeat."""
        self.newest = max(self.newest, newest)

    @property
    def missing(self) -> tuple[int, int] | None:
        """First and last missing number."""
        last = self._settled.last_absent(self.newest)
        return (self._whole, last) if last >= self._whole else None

    @property
    def missing_intervals(self) -> list[tuple[int, int]]:
        """Missing intervals, first those that the publisher no longer has."""
        return [*self._gone, *self._open()]

    def due(self, now_s: float) -> tuple[int, int | None] | None:
        """Return the interval to request now, if a gap is old enough; end None: everything since.

        A repeated request is for everything: a reply without the missing numbers shows that they
        are gone.
        """
        missing = self.missing
        if missing is None:
            self._since_s, self._loose = None, False
            return None
        if self._since_s is None:
            self._since_s, self._asked = now_s, 0
            self._due_s = now_s + PATIENCE_S
        if now_s < self._due_s:
            return None
        self._asked += 1
        self._due_s = now_s + min(PATIENCE_S * 2.0**self._asked, LONGEST_S)
        return missing if self._asked == 1 else (missing[0], None)

    def overdue(self, now_s: float) -> list[T]:
        """Release the items of an overdue gap; until it closes none are delayed."""
        if self._since_s is None or now_s - self._since_s < DELAY_S:
            return []
        self._loose = True
        return self._release(self.newest + 1)

    def take_answer(self, first: int, newest: int, known: int | None = None) -> list[T]:
        """Record the complete reply for `first` to `newest`; return the items to deliver.

        Numbers still missing are gone. known: the last number at the request; if it exceeds the
        publisher's and nothing newer arrived, it was that of another key, as after a cut link.
        """
        for begin, end in self._open():
            self._give_up(max(begin, first), min(end, newest))
        if self.newest == known:
            self.newest = max(newest, self._settled.last)
        return self._release(self._whole)

    @property
    def _whole(self) -> int:
        """First number that neither arrived nor is gone."""
        return self._settled.next_absent(self.first)

    def _give_up(self, first: int, last: int) -> None:
        self._gone.add(first, last)
        self._gone.join_first(MOST_GAPS)
        self._settled.add(first, last)

    def _open(self) -> list[tuple[int, int]]:
        return self._settled.gaps(self.first, self.newest)

    def _release(self, end: int) -> list[T]:
        return [self._delayed.pop(n) for n in sorted(n for n in self._delayed if n < end)]


class Recovery:
    """Recovery for one session. Zenoh's threads call `admit` and `put`, one thread its methods."""

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        admit: Callable[[zenoh.Sample], None],
        put: Callable[[Work], None],
    ) -> None:
        self._session = session
        self._prefix = prefix
        self._admit = admit
        self._put = put
        self._whole: set[str] = set()
        self._beats: dict[str, bytes] = {}
        self._arrivals: dict[tuple[str, str], Arrivals[Sample]] = {}
        self._incomplete: set[tuple[str, str]] = set()
        self._tracked: Counter[str] = Counter()
        self._keys: dict[str, str] = {}
        self._look_due = 0.0
        self.untracked = 0  # number of samples and heartbeats of publishers beyond the bounds

    def watch(self, key: str) -> None:
        """Subscribe to the heartbeats of a key (with the session's prefix)."""
        self._session.declare_subscriber(
            f"{key}{ADVANCED}**",
            Callback(self._beat, indirect=False),
            allowed_origin=zenoh.Locality.REMOTE,
        )

    def take_whole(self, channel: str) -> None:
        """Request all samples that publishers of this `latest` channel still have."""
        self._whole.add(channel)

    def _beat(self, sample: zenoh.Sample) -> None:
        """Pass on a heartbeat with a new number; called on Zenoh's receiving thread."""
        name, beat = str(sample.key_expr), sample.payload.to_bytes()
        sound = len(beat) == _BEAT.size and len(name) <= LONGEST_KEY
        if sound and self._beats.get(name) != beat:
            if len(self._beats) >= MOST_BEATS:
                self._beats.clear()
            self._beats[name] = beat
            key, _, rest = name.removeprefix(self._prefix).partition(ADVANCED)
            publisher = "/".join(rest.split("/")[:2])
            if publisher:
                self._put(partial(self.take_heartbeat, key, publisher, *_BEAT.unpack(beat)))

    def take_heartbeat(self, key: str, publisher: str, newest: int) -> list[Sample]:
        """Record a publisher's last number; no effect for a publisher of another key."""
        if self._keys.get(publisher, key) in (key, _SEVERAL):
            arrivals = self._arrivals_of(key, publisher, newest)
            if arrivals is not None:
                arrivals.know(newest)
                self._incomplete.add((key, publisher))
        return []

    def _take_answer(
        self, key: str, publisher: str, known: int, first: int, newest: int
    ) -> list[Sample]:
        arrivals = self._arrivals.get((key, publisher))
        if arrivals is None:  # forgotten since
            return []
        if newest < arrivals.newest:
            self._beats.clear()  # the next heartbeats count as new
        return arrivals.take_answer(first, newest, known)

    def take_sample(self, sample: Sample, source: zenoh.SourceInfo) -> list[Sample]:
        """Record a received publication; return the samples to deliver now, in order."""
        publisher, number = _read_source(source)
        arrivals = self._arrivals_of(sample.key, publisher, number)
        if arrivals is None:
            return [sample]
        if self._keys.setdefault(publisher, sample.key) != sample.key:
            self._keys[publisher] = _SEVERAL
        delivered = arrivals.take(number, sample)
        if arrivals.missing is not None:
            self._incomplete.add((sample.key, publisher))
        return delivered

    def _arrivals_of(self, key: str, publisher: str, first_known: int) -> Arrivals[Sample] | None:
        """Return the arrivals of one publisher on one key; None beyond the bounds."""
        found = self._arrivals.get((key, publisher))
        if found is None:
            row = row_of(key)
            if row is None or len(key) > LONGEST_KEY:
                return None
            node = _node_of(key)
            if self._tracked[node] >= MOST_OF_A_NODE or len(self._arrivals) >= MOST_PUBLISHERS:
                self.untracked += 1
                LOG.warning(_UNTRACKED, key, self.untracked)
                return None
            whole = row.delivery == "all" or row.name in self._whole
            found = Arrivals(0 if whole else first_known, in_order=whole)
            self._arrivals[key, publisher] = found
            self._tracked[node] += 1
        return found

    def overdue(self, now_s: float) -> list[Sample]:
        """Request missing samples; return those that are no longer delayed by a gap."""
        if now_s < self._look_due or not self._incomplete:
            return []
        self._look_due = now_s + _LOOK_S
        late: list[Sample] = []
        asked = 0
        for key, publisher in sorted(self._incomplete):
            arrivals = self._arrivals[key, publisher]
            requested = arrivals.due(now_s) if asked < MOST_ASKED else None
            if arrivals.missing is None:
                self._incomplete.discard((key, publisher))
            elif requested is not None:
                self._ask_cache(key, publisher, arrivals.newest, *requested)
                asked += 1
            late += arrivals.overdue(now_s)
        return late

    def _ask_cache(
        self, key: str, publisher: str, known: int, first: int, last: int | None
    ) -> None:
        newest, failed = -1, False

        def take(reply: zenoh.Reply) -> None:
            nonlocal newest, failed
            if reply.ok is None:
                failed = True
            elif reply.ok.source_info is not None:
                author, number = _read_source(reply.ok.source_info)
                if author == publisher:
                    newest = max(newest, number)
                self._admit(reply.ok)

        def end() -> None:
            if last is None and newest >= 0 and not failed:
                self._put(partial(self._take_answer, key, publisher, known, first, newest))

        until = "" if last is None else str(last)
        LOG.info("%.80s: %d to %s are missing, asked for", key, first, until or "the newest")
        self._session.get(
            f"{self._prefix}{key}{ADVANCED}{publisher}/**?_anyke;_sn={first}..{until}",
            Callback(take, drop=end, indirect=False),
            timeout=_ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            target=zenoh.QueryTarget.ALL,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def redeliver(self) -> None:
        """Request and deliver all samples of `all` channels and whole subscriptions again."""
        self._arrivals.clear()
        self._tracked.clear()
        self._keys.clear()
        self._incomplete.clear()
        self._beats.clear()  # the next heartbeats count as new

    def find_awaited(self) -> set[str]:
        """Return the keys with missing samples that their publisher may still have."""
        return {
            key
            for key, publisher in self._incomplete
            if self._arrivals[key, publisher].missing is not None
        }

    def find_missing(self) -> dict[str, list[tuple[int, int]]]:
        """Return the missing samples, available or not: by key, intervals of a publisher's
        counters.
        """
        found: dict[str, list[tuple[int, int]]] = {}
        for (key, _), arrivals in sorted(self._arrivals.items()):
            if intervals := arrivals.missing_intervals:
                found.setdefault(key, []).extend(intervals)
        return found


def _node_of(key: str) -> str:
    first, _, rest = key.partition("/")
    return f"{first}/{rest.partition('/')[0]}" if first in ("robot", "source") else first


def _read_source(info: zenoh.SourceInfo) -> tuple[str, int]:
    return f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn
