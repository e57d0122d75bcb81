"""The counters of one key: the publications that a log lacks or has twice.

A publisher counts its publications on a key from 0. Where it is started again, the next process
counts from 0 once more: a life of the publisher is the publications of one process. Counters do not
name their life. It follows from the order by wall clock or, where the clock was set while the team
ran, from the order of arrival. A reply has no counter (`NO_COUNTER`): it is one of the
publications, and which one is unknown.
"""

from array import array
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from team.recording.inventory import intervals
from team.wire.bus import NO_COUNTER, Sample
from team.wire.intervals import Interval, IntervalSet

Life = Int64[np.ndarray, "_"]
"""The places of one life's publications, in the order of their counters."""


class Counters:
    """The counters and wall clocks [ns] of one key's samples in the order of the file: 16 B
    each.
    """

    def __init__(self) -> None:
        self._counters = array("q")
        self._walls = array("q")
        self._replies = 0

    def take(self, sample: Sample) -> None:
        """Add the counter of one more sample."""
        if sample.counter == NO_COUNTER:
            self._replies += 1
            return
        self._counters.append(sample.counter)
        self._walls.append(min(sample.wall_ns, 2**63 - 1))

    def findings(
        self, *, part: bool, numbered: bool = False, totals: Sequence[int] = ()
    ) -> list[str]:
        """The defects, one line each; empty for a sound key.

        part: the log is a cut, so that publications before its beginning are not missing.
        numbered: the messages have numbers of their own, by which missing ones are recognised.
        totals: the final numbers of publications of its publishers. Order is not checked: what
            was requested arrives late.
        """
        counters, walls = (np.frombuffer(each, np.int64) for each in (self._counters, self._walls))
        order = np.lexsort((walls, counters))
        again = np.zeros(len(order), np.bool_)
        again[1:] = (np.diff(counters[order]) == 0) & (np.diff(walls[order]) == 0)
        found = []
        if again.any():
            first = counters[order][again][0]
            found.append(f"{_messages(int(again.sum()))} twice, the first is {first}")
        if numbered:
            return found
        once = np.sort(order[~again])
        lives = [counters[once][life] for life in split_lives(counters[once], walls[once])]
        gaps = [gap for life in lives for gap in _gaps(life, part=part)]
        if not part:
            published = [int(life[-1]) + 1 for life in lives]
            for total, life in match_totals(published, totals):
                behind = 0 if life is None else published[life]
                gaps += [(behind, total - 1)] if behind < total else []
        lost = sum(last - first + 1 for first, last in gaps)
        if lost > self._replies:
            found.append(f"{_messages(lost)} missing: {intervals(gaps)}")
        return found


def split_lives(counters: Int64[np.ndarray, " n"], walls: Int64[np.ndarray, " n"]) -> list[Life]:
    """Split publications, given in the order of their arrival, into the lives of their publisher.

    Two orders show lives: that of the wall clock, in which a step back, or of zero, begins one, and
    that of arrival. The one with fewer lives is taken, and of equals the one with fewer gaps: a
    clock that was set adds lives and gaps to the first, what arrived late to the second.
    """
    if not len(counters):
        return []
    order = np.lexsort((counters, walls))
    by_wall = np.split(order, np.flatnonzero(np.diff(counters[order]) <= 0) + 1)
    if len(by_wall) == 1:
        return by_wall
    by_arrival = _by_arrival(counters)

    def defects(lives: list[Life]) -> tuple[int, int]:
        return len(lives), sum(int(counters[life[-1]]) + 1 - len(life) for life in lives)

    return min(by_wall, by_arrival, key=defects)


def _by_arrival(counters: Int64[np.ndarray, " n"]) -> list[Life]:
    """The lives by arrival: a counter that the newest life has is late, of an earlier life that
    lacks it, or begins the next one.
    """
    present = [IntervalSet()]
    places: list[list[int]] = [[]]
    for place, counter in enumerate(counters.tolist()):
        at = len(present) - 1
        if counter in present[at]:
            lacking = (k for k in reversed(range(at)) if _lacks(present[k], counter))
            at = next(lacking, at + 1)
        if at == len(present):
            present.append(IntervalSet())
            places.append([])
        present[at].add(counter, counter)
        places[at].append(place)
    arrays = [np.array(each, np.int64) for each in places]
    return [each[np.argsort(counters[each], kind="stable")] for each in arrays]


def _lacks(present: IntervalSet, counter: int) -> bool:
    return counter < present.last and counter not in present


def match_totals(published: Sequence[int], totals: Sequence[int]) -> list[tuple[int, int | None]]:
    """Match the total that each process published at its end to a life; None: to no life.

    Equal numbers first; of the other totals each takes the life with the most publications, of
    those that have fewer. A life without a total is that of a process that was killed.
    """
    free = dict(enumerate(published))
    found: list[tuple[int, int | None]] = []
    rest = []
    for total in totals:
        life = next((k for k, count in free.items() if count == total), None)
        if life is None:
            rest.append(total)
        else:
            del free[life]
            found.append((total, life))
    for total in rest:
        fewer = [k for k, count in free.items() if count < total]
        life = max(fewer, key=free.__getitem__, default=None)
        if life is not None:
            del free[life]
        found.append((total, life))
    return found


def _gaps(counters: Int64[np.ndarray, " n"], *, part: bool) -> list[Interval]:
    """The missing intervals of one life's counters, given in ascending order."""
    before = np.concatenate([counters[:1] - 1 if part else [-1], counters[:-1]])
    missing = counters > before + 1
    pairs = zip(before[missing] + 1, counters[missing] - 1, strict=True)
    return [(int(first), int(last)) for first, last in pairs]


def _messages(count: int) -> str:
    return f"{count} message" if count == 1 else f"{count} messages"
