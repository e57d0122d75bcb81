"""The set of submaps: a union, so duplicates and any order of arrival change nothing.

A submap is complete when the inter-robot measurements from it, of which it says how many there are,
are here too. Admission enforces law 1: a submap whose measurements overlap another's, or that
differs from one with the same name, is refused with the reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from team.estimation.contribution import Stream
from team.wire.messages import SightingFactor, Submap, VersionEntry


@dataclass
class SubmapSet:
    """Submaps by stream and sequence, as they came; inter-robot measurements by stream, sequence,
    what and when.

    used: the inter-robot factor of each measurement of a stream, by (measurement, teammate).
    chains: the submaps of each stream without a gap, cached; they only grow.
    """

    streams: dict[Stream, dict[int, Submap]] = field(default_factory=dict)
    seen: dict[Stream, dict[int, dict[tuple[int, str], SightingFactor]]] = field(
        default_factory=dict
    )
    used: dict[Stream, dict[tuple[int, str], SightingFactor]] = field(default_factory=dict)
    chains: dict[Stream, list[Submap]] = field(default_factory=dict)
    _incomplete: set[Stream] = field(default_factory=set, init=False)

    def admit(self, submap: Submap) -> str | None:
        """Take a submap; returns the reason if it is refused. A submap of the set is accepted
        again.

        The nearest ones in sequence bound the measurements: law 1 says that each is used once.
        """
        stream = self.streams.setdefault((submap.robot, submap.incarnation), {})
        name = f"submap {submap.sequence} of {submap.robot}, incarnation {submap.incarnation}"
        there = stream.get(submap.sequence)
        if there is not None:
            return None if there == submap else f"{name} differs from the one in the set"
        whole = self.count((submap.robot, submap.incarnation)) == len(stream) == submap.sequence
        nearest = (submap.sequence - 1, None) if whole else _nearest(stream, submap.sequence)
        for sequence in nearest if stream else ():
            if sequence is None:
                continue
            other = stream[sequence]
            first, second = sorted((submap, other), key=lambda s: s.sequence)
            if second.first_measurement <= first.last_measurement:
                return (
                    f"{name} uses measurements "
                    f"{submap.first_measurement}-{submap.last_measurement}, which "
                    f"overlap submap {sequence}'s "
                    f"{other.first_measurement}-{other.last_measurement}"
                )
            adjacent = second.sequence == first.sequence + 1
            ends, begins = first.last_measurement + 1, second.first_measurement
            continues = (ends, first.stamp_ns) == (begins, second.start_ns)
            if not (continues if adjacent else first.stamp_ns <= second.start_ns):
                return f"{name} does not continue submap {sequence}"
        stream[submap.sequence] = submap
        self._incomplete.add((submap.robot, submap.incarnation))
        return None

    def admit_sighting(self, sighting: SightingFactor) -> str | None:
        """Take an inter-robot factor; returns the reason if it is refused: law 1, each
        measurement once.
        """
        stream, teammate = (sighting.robot, sighting.incarnation), sighting.teammate
        from_submap = self.seen.setdefault(stream, {}).setdefault(sighting.sequence, {})
        name = f"a sighting of {teammate} by {sighting.robot}, incarnation {sighting.incarnation}"
        there = from_submap.get((sighting.stamp_ns, teammate))
        if there is not None:
            return None if there == sighting else f"{name} differs from the one in the set"
        submap = self.streams.get(stream, {}).get(sighting.sequence)
        if submap is not None and len(from_submap) >= submap.sightings:
            return f"{name} is one more than submap {sighting.sequence} has"
        used = self.used.setdefault(stream, {})
        twice = next((n for n in sighting.measurements if (n, teammate) in used), None)
        if twice is not None:
            return f"{name} uses measurement {twice}, which another one has used"
        from_submap[sighting.stamp_ns, teammate] = sighting
        used |= {(measurement, teammate): sighting for measurement in sighting.measurements}
        return None

    def sightings(self, submap: Submap) -> list[SightingFactor]:
        """The inter-robot measurements from a submap that are here, by stamp and teammate."""
        stream = self.seen.get((submap.robot, submap.incarnation), {})
        found = stream.get(submap.sequence, {})
        return [found[key] for key in sorted(found)]

    def count(self, stream: Stream) -> int:
        """How many submaps from sequence 0 on are there without a gap."""
        return len(self.chain(stream))

    def chain(self, stream: Stream) -> Sequence[Submap]:
        """The submaps of a stream from sequence 0 up to the first missing or incomplete one; what
        is returned grows with the set.
        """
        found, seen = self.streams.get(stream, {}), self.seen.get(stream, {})
        chain = self.chains.setdefault(stream, [])
        while (submap := found.get(len(chain))) is not None:
            if len(seen.get(submap.sequence, ())) < submap.sightings:
                break
            chain.append(submap)
        return chain

    def missing(self) -> tuple[VersionEntry, ...]:
        """The missing submap that each stream with later ones waits for."""
        gaps = []
        for robot, incarnation in sorted(self._incomplete):
            first = self.count((robot, incarnation))
            if len(self.streams[robot, incarnation]) > first:
                gaps.append(VersionEntry(robot=robot, incarnation=incarnation, sequence=first))
            else:
                self._incomplete.discard((robot, incarnation))
        return tuple(gaps)


def _nearest(stream: Mapping[int, Submap], sequence: int) -> tuple[int | None, int | None]:
    """The sequences of a stream next below and above this one."""
    below = max((s for s in stream if s < sequence), default=None)
    return below, min((s for s in stream if s > sequence), default=None)
