"""What association needs of condensed submaps: landmarks seen together, places looked at.

A condensed submap's measurements are in the quadratic. Association asks of it what no quadratic
has: which landmarks it has, which of them a keyframe saw together, and by that where it looked. The
newest MOST submaps of each landmark are remembered whole, and no others: how many they are depends
on the landmarks, not on the duration of the run. Whatever counts submaps counts no farther than
that. Of the forgotten ones the pairs of landmarks remain that they kept apart.

False detections found landmarks that hardly anything observes again; remembered for ever, they
would slow a team down for as long as it runs. A landmark of n < MOST submaps is given up when every
landmark of MOST or more, that was observed with it when it was observed last, has been observed by
MOST n submaps since: of those that look there fewer than one in MOST have found it. What is there
nevertheless is founded anew when it is observed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64

from team.estimation.contribution import Observation

Indices = Int64[np.ndarray, " _"]

MOST = 8
"""Number of newest condensed submaps of each landmark that are remembered."""


NO_COUNTS: Indices = np.zeros(0, np.int64)


class Observed(NamedTuple):
    """A submap, and the node of each of its landmarks; −1 for one that was given up.

    counts: of each landmark, how many condensed submaps had it, this one included; none of a submap
        that is not condensed.
    """

    observation: Observation
    landmarks: Indices
    counts: Indices

    @property
    def known(self) -> Indices:
        """The nodes of its landmarks without those that were given up."""
        return self.landmarks[self.landmarks >= 0]


@dataclass(frozen=True, eq=False)
class Memory:
    """The condensed submaps that are remembered, and the pairs of the forgotten ones.

    submaps: oldest first.
    pairs: two landmarks that one forgotten submap had, by their nodes, the smaller one first.
    distinct: which of them are known to be two (`LocalMap.distinct`).
    """

    submaps: tuple[Observed, ...] = ()
    pairs: Int64[np.ndarray, "P 2"] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    distinct: Bool[np.ndarray, " P"] = field(default_factory=lambda: np.zeros(0, np.bool_))

    def renumbered(self, node_of: Indices) -> "Memory":
        """The same with other numbers of nodes, −1 for one that is given up; two landmarks that
        become one are no pair.
        """
        to = np.append(node_of, -1)
        submaps = tuple(each._replace(landmarks=to[each.landmarks]) for each in self.submaps)
        return replace(_unique(to[self.pairs], self.distinct), submaps=submaps)

    def longer(self, submaps: Sequence[Observed]) -> "Memory":
        """With these submaps behind the others."""
        return replace(self, submaps=(*self.submaps, *submaps))

    def given_up(self, counts: Indices, stays: Bool[np.ndarray, " nodes"], most: int) -> Indices:
        """The nodes of the landmarks that are given up, ascending.

        counts: by node, how many condensed submaps have had it. stays: which are not given up.
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
        """Without the submaps that are among the newest `most` of none of their landmarks.

        nodes: number of nodes of the graph.
        """
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
    """Each pair once, ascending; it is distinct if it was once so."""
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
