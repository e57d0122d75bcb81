"""The submaps in the map's reach: of streams that have begun, those without a gap before them."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence

from team.estimation.contribution import Stream
from team.wire import messages as m

STORED_TIMES = 8
"""Number of times up to which the members are stored."""


class Reach:
    """Notes what comes into reach, so that a submap costs no look at all streams.

    chains: the submaps of each stream that has begun; they grow in place. order: the stream of each
    submap, in the order in which they came.
    """

    def __init__(self) -> None:
        self.chains: dict[Stream, Sequence[m.Submap]] = {}
        self.order: list[Stream] = []
        self._lengths: dict[Stream, int] = {}
        self._members: dict[float, dict[Stream, int]] = {}

    def note(self, stream: Stream, chain: Sequence[m.Submap]) -> None:
        """Note the submaps of a stream that has begun; those that are new come into reach."""
        known = self._lengths.get(stream, 0)
        self.chains[stream], self._lengths[stream] = chain, len(chain)
        self.order += [stream] * (len(chain) - known)
        for until_ns, members in self._members.items():
            if len(chain) > known and chain[known].stamp_ns <= until_ns:
                self._members[until_ns] = {**members, stream: _last(chain, until_ns)}

    def members(self, until_ns: float) -> Mapping[Stream, int]:
        """The last submap of each stream that ends up to a time."""
        found = self._members.get(until_ns)
        if found is None:
            lasts = ((stream, _last(chain, until_ns)) for stream, chain in self.chains.items())
            found = {stream: last for stream, last in lasts if last >= 0}
            if len(self._members) == STORED_TIMES:
                self._members.clear()
            self._members[until_ns] = found
        return found


def _last(chain: Sequence[m.Submap], until_ns: float) -> int:
    return bisect_right(chain, until_ns, key=_end_ns) - 1


def _end_ns(submap: m.Submap) -> int:
    return submap.stamp_ns
