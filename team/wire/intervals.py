"""Sets of integers as sorted, disjoint, closed intervals, and the times to request their gaps."""

from bisect import bisect_left, bisect_right
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Interval = tuple[int, int]  # first and last number, both included
PATIENCE_S = 0.5  # delay [s] before the first request of missing data
LONGEST_S = 8.0  # longest interval [s] between two equal requests, which double
K = TypeVar("K", bound=Hashable)


class IntervalSet:
    """A set of integers; `len` is the number of its intervals."""

    def __init__(self) -> None:
        self._begins: list[int] = []
        self._ends: list[int] = []

    def add(self, first: int, last: int) -> None:
        """Add the integers first … last, and merge intervals that overlap or touch."""
        if last < first:
            return
        low = bisect_left(self._ends, first - 1)  # the first interval that overlaps or touches it
        high = bisect_right(self._begins, last + 1)
        if low < high:
            first = min(first, self._begins[low])
            last = max(last, self._ends[high - 1])
        self._begins[low:high] = [first]
        self._ends[low:high] = [last]

    def __contains__(self, number: int) -> bool:
        at = bisect_left(self._ends, number)
        return at < len(self._begins) and self._begins[at] <= number

    def __len__(self) -> int:
        return len(self._begins)

    def __iter__(self) -> Iterator[Interval]:
        return zip(self._begins, self._ends, strict=True)

    @property
    def last(self) -> int:
        """The largest integer; −1 if there is none."""
        return self._ends[-1] if self._ends else -1

    def join_first(self, count: int) -> None:
        """Join the first intervals and the gaps between them until at most `count` are left."""
        excess = len(self._begins) - count
        if excess > 0:
            del self._begins[1 : 1 + excess], self._ends[:excess]

    def next_absent(self, number: int) -> int:
        """Return the smallest integer ≥ `number` that is not in the set."""
        at = bisect_left(self._ends, number)
        inside = at < len(self._begins) and self._begins[at] <= number
        return self._ends[at] + 1 if inside else number

    def last_absent(self, number: int) -> int:
        """Return the largest integer up to `number` that is not in the set."""
        at = bisect_left(self._ends, number)
        inside = at < len(self._begins) and self._begins[at] <= number
        return self._begins[at] - 1 if inside else number

    def gaps(self, first: int, last: int) -> list[Interval]:
        """Return the intervals of first … last that are not in the set, ascending."""
        found: list[Interval] = []
        at = bisect_left(self._ends, first)
        while first <= last:
            begin = self._begins[at] if at < len(self._begins) else last + 1
            if first < begin:
                found.append((first, min(begin - 1, last)))
            if at == len(self._begins):
                break
            first = max(first, self._ends[at] + 1)
            at += 1
        return found


SHOWN = 3  # intervals that are named; the others are counted


def describe_intervals(intervals: Sequence[Interval]) -> str:
    """Name intervals, as `2–4, 7`."""
    named = ", ".join(f"{a}" if a == b else f"{a}–{b}" for a, b in intervals[:SHOWN])
    more = len(intervals) - SHOWN
    return named + (f" and {more} more gaps" if more > 0 else "")


@dataclass
class RequestTimes(Generic[K]):
    """Gaps by name, each with the time of its next request."""

    _gaps: dict[K, tuple[Hashable, float, float]] = field(default_factory=dict)

    def due(self, gaps: Mapping[K, Hashable], now_s: float) -> list[K]:
        """Return the names of the gaps to request now; a changed gap begins anew."""
        self._gaps = {name: known for name, known in self._gaps.items() if name in gaps}
        found = []
        for name, gap in gaps.items():
            known = self._gaps.get(name)
            if known is None or known[0] != gap:
                self._gaps[name] = (gap, now_s + PATIENCE_S, PATIENCE_S)
            elif now_s >= known[1]:
                pause_s = min(2.0 * known[2], LONGEST_S)
                self._gaps[name] = (gap, now_s + pause_s, pause_s)
                found.append(name)
        return found
