"""The team's set of submaps: a union, so duplicates and any order of arrival change nothing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import msgspec

from teamslam.team.config import SURVEY_FRAME
from teamslam.team.saved_map import submap_of
from teamslam.team.wire import messages as m

Stream = tuple[str, int]
"""(robot, incarnation)."""


@dataclass
class StoredStream:
    """The members of one incarnation of a robot.

    chain: the complete submaps from sequence 0 on, without a gap. pending: the other submaps, by
    sequence. sightings: inter-robot measurements by sequence, then by (stamp, teammate); with all
    that it announces a submap is complete. used: the (measurement, teammate) pairs in them.
    refused: sequences of refused members.
    """

    start: m.InitialPose | None = None
    chain: list[m.Submap] = field(default_factory=list)
    pending: dict[int, m.Submap] = field(default_factory=dict)
    sightings: dict[int, dict[tuple[int, str], m.SightingFactor]] = field(default_factory=dict)
    used: set[tuple[int, str]] = field(default_factory=set)
    refused: set[int] = field(default_factory=set)

    def extend_chain(self) -> None:
        """Append the submaps that are complete and continue the chain."""
        while (submap := self.pending.get(len(self.chain))) is not None:
            if len(self.sightings.get(submap.sequence, ())) < submap.sightings:
                break
            self.chain.append(self.pending.pop(submap.sequence))

    def submap(self, sequence: int) -> m.Submap | None:
        """Return a stored submap."""
        if 0 <= sequence < len(self.chain):
            return self.chain[sequence]
        return self.pending.get(sequence)

    def processed(self, count: int) -> int:
        """Return `count`; if the next submap was refused, all."""
        if count not in self.refused:
            return count
        return max(*self.refused, *self.pending, len(self.chain) - 1, count) + 1


_EMPTY = StoredStream()


class SubmapStore:
    """The members of the team's set.

    A submap whose measurements overlap another's (law 1), and a member that differs from a stored
    one of its name, are refused. chains: the submaps available to a map, of streams with an initial
    pose; they grow in place. withdrawals: the first order on each robot.
    """

    def __init__(self) -> None:
        self.streams: dict[Stream, StoredStream] = {}
        self.chains: dict[Stream, Sequence[m.Submap]] = {}
        self.maps: dict[str, m.SavedMap] = {}
        self.withdrawals: dict[str, m.Withdrawal] = {}
        self.verdicts: set[m.Judgement] = set()
        self.refused = 0
        self._revoked: set[m.Judgement] = set()

    # Admission.

    def add(self, message: m.Message) -> str | None:
        """Add a member; return the reason if refused."""
        match message:
            case m.InitialPose():
                self.add_start(message)
            case m.Submap():
                return self.add_submap(message)
            case m.SightingFactor():
                return self.add_sighting(message)
            case m.Withdrawal():
                self.withdrawals.setdefault(message.robot, message)
            case m.Verdict():
                self.add_verdict(message)
            case m.SavedMap():
                return self.add_map(message)
            case _:
                pass
        return None

    def add_start(self, start: m.InitialPose) -> None:
        """Add the initial pose of a stream, once."""
        key = start.robot, start.incarnation
        stream = self._stream(key)
        stream.start = stream.start or start
        self._note_chain(key)

    def add_submap(self, submap: m.Submap) -> str | None:
        """Add a submap; return the reason if refused."""
        return self._settle(submap, self._refusal_of_submap(submap))

    def add_sighting(self, sighting: m.SightingFactor) -> str | None:
        """Add an inter-robot measurement; return the reason if refused."""
        return self._settle(sighting, self._refusal_of_sighting(sighting))

    def add_verdict(self, verdict: m.Verdict) -> None:
        """Add or revoke an operator's verdict."""
        judgement = _in_order(verdict.judgement)
        if verdict.withdrawn:
            self._revoked.add(judgement)
            self.verdicts.discard(judgement)
        elif judgement not in self._revoked:
            self.verdicts.add(judgement)

    def add_map(self, saved: m.SavedMap) -> str | None:
        """Add a saved map as a stream of one submap, with known start in the survey's frame."""
        for other in self.maps.values():
            if other.name != saved.name and {*other.sets} & {*saved.sets}:
                return (
                    f"the saved map {saved.name} has a set in common with {other.name}: load the "
                    "later of the two, which contains the earlier one"
                )
        refused = self.add_submap(submap_of(saved))
        if refused is None and saved.name not in self.maps:
            self.maps[saved.name] = saved
            self.add_start(
                m.InitialPose(
                    stamp_ns=0,
                    robot=saved.author,
                    incarnation=0,
                    number=0,
                    pose=bytes(24) if saved.frame == SURVEY_FRAME else b"",
                    covariance=b"",
                )
            )
        return refused

    def refuse(self, member: m.Submap | m.SightingFactor) -> None:
        """Mark the submap of a member as refused."""
        self.refused += 1
        self._stream((member.robot, member.incarnation)).refused.add(member.sequence)

    def _stream(self, stream: Stream) -> StoredStream:
        found = self.streams.get(stream)
        if found is None:
            found = self.streams[stream] = StoredStream()
        return found

    def _settle(self, member: m.Submap | m.SightingFactor, reason: str | None) -> str | None:
        if reason is not None:
            self.refuse(member)
        else:
            self._note_chain((member.robot, member.incarnation))
        return reason

    def _note_chain(self, key: Stream) -> None:
        stream = self._stream(key)
        stream.extend_chain()
        if stream.start is not None and stream.chain:
            self.chains[key] = stream.chain

    def _refusal_of_submap(self, submap: m.Submap) -> str | None:
        key = submap.robot, submap.incarnation
        stream = self._stream(key)
        name = f"submap {submap.sequence} of {submap.robot}, incarnation {submap.incarnation}"
        stored = stream.submap(submap.sequence)
        if stored is not None:
            return None if stored == submap else f"{name} differs from the one in the set"
        last = len(stream.chain) - 1
        before = max((s for s in stream.pending if s < submap.sequence), default=last)
        after = min((s for s in stream.pending if s > submap.sequence), default=-1)
        for other in filter(None, map(stream.submap, (before, after))):
            first, second = sorted((submap, other), key=lambda s: s.sequence)
            if second.first_measurement <= first.last_measurement:
                return (
                    f"{name} uses measurements "
                    f"{submap.first_measurement}-{submap.last_measurement}, which "
                    f"overlap submap {other.sequence}'s "
                    f"{other.first_measurement}-{other.last_measurement}"
                )
            is_adjacent = second.sequence == first.sequence + 1
            ends, begins = first.last_measurement + 1, second.first_measurement
            continues = (ends, first.stamp_ns) == (begins, second.start_ns)
            if not (continues if is_adjacent else first.stamp_ns <= second.start_ns):
                return f"{name} does not continue submap {other.sequence}"
        stream.pending[submap.sequence] = submap
        return None

    def _refusal_of_sighting(self, sighting: m.SightingFactor) -> str | None:
        teammate = sighting.teammate
        stream = self._stream((sighting.robot, sighting.incarnation))
        from_submap = stream.sightings.setdefault(sighting.sequence, {})
        name = f"a sighting of {teammate} by {sighting.robot}, incarnation {sighting.incarnation}"
        stored = from_submap.get((sighting.stamp_ns, teammate))
        if stored is not None:
            return None if stored == sighting else f"{name} differs from the one in the set"
        submap = stream.submap(sighting.sequence)
        if submap is not None and len(from_submap) >= submap.sightings:
            return f"{name} is one more than submap {sighting.sequence} has"
        twice = next((n for n in sighting.measurements if (n, teammate) in stream.used), None)
        if twice is not None:
            return f"{name} uses measurement {twice}, which another one has used"
        from_submap[sighting.stamp_ns, teammate] = sighting
        stream.used |= {(measurement, teammate) for measurement in sighting.measurements}
        return None

    # Contents.

    def chain(self, stream: Stream) -> Sequence[m.Submap]:
        """Return the complete submaps of a stream from sequence 0 on."""
        return self.streams.get(stream, _EMPTY).chain

    def start(self, stream: Stream) -> m.InitialPose:
        """Return the initial pose of a stream of `chains`."""
        start = self.streams[stream].start
        assert start is not None
        return start

    @property
    def newcomers(self) -> set[Stream]:
        """Streams from an unknown pose without a submap yet."""
        return {
            key
            for key, stream in self.streams.items()
            if stream.start is not None and not stream.start.pose and not stream.chain
        }

    def sightings(self, submap: m.Submap) -> list[m.SightingFactor]:
        """Return the inter-robot measurements from a submap, by stamp and teammate."""
        stream = self.streams.get((submap.robot, submap.incarnation), _EMPTY)
        found = stream.sightings.get(submap.sequence, {})
        return [found[key] for key in sorted(found)]

    def acknowledged(self, stream: Stream) -> int:
        """Count the submaps of a stream that are stored or refused."""
        found = self.streams.get(stream, _EMPTY)
        return found.processed(len(found.chain))

    def processed(self, stream: Stream) -> int:
        """Count the submaps of a stream that a map can have, or will never have."""
        found = self.streams.get(stream, _EMPTY)
        return found.processed(0 if found.start is None else len(found.chain))

    @property
    def submaps(self) -> int:
        """Number of submaps that a map can have, or will never have."""
        return sum(self.processed(stream) for stream in self.streams)

    @property
    def arrived(self) -> int:
        """Number of submaps that a map can have, orders, verdicts and revocations."""
        return sum(map(len, self.chains.values())) + len(self.withdrawals) + self.judged

    @property
    def judged(self) -> int:
        """Number of verdicts and revocations; it grows whenever `verdicts` changes."""
        return len(self.verdicts | self._revoked) + len(self._revoked)

    def missing(self) -> tuple[m.VersionEntry, ...]:
        """Return the first missing submap of each stream with later ones."""
        return tuple(
            m.VersionEntry(robot=robot, incarnation=incarnation, sequence=len(stream.chain))
            for (robot, incarnation), stream in sorted(self.streams.items())
            if stream.pending
        )

    def messages_of(self, robot: str) -> Iterator[m.Message]:
        """Yield a robot's members for its next process, latest incarnation first."""
        for key in sorted((key for key in self.streams if key[0] == robot), reverse=True):
            stream = self.streams[key]
            if stream.chain and stream.start is not None:
                yield stream.start
                yield from stream.chain
                for submap in stream.chain:
                    yield from self.sightings(submap)


def _in_order(judgement: m.Judgement) -> m.Judgement:
    first, second = sorted((judgement.first, judgement.second), key=msgspec.structs.astuple)
    return m.Judgement(first=first, second=second, same=judgement.same)
