"""Tracks which publications of a publisher have arrived: delivers each once, finds the missing
ones.

A publisher numbers its publications on a key from 0 and repeats the last number in its heartbeats.
A receiver therefore knows of everything that it lacks, at the beginning, in between and at the end,
for as long as the publisher lives: `docs/decisions/07-delivery-by-counts.md`.
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

PATIENCE_S = 0.5
"""Time [s] for which a publication is missing before it is requested from its publisher."""
LONGEST_S = 8.0
"""Longest interval [s] between two requests; intervals double up to it."""
DELAY_S = 2.0
"""Longest time [s] for which publications after a gap are delayed."""
T = TypeVar("T")


@dataclass
class Arrivals(Generic[T]):
    """The publications of one publisher on one key; those before `first` are not requested.

    in_order: whether publications after a gap are delayed for a while, until the gap is closed.
    newest: the last number known, from an arrival or a heartbeat.
    gone: intervals that the publisher itself no longer has.
    """

    first: int
    in_order: bool = True
    newest: int = -1
    gone: list[tuple[int, int]] = field(default_factory=list)
    _whole: int = field(init=False)
    _beyond: set[int] = field(default_factory=set, init=False)
    _delayed: dict[int, T] = field(default_factory=dict, init=False)
    _since_s: float | None = field(default=None, init=False)
    _due_s: float = field(default=0.0, init=False)
    _asked: int = field(default=0, init=False)
    _loose: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._whole = self.first

    def take(self, number: int, item: T) -> list[T]:
        """Records an arrival; returns the items to be delivered now, none if it had arrived
        before.
        """
        if number < self.first:  # was not asked for: Zenoh hands it over once
            return [item]
        if number < self._whole or number in self._beyond:
            return []
        if number <= self.newest:
            self._since_s = None  # a gap closes: patience begins anew
        self.newest = max(self.newest, number)
        self._beyond.add(number)
        self._advance()
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
        last = self.newest
        while last >= self._whole and last in self._beyond:
            last -= 1
        return (self._whole, last) if last >= self._whole else None

    @property
    def lacking(self) -> list[tuple[int, int]]:
        """The intervals that are missing, those that the publisher no longer has first."""
        return [*self.gone, *self._open()]

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

    def answered(self, first: int, newest: int) -> list[T]:
        """Records that the publisher's reply with all it has from `first` to `newest` is complete.

        What is still missing in that interval is gone; returns the items that it had delayed.
        """
        for begin, end in self._open():
            lost = (max(begin, first), min(end, newest))
            if lost[0] <= lost[1]:
                self.gone.append(lost)
                self._beyond |= set(range(lost[0], lost[1] + 1))
        self._advance()
        return self._released(self._whole)

    def _open(self) -> list[tuple[int, int]]:
        here = sorted(n for n in self._beyond if n <= self.newest)
        begins = [self._whole, *(n + 1 for n in here)]
        ends = [*(n - 1 for n in here), self.newest]
        return [(b, e) for b, e in zip(begins, ends, strict=True) if b <= e]

    def _advance(self) -> None:
        while self._whole in self._beyond:
            self._beyond.remove(self._whole)
            self._whole += 1

    def _released(self, end: int) -> list[T]:
        return [self._delayed.pop(n) for n in sorted(self._delayed) if n < end]
