"""Which publications of a publisher have arrived: each once, and what is missing is asked for.

A publisher numbers what it publishes on a key from 0 and says again and again, by its heartbeat,
which number was the last. So a receiver knows of everything that it lacks, at the beginning, in
between and at the end, as long as the publisher lives: `docs/decisions/0036-delivery.md`.
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

PATIENCE_S = 0.5
"""A publication that is missing for so long is asked for at its publisher."""
LONGEST_S = 8.0
"""The time between two questions doubles up to this."""
HELD_S = 2.0
"""What came after a gap waits for it at the most for so long."""
T = TypeVar("T")


@dataclass
class Arrivals(Generic[T]):
    """The publications of one publisher on one key; those before `first` are not asked for.

    in_order: what came after a gap waits for a while, until the gap is closed. newest: the last
    number that is known of, by arrival or by heartbeat. gone: intervals that the publisher itself
    does not have any more.
    """

    first: int
    in_order: bool = True
    newest: int = -1
    gone: list[tuple[int, int]] = field(default_factory=list)
    _whole: int = field(init=False)
    _beyond: set[int] = field(default_factory=set, init=False)
    _held: dict[int, T] = field(default_factory=dict, init=False)
    _since_s: float | None = field(default=None, init=False)
    _due_s: float = field(default=0.0, init=False)
    _asked: int = field(default=0, init=False)
    _loose: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._whole = self.first

    def take(self, number: int, item: T) -> list[T]:
        """Note an arrival; what is to be delivered now, nothing where it has come before."""
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
        self._held[number] = item
        return self._released(self._whole)

    def know(self, newest: int) -> None:
        """The publisher has said which number was the last."""
        self.newest = max(self.newest, newest)

    @property
    def missing(self) -> tuple[int, int] | None:
        """The first and the last number that are missing; some between may be here."""
        last = self.newest
        while last >= self._whole and last in self._beyond:
            last -= 1
        return (self._whole, last) if last >= self._whole else None

    @property
    def lacking(self) -> list[tuple[int, int]]:
        """The intervals that are not here, those that are gone before the others."""
        return [*self.gone, *self._open()]

    def due(self, now_s: float) -> tuple[int, int | None] | None:
        """The interval to ask for now, if a gap has stood long enough; None at its end: all since.

        A question that is repeated asks for everything since: the newest is always there, so an
        answer without what is missing says that it is gone.
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
        """What has waited too long for a gap, in order; until that is closed nothing waits."""
        if self._since_s is None or now_s - self._since_s < HELD_S:
            return []
        self._loose = True
        return self._released(self.newest + 1)

    def answered(self, first: int, newest: int) -> list[T]:
        """The publisher has answered with all that it has from `first` to `newest`, and it is in.

        What is still missing of it is gone; what that held up is to be delivered now.
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
        return [self._held.pop(n) for n in sorted(self._held) if n < end]
