"""Tracks which publications of a publisher have arrived: delivers each once, finds the missing
ones.

A publisher numbers its publications on a key from 0 and repeats the last number in its heartbeats.
A receiver therefore knows of everything that it lacks, at the beginning, in between and at the end,
for as long as the publisher lives: `docs/decisions/07-delivery-by-counts.md`.
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from team.wire.intervals import IntervalSet

PATIENCE_S = 0.5
"""Time [s] for which a publication is missing before it is requested from its publisher."""
LONGEST_S = 8.0
"""Longest interval [s] between two requests; intervals double up to it."""
DELAY_S = 2.0
"""Longest time [s] for which publications after a gap are delayed."""
MOST_GAPS = 4096
"""Largest number of gaps of one publisher on one key; beyond it the oldest gap is given up."""
T = TypeVar("T")


@dataclass
class Arrivals(Generic[T]):
    """The publications of one publisher on one key; those before `first` are not requested.

    All numbers come from the wire, so memory is in proportion to what has arrived, not to them.

    in_order: whether publications after a gap are delayed for a while, until the gap is closed.
    newest: the last number known, from an arrival or a heartbeat.
    """

    first: int
    in_order: bool = True
    newest: int = -1
    _settled: IntervalSet = field(default_factory=IntervalSet, init=False)
    """The numbers from `first` on that have arrived or are gone."""
    _gone: IntervalSet = field(default_factory=IntervalSet, init=False)
    """The numbers that the publisher itself no longer has, and those of gaps that were given up."""
    _delayed: dict[int, T] = field(default_factory=dict, init=False)
    _since_s: float | None = field(default=None, init=False)
    _due_s: float = field(default=0.0, init=False)
    _asked: int = field(default=0, init=False)
    _loose: bool = field(default=False, init=False)

    def take(self, number: int, item: T) -> list[T]:
        """Records an arrival; returns the items to be delivered now, none if it had arrived
        before.
        """
        if number < self.first:  # was not asked for: Zenoh hands it over once
            return [item]
        if number in self._settled:
            return []
        if number <= self.newest:
            self._since_s = None  # a gap closes: patience begins anew
        self.newest = max(self.newest, number)
        self._settled.add(number, number)
        if len(self._settled) > MOST_GAPS:
            self._give_up(*self._open()[0])
        if self._loose or not self.in_order:
            return [item]
        self._delayed[number] = item
        return self._released(self._whole)

    def know(self, newest: int) -> None:
        """Records the last number that a heartbeat of the publisher contained."""
        self.newest = max(self.newest, newest)

    @property
    def missing(self) -> tuple[int, int] | None:
        """The first and the last missing number; some numbers in between may have arrived."""
        last = self._settled.last_absent(self.newest)
        return (self._whole, last) if last >= self._whole else None

    @property
    def lacking(self) -> list[tuple[int, int]]:
        """The intervals that are missing, those that the publisher no longer has first."""
        return [*self._gone, *self._open()]

    def due(self, now_s: float) -> tuple[int, int | None] | None:
        """The interval to be requested now, if a gap has lasted long enough; end None: everything
        since.

        A repeated request is for everything since: the newest is always in the cache, so that a
        reply without the missing numbers shows that they are gone.
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
        """The items delayed too long by a gap, in order; until the gap is closed nothing more is
        delayed.
        """
        if self._since_s is None or now_s - self._since_s < DELAY_S:
            return []
        self._loose = True
        return self._released(self.newest + 1)

    def answered(self, first: int, newest: int, known: int | None = None) -> list[T]:
        """Records that the publisher's reply with all it has from `first` to `newest` is complete.

        What is still missing in that interval is gone; returns the items that it had delayed.
        known: the last number known when it was requested. A larger one than the publisher has,
            and nothing newer since, was that of another key: Zenoh can deliver a heartbeat, too,
            under another key after a cut.
        """
        for begin, end in self._open():
            self._give_up(max(begin, first), min(end, newest))
        if self.newest == known:
            self.newest = max(newest, self._settled.last)
        return self._released(self._whole)

    @property
    def _whole(self) -> int:
        """The first number from `first` on that has not arrived and is not gone."""
        return self._settled.next_absent(self.first)

    def _give_up(self, first: int, last: int) -> None:
        """Records the numbers first … last as gone; nothing if last < first."""
        self._gone.add(first, last)
        self._gone.join_first(MOST_GAPS)
        self._settled.add(first, last)

    def _open(self) -> list[tuple[int, int]]:
        return self._settled.gaps(self.first, self.newest)

    def _released(self, end: int) -> list[T]:
        return [self._delayed.pop(n) for n in sorted(n for n in self._delayed if n < end)]
