"""Track the publications of a publisher: deliver each once and find the missing ones.

A publisher numbers its publications on a key from 0 and repeats the last number in its heartbeats
(docs/decisions/07-delivery-by-counts.md).
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from teamslam.team.wire.intervals import IntervalSet

PATIENCE_S = 0.5  # age [s] at which a gap is requested
LONGEST_S = 8.0  # longest interval [s] between two requests, which double
DELAY_S = 2.0  # longest delay [s] of publications after a gap
MOST_GAPS = 4096  # most gaps per publisher and key; then the oldest is given up
T = TypeVar("T")


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
