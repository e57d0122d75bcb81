"""One peer's copy of the team's set: grow-only, independent of the order of arrival.

Of two members of one name the smaller hash stays. The bytes about each robot are limited.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import Literal, NamedTuple, TypeVar

from teamslam.team.config import MAP
from teamslam.team.core import blake2b
from teamslam.team.door import MOST_COUNT, MOST_LIVES
from teamslam.team.peers.members import Member, about
from teamslam.team.store import Stream
from teamslam.team.wire import messages as m
from teamslam.team.wire.intervals import IntervalSet

MOST_SEQUENCES = 200_000
MOST_STREAMS = 64
MOST_STATEMENTS = 2 * MOST_STREAMS + 8  # most orders and `Done` messages about one robot
MOST_VERDICTS = 4096  # most verdicts on landmarks of one robot, and withdrawals of verdicts
MOST_MAPS = 16  # most saved maps of earlier days
SHARE = 256 * 2**20  # most bytes about one robot: 8 h of a submap of 4 kB every half second
MOST_INTERVALS = 64
"""Most intervals of a stream in a summary; later ones follow once gaps have closed."""
MOST_LOOKS = 1024  # most inter-robot measurements from one submap
_WORD = 2**256
K = TypeVar("K")

Outcome = Literal["new", "known", "replaced"]
TeammateAt = tuple[int, str]  # (stamp, teammate) of an inter-robot measurement


class RefusedError(ValueError):
    """A rejected member; the text names the violated bound."""


@dataclass
class StreamShare:
    """Stored members of one incarnation.

    complete: sequences whose submap is stored with all its inter-robot measurements; count: how
    many from 0 on without a gap. sum: of the complete ones' hashes, modulo 2²⁵⁶.
    """

    start: Member | None = None
    submaps: dict[int, Member] = field(default_factory=dict)
    factors: dict[int, dict[TeammateAt, Member]] = field(default_factory=dict)
    complete: set[int] = field(default_factory=set)
    count: int = 0
    sum: int = 0
    newest_ns: int = 0

    def parcel(self, sequence: int) -> list[Member]:
        """Return a complete submap after its inter-robot measurements."""
        submap, factors = self.submaps[sequence], self.factors.get(sequence, {})
        assert isinstance(submap.message, m.Submap)
        looks = sorted(factors)[: submap.message.sightings]
        return [*(factors[look] for look in looks), submap]

    def note_complete(self, sequence: int) -> None:
        """Count a submap that has just become complete."""
        submap = self.submaps.get(sequence)
        if submap is None or sequence in self.complete:
            return
        assert isinstance(submap.message, m.Submap)
        if len(self.factors.get(sequence, ())) >= submap.message.sightings:
            self.complete.add(sequence)
            self.sum = (self.sum + _sum(self.parcel(sequence))) % _WORD
            self.newest_ns = max(self.newest_ns, submap.message.stamp_ns)
            while self.count in self.complete:
                self.count += 1

    def forget(self, sequence: int) -> None:
        """Remove a replaced member of a submap from the counts."""
        if sequence in self.complete:
            self.complete.discard(sequence)
            self.sum = (self.sum - _sum(self.parcel(sequence))) % _WORD
            self.count = min(self.count, sequence)


class Replica:
    """One peer's copy of the set; replacements: changed members of streams."""

    def __init__(self, robots: Iterable[str], share: int = SHARE) -> None:
        self.robots = tuple(sorted(robots))
        self._share = share
        self._bytes = dict.fromkeys(self.robots, 0)
        self.streams: dict[Stream, StreamShare] = {}
        self.statements: dict[str, dict[tuple[str, int], Member]] = {r: {} for r in self.robots}
        self.replacements = 0
        self._announced: Announcement | None = None

    def add(self, member: Member) -> Outcome:
        """Add a member; raises RefusedError."""
        message = member.message
        robot = about(message)
        if robot.startswith(MAP) and len(self.statements) < len(self.robots) + MOST_MAPS:
            self._bytes.setdefault(robot, 0)
            self.statements.setdefault(robot, {})
        if robot not in self._bytes:
            raise RefusedError(f"of {robot or 'nobody'}, not in this team")
        if self._bytes[robot] + member.size > self._share:
            raise RefusedError(f"the share of {robot} is full: {self._share} bytes")
        if isinstance(message, m.Submap | m.SightingFactor | m.InitialPose):
            stream = robot, message.incarnation
            outcome = self._add_streamed(member, stream)
            self.replacements += outcome == "replaced"
        else:
            outcome = self._add_stated(member, robot)
        if outcome != "known":
            self._bytes[robot] += member.size
            self._announced = None
        return outcome

    def _add_streamed(self, member: Member, stream: Stream) -> Outcome:
        message = member.message
        sequence = getattr(message, "sequence", 0)
        if stream[1] > MOST_LIVES or sequence >= MOST_SEQUENCES:
            raise RefusedError(f"submap {sequence} of incarnation {stream[1]} can not be")
        share = self.streams.get(stream)
        if share is None:
            if sum(robot == stream[0] for robot, _ in self.streams) >= MOST_STREAMS:
                raise RefusedError(f"{stream[0]} has {MOST_STREAMS} incarnations already")
            share = self.streams[stream] = StreamShare()
        match message:
            case m.InitialPose():
                if share.start is not None and share.start.hash <= member.hash:
                    return "known"
                replaced = share.start is not None
                share.start = member
                return "replaced" if replaced else "new"
            case m.Submap():
                return self._put(share, sequence, share.submaps, sequence, member)
            case m.SightingFactor():
                look = message.stamp_ns, message.teammate
                factors = share.factors.setdefault(sequence, {})
                if look not in factors and len(factors) >= MOST_LOOKS:
                    raise RefusedError(
                        f"submap {sequence} of {stream[0]} has {MOST_LOOKS} measurements"
                    )
                return self._put(share, sequence, factors, look, member)
            case _:
                raise RefusedError("no member of a stream")

    def _put(
        self, share: StreamShare, sequence: int, among: dict[K, Member], name: K, member: Member
    ) -> Outcome:
        there = among.get(name)
        if there is not None and there.hash <= member.hash:
            return "known"
        was_complete = sequence in share.complete
        share.forget(sequence)
        among[name] = member
        share.note_complete(sequence)
        return "replaced" if was_complete else "new"

    def _add_stated(self, member: Member, robot: str) -> Outcome:
        name = _stated(member.message)
        serial = getattr(member.message, "serial", 0)
        if serial > MOST_COUNT:
            raise RefusedError(
                f"conclusion {serial} of {robot}; no peer has more than {MOST_COUNT}"
            )
        among = self.statements[robot]
        there = among.get(name)
        if there is not None and _rank(there) >= _rank(member):
            return "known"
        verdict = name[0] == "verdict"
        most = MOST_VERDICTS if verdict else MOST_STATEMENTS
        alike = sum((kind == "verdict") == verdict for kind, _ in among)
        if there is None and alike >= most:
            what = "verdicts" if verdict else "statements"
            raise RefusedError(f"{most} {what} about {robot} are stored already")
        among[name] = member
        return "new" if there is None else "replaced"

    # Contents.

    def share_of(self, stream: Stream) -> StreamShare:
        """Return the stored members of a stream."""
        return self.streams.get(stream) or StreamShare()

    @property
    def submaps(self) -> int:
        """Number of complete submaps."""
        return sum(len(share.complete) for share in self.streams.values())

    @property
    def concluded(self) -> dict[str, m.Concluded]:
        """Conclusions of the peers with a final map, by robot."""
        found = {robot: each.get(("concluded", 0)) for robot, each in self.statements.items()}
        messages = {robot: each.message for robot, each in found.items() if each is not None}
        return {r: each for r, each in messages.items() if isinstance(each, m.Concluded)}

    def certificates_of(self, robot: str) -> Iterator[bytes]:
        """Yield the certificates of a robot."""
        for member in self.statements.get(robot, {}).values():
            if isinstance(member.message, m.Certificate):
                yield member.message.certificate

    def members(self) -> Iterator[Member]:
        """Yield every member, in an order that a fold accepts."""
        for stream in sorted(self.streams):
            share = self.streams[stream]
            if share.start is not None:
                yield share.start
            for sequence in sorted(share.submaps.keys() | share.factors.keys()):
                factors = share.factors.get(sequence, {})
                yield from (factors[look] for look in sorted(factors))
                if sequence in share.submaps:
                    yield share.submaps[sequence]
        yield from self.stated()

    def stated(self) -> Iterator[Member]:
        """Yield the statements by robot and name."""
        for _, statements in sorted(self.statements.items()):
            yield from (statements[name] for name in sorted(statements))

    # Summaries.

    def holding(self, stream: Stream) -> m.Holding | None:
        """Return a stream's holding; None where nothing can be requested."""
        share = self.share_of(stream)
        if share.start is None and not share.complete:
            return None
        return m.Holding(
            robot=stream[0],
            incarnation=stream[1],
            start=share.start is not None,
            sequences=intervals((k for k in share.complete if k >= share.count), share.count),
            digest=_digest(share.sum, () if share.start is None else (share.start,)),
            newest_ns=share.newest_ns,
        )

    @property
    def digest(self) -> bytes:
        """Digest of the summary: equal digests mean equal sets."""
        return self.announcement.digest

    def summary(self, node: str, serial: int, stamp_ns: int) -> m.SetSummary:
        """Make a summary of the set."""
        announced = self.announcement
        return m.SetSummary(
            stamp_ns=stamp_ns,
            node=node,
            serial=serial,
            digest=announced.digest,
            holdings=tuple(announced.holdings.values()),
            statements=tuple(announced.statements.values()),
        )

    @property
    def announcement(self) -> "Announcement":
        """The contents of a summary, cached until a member arrives."""
        if self._announced is None:
            found = ((stream, self.holding(stream)) for stream in sorted(self.streams))
            holdings = {stream: each for stream, each in found if each is not None}
            statements = {
                robot: m.Statements(robot=robot, count=len(of), digest=_digest(0, of.values()))
                for robot, of in sorted(self.statements.items())
                if of
            }
            digests = [
                *(h.digest for h in holdings.values()),
                *(s.digest for s in statements.values()),
            ]
            whole = blake2b(b"".join(digests), 8)
            self._announced = Announcement(whole, holdings, statements)
        return self._announced


