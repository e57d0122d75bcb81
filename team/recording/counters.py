"""The counters of one key: the publications that a log lacks, has twice, or has out of order.

A publisher counts its publications on a key from 0, and its wall clock increases with the counter.
In the order of the wall clock, a step of more than one is therefore a gap, and a step back, or of
zero, is a restart of the publisher.
"""

from array import array
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from team.recording.inventory import intervals
from team.wire.bus import NO_COUNTER, Sample


class TallyCount(NamedTuple):
    """A publisher's final total for a key: number of publications, first and last wall clock
    [ns].
    """

    since_ns: int
    until_ns: int
    published: int


class Counters:
    """The counters and wall clocks [ns] of one key's samples in the order of the file: 16 B each.

    Two publications of one life of the publisher at equal wall clocks are in the order of their
    counters.
    """

    def __init__(self) -> None:
        self._counters = array("q")
        self._walls = array("q")

    def take(self, sample: Sample) -> None:
        """Adds the counter of one more sample."""
        self._counters.append(sample.counter)
        self._walls.append(min(sample.wall_ns, 2**63 - 1))

    def findings(
        self, *, part: bool, numbered: bool = False, tallies: Sequence[TallyCount] = ()
    ) -> list[str]:
        """The defects, one line each; empty for a sound key.

        part: the log is a cut, so that publications before its beginning are not missing.
        numbered: the messages have numbers of their own, by which missing ones are recognised.
        tallies: the final totals of its publishers. Order is not checked: replies to requests
            arrive late.
        """
        counters, walls = (np.frombuffer(each, np.int64) for each in (self._counters, self._walls))
        order = np.lexsort((counters, walls))
        found = []
        again = np.zeros(len(order), np.bool_)
        again[1:] = (np.diff(counters[order]) == 0) & (np.diff(walls[order]) == 0)
        again &= counters[order] != NO_COUNTER
        if again.any():
            first = counters[order][again][0]
            found.append(f"{_messages(int(again.sum()))} twice, the first is {first}")
        order = order[~again]
        in_order = counters[order]
        gaps = [] if numbered else _gaps(in_order[in_order != NO_COUNTER], part=part)
        for tally in () if part or numbered else tallies:
            within = (
                (walls >= tally.since_ns) & (walls <= tally.until_ns) & (counters != NO_COUNTER)
            )
            behind = int(counters[within].max(initial=-1)) + 1
            gaps += [(behind, tally.published - 1)] if behind < tally.published else []
        if gaps:
            lost = sum(last - first + 1 for first, last in gaps)
            found.append(f"{_messages(lost)} missing: {intervals(gaps)}")
        return found


def _gaps(counters: Int64[np.ndarray, " n"], *, part: bool) -> list[tuple[int, int]]:
    """The missing intervals of counters; after a step back counting begins again at 0."""
    before = np.concatenate([[-1], counters[:-1]])
    begins = counters <= before
    begins[:1] = True
    expected = np.where(begins, 0, before + 1)
    missing = counters > expected
    if part:
        missing &= ~begins
    return [(int(e), int(c) - 1) for e, c in zip(expected[missing], counters[missing], strict=True)]


def _messages(count: int) -> str:
    return f"{count} message" if count == 1 else f"{count} messages"
