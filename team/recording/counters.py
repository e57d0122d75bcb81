"""The counters of one key: which publications a log lacks, has twice, or has out of order.

A publisher counts what it publishes on a key from 0, and its wall clock ascends with the count. So
in the order of the wall clock a step of more than one is a gap, and a step back, or none, is a
publisher that was started again.
"""

from array import array

import numpy as np
from jaxtyping import Int64

from team.wire.bus import Sample

SHOWN = 3
"""Gaps that a finding names; it counts the rest."""


class Counters:
    """The counters and wall clocks [ns] of one key's samples in the order of the file: 16 B each.

    Two publications of one life at equal wall clocks are in the order of their counters.
    """

    def __init__(self) -> None:
        self._counters = array("q")
        self._walls = array("q")

    def take(self, sample: Sample) -> None:
        """Note one more."""
        self._counters.append(sample.counter)
        self._walls.append(min(sample.wall_ns, 2**63 - 1))

    def findings(self, *, part: bool, sorted_by_time: bool) -> list[str]:
        """What is wrong, one line each; nothing of a sound key.

        part: the log is a cut, so that what a publisher said before it began is no loss.
        sorted_by_time: the log is in the order of team time, so that order of arrival is not there.
        """
        counters, walls = (np.frombuffer(each, np.int64) for each in (self._counters, self._walls))
        order = np.lexsort((counters, walls))
        found = []
        again = np.append(False, (np.diff(counters[order]) == 0) & (np.diff(walls[order]) == 0))
        if again.any():
            first = counters[order][again][0]
            found.append(f"{_messages(int(again.sum()))} twice, the first is {first}")
        order = order[~again]
        in_order = counters[order]
        gaps = _gaps(in_order, part=part)
        if gaps:
            lost = sum(last - first + 1 for first, last in gaps)
            named = ", ".join(_interval(*gap) for gap in gaps[:SHOWN])
            more = f" and {len(gaps) - SHOWN} more gaps" if len(gaps) > SHOWN else ""
            found.append(f"{_messages(lost)} missing: {named}{more}")
        late = np.flatnonzero(np.diff(order) < 0)
        if len(late) and not sorted_by_time:
            first = in_order[late[0] + 1]
            found.append(f"{_messages(len(late))} out of order, the first is {first}")
        return found


def _gaps(counters: Int64[np.ndarray, " n"], *, part: bool) -> list[tuple[int, int]]:
    """The intervals of counters that are not there; a step back begins again at 0."""
    before = np.concatenate([[-1], counters[:-1]])
    begins = counters <= before
    begins[:1] = True
    expected = np.where(begins, 0, before + 1)
    missing = counters > expected
    if part:
        missing &= ~begins
    return [(int(e), int(c) - 1) for e, c in zip(expected[missing], counters[missing], strict=True)]


def _interval(first: int, last: int) -> str:
    return str(first) if first == last else f"{first}–{last}"


def _messages(count: int) -> str:
    return f"{count} message" if count == 1 else f"{count} messages"
