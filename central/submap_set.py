"""The set of submaps: a union, so duplicates and any order of arrival change nothing.

Admission is the ledger's gate: a submap whose readings overlap another's, or that says something
else under a name that is taken, is refused with its reason.
"""

from dataclasses import dataclass, field

from team.wire.messages import Member, Submap

Stream = tuple[str, int]
"""(robot, epoch)."""


@dataclass
class SubmapSet:
    """Submaps by stream and sequence, as they came."""

    streams: dict[Stream, dict[int, Submap]] = field(default_factory=dict)

    def admit(self, submap: Submap) -> str | None:
        """Take a submap; the reason if it is refused. One that is in the set already is accepted.

        The nearest ones in sequence bound the readings: law 1 says that each is used once.
        """
        stream = self.streams.setdefault((submap.robot, submap.epoch), {})
        name = f"submap {submap.sequence} of {submap.robot}, epoch {submap.epoch}"
        there = stream.get(submap.sequence)
        if there is not None:
            return None if there == submap else f"{name} differs from the one in the set"
        before = max((s for s in stream if s < submap.sequence), default=None)
        after = min((s for s in stream if s > submap.sequence), default=None)
        for sequence in (before, after):
            if sequence is None:
                continue
            other = stream[sequence]
            first, second = sorted((submap, other), key=lambda s: s.sequence)
            if second.first_reading <= first.last_reading:
                return (
                    f"{name} uses readings {submap.first_reading}-{submap.last_reading}, which "
                    f"overlap submap {sequence}'s {other.first_reading}-{other.last_reading}"
                )
            adjacent = second.sequence == first.sequence + 1
            ends, begins = first.last_reading + 1, second.first_reading
            continues = (ends, first.stamp_ns) == (begins, second.start_ns)
            if not (continues if adjacent else first.stamp_ns <= second.start_ns):
                return f"{name} does not continue submap {sequence}"
        stream[submap.sequence] = submap
        return None

    def chain(self, stream: Stream) -> list[Submap]:
        """The submaps of a stream from sequence 0 up to the first gap."""
        found = self.streams.get(stream, {})
        chain: list[Submap] = []
        while len(chain) in found:
            chain.append(found[len(chain)])
        return chain

    def count(self, stream: Stream) -> int:
        """How many submaps from sequence 0 on are there without a gap."""
        return len(self.chain(stream))

    def missing(self) -> tuple[Member, ...]:
        """The first missing submap of every stream that has later ones."""
        gaps = []
        for (robot, epoch), found in sorted(self.streams.items()):
            first = self.count((robot, epoch))
            if found and max(found) > first:
                gaps.append(Member(robot, epoch, first))
        return tuple(gaps)
