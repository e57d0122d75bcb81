"""Counters of one key, from 0 for each process: missing and duplicate publications of a log.

A life is the publications of one process.
"""

from array import array
from collections.abc import Sequence

import numpy as np

from teamslam.team.shapes import Int64
from teamslam.team.wire.bus import NO_COUNTER, Sample
from teamslam.team.wire.intervals import Interval, IntervalSet, describe_intervals

Life = Int64[np.ndarray, "_"]  # positions of one life's publications, by counter
LATEST_NS = 2**63 - 1  # largest wall clock [ns]; later ones are from damaged or hostile logs


class Counters:
    """Counters and wall clocks [ns] of one key's samples in file order."""

    def __init__(self) -> None:
        self._counters = array("q")
        self._walls = array("q")
        self._replies = 0

    def take(self, sample: Sample) -> None:
        """Add a sample's counter."""
        if sample.counter == NO_COUNTER:
            self._replies += 1
            return
        self._counters.append(sample.counter)
        self._walls.append(min(sample.wall_ns, LATEST_NS))

    def findings(
        self, *, part: bool, numbered: bool = False, totals: Sequence[int] = ()
    ) -> list[str]:
        """Find defects, one line each.

        part: of a cut, earlier publications are not missing. numbered: messages have own numbers.
        totals: publishers' final counts.
        """
        counters, walls = self._arrays()
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
            found.append(f"{_messages(lost)} missing: {describe_intervals(gaps)}")
        return found

    def _arrays(self) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        return np.frombuffer(self._counters, np.int64), np.frombuffer(self._walls, np.int64)

    def unannounced(self, totals: Sequence[int]) -> list[int]:
        """Return the position of the last publication of each life without a total."""
        counters, walls = self._arrays()
        lives = split_lives(counters, walls)
        published = [int(counters[life[-1]]) + 1 for life in lives]
        ended = {life for _, life in match_totals(published, totals)}
        return [int(life[-1]) for k, life in enumerate(lives) if k not in ended]


def split_lives(counters: Int64[np.ndarray, " n"], walls: Int64[np.ndarray, " n"]) -> list[Life]:
    """Split publications, in order of arrival, into lives of their publisher.

    A life ends where the counters, by wall clock or by arrival, do not ascend. The order with fewer
    lives is used, then with fewer gaps: a set clock adds to the first, late arrivals to the second.
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
    """Split by arrival: a repeated counter belongs to the latest life that lacks it."""
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
    """Match each process's total to a life: equal numbers first, then the largest life with fewer.

    None: without a life. A life without total is of a killed process.
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
    before = np.concatenate([counters[:1] - 1 if part else [-1], counters[:-1]])
    missing = counters > before + 1
    pairs = zip(before[missing] + 1, counters[missing] - 1, strict=True)
    return [(int(first), int(last)) for first, last in pairs]


def _messages(count: int) -> str:
    return f"{count} message" if count == 1 else f"{count} messages"