class Announcement(NamedTuple):
    """Contents of a summary."""

    digest: bytes
    holdings: dict[Stream, m.Holding]
    statements: dict[str, m.Statements]


_KINDS = {
    m.Done: "done",
    m.SavedMap: "map",
    m.Withdrawal: "withdrawal",
    m.GivenUp: "given_up",
    m.Concluded: "concluded",
    m.Certificate: "certificate",
    m.Verdict: "verdict",
}


def _stated(message: m.Message) -> tuple[str, int]:
    kind = _KINDS.get(type(message))
    if kind is None:
        raise RefusedError(f"a {type(message).__name__} is no member of the set")
    match message:
        case m.Done():
            return kind, message.incarnation
        case m.Certificate():
            named = message.certificate
        case m.Verdict():
            named = f"{message.judgement} {message.withdrawn}".encode()
        case _:
            return kind, 0
    return kind, int.from_bytes(blake2b(named, 16))


def _rank(member: Member) -> tuple[int, bytes]:
    serial = member.message.serial if isinstance(member.message, m.Concluded) else 0
    return serial, bytes(255 - byte for byte in member.hash)


def intervals(sequences: Iterable[int], count: int) -> tuple[int, ...]:
    """Return first, last, … of the first MOST_INTERVALS intervals of 0 … count − 1 and others."""
    found = IntervalSet()
    found.add(0, count - 1)
    for each in sorted(sequences):
        found.add(each, each)
    return tuple(chain.from_iterable(islice(found, MOST_INTERVALS)))


def _sum(members: Iterable[Member]) -> int:
    return sum(int.from_bytes(member.hash, "little") for member in members)


def _digest(total: int, members: Iterable[Member]) -> bytes:
    total = (total + _sum(members)) % _WORD
    return blake2b(total.to_bytes(32, "little"), 8)
