"""Observations of condensed submaps for association.

The newest MOST submaps of each landmark are stored whole; of older ones, the pairs of landmarks
that they kept apart. A landmark of n < MOST submaps, probably a false detection, is dropped when
every landmark of MOST or more, last observed with it, has since been observed by MOST n submaps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from teamslam.team.estimation.contribution import Observation
from teamslam.team.shapes import Bool, Int64

Indices = Int64[np.ndarray, " _"]

MOST = 8  # newest condensed submaps stored for each landmark


NO_COUNTS: Indices = np.zeros(0, np.int64)


class Observed(NamedTuple):
    """A submap with the node of each landmark; −1 for a dropped one.

    counts: condensed submaps with each landmark; empty if not condensed.
    """

    observation: Observation
    landmarks: Indices
    counts: Indices

    @property
    def known(self) -> Indices:
        """Nodes of the landmarks without dropped ones."""
        return self.landmarks[self.landmarks >= 0]


@dataclass(frozen=True, eq=False)
class Memory:
    """The stored condensed submaps, oldest first, and the pairs of forgotten ones.

    pairs: nodes of two landmarks of one forgotten submap, ascending. distinct: certainly two
    (`LocalMap.distinct`).
    """

    submaps: tuple[Observed, ...] = ()
    pairs: Int64[np.ndarray, "P 2"] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    distinct: Bool[np.ndarray, " P"] = field(default_factory=lambda: np.zeros(0, np.bool_))

    def renumbered(self, node_of: Indices) -> "Memory":
        """Renumber the nodes, −1 for a dropped one; drop pairs that become one landmark."""
        to = np.append(node_of, -1)
        submaps = tuple(each._replace(landmarks=to[each.landmarks]) for each in self.submaps)
        return replace(_unique(to[self.pairs], self.distinct), submaps=submaps)

    def longer(self, submaps: Sequence[Observed]) -> "Memory":
        """Append submaps."""
        return replace(self, submaps=(*self.submaps, *submaps))

    def given_up(self, counts: Indices, stays: Bool[np.ndarray, " nodes"], most: int) -> Indices:
        """List the nodes of the landmarks to drop, ascending.

        counts: condensed submaps by node. stays: landmarks to keep.
        """
        if not self.submaps:
            return np.zeros(0, np.int64)
        size = [len(each.landmarks) for each in self.submaps]
        of = np.repeat(np.arange(len(size)), size)
        node = np.concatenate([each.landmarks for each in self.submaps])
        before = np.concatenate([each.counts for each in self.submaps])
        of, node, before = (each[node >= 0] for each in (of, node, before))
        now = counts[node]
        well_known = now >= most
        since = np.full(len(size), -1)
        since[of[well_known]] = np.iinfo(np.int64).max
        np.minimum.at(since, of[well_known], (now - before)[well_known])
        last = np.zeros(len(counts), np.int64)
        np.maximum.at(last, node, of)
        gone = ~well_known & ~stays[node] & (last[node] == of) & (since[of] >= most * now)
        return np.unique(node[gone])

    def shortened(self, nodes: int, most: int) -> "Memory":
        """Drop the submaps that are among the newest `most` of none of their landmarks."""
        newer = np.zeros(nodes, np.int64)
        remembered, forgotten = [], []
        for each in reversed(self.submaps):
            if (newer[each.known] < most).any():
                newer[each.known] += 1
                remembered.append(each)
            else:
                forgotten.append(each)
        if not forgotten:
            return self
        pairs, distinct = [self.pairs], [self.distinct]
        for each in forgotten:
            marks = each.observation.distinct
            one, two = np.triu_indices(len(marks), 1)
            pairs.append(np.column_stack([each.landmarks[one], each.landmarks[two]]))
            distinct.append(marks[one, two])
        found = _unique(np.concatenate(pairs), np.concatenate(distinct))
        return replace(found, submaps=tuple(reversed(remembered)))


NOTHING = Memory()


def _unique(pairs: Int64[np.ndarray, "P 2"], distinct: Bool[np.ndarray, " P"]) -> Memory:
    if not len(pairs):
        return NOTHING
    pairs = np.sort(pairs, axis=1)
    two = (pairs[:, 0] != pairs[:, 1]) & (pairs[:, 0] >= 0)
    pairs, distinct = pairs[two], distinct[two]
    order = np.lexsort((~distinct, pairs[:, 1], pairs[:, 0]))
    pairs, distinct = pairs[order], distinct[order]
    first = np.ones(len(pairs), np.bool_)
    first[1:] = (pairs[1:] != pairs[:-1]).any(axis=1)
    return Memory((), pairs[first], distinct[first])
