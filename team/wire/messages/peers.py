"""Summaries, requests and members of the team's set, and signatures of their authors."""

from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.team.wire.messages.base import Author, Count, Digest, Message, Name, StampNs, Text


class Holding(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Members of one stream that a node has: initial pose, and submaps with their factors.

    sequences: first, last, first, last, … of closed intervals, ascending, with gaps between them.
    digest: of these members, independent of their order. newest_ns: end of the newest submap.
    """

    robot: Name
    incarnation: Count
    start: bool
    sequences: tuple[Count, ...]
    digest: Digest
    newest_ns: StampNs = 0


class Statements(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Number of orders and ends about a robot that a node has, and their digest."""

    robot: Author
    count: Count
    digest: Digest


class SetSummary(Message, frozen=True, kw_only=True, tag="set_summary/1"):
    """Summary of a peer's set, from which others derive their requests.

    serial: number of the summary of this process. digest: equal digests are equal sets. holdings:
    by robot and incarnation, statements: by robot, both ascending.
    """

    node: Text
    serial: Count
    digest: Digest
    holdings: tuple[Holding, ...]
    statements: tuple[Statements, ...]

    def check(self) -> None:
        for holding in self.holdings:
            ends = holding.sequences
            if len(ends) % 2 or any(a > b for a, b in zip(ends[::2], ends[1::2], strict=True)):
                raise ValueError("out of bounds: sequences are no intervals")
            if any(a + 1 >= b for a, b in zip(ends[1::2], ends[2::2], strict=False)):
                raise ValueError("not ascending: sequences")
        streams = [(each.robot, each.incarnation) for each in self.holdings]
        robots = [each.robot for each in self.statements]
        if streams != sorted(set(streams)) or robots != sorted(set(robots)):
            raise ValueError("not ascending: holdings and statements")


class Requested(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Part of a stream: its initial pose if `start`; submaps first … last (none: last < first)."""

    robot: Name
    incarnation: Count
    start: bool
    first: Count
    last: int


class MembersRequest(Message, frozen=True, kw_only=True, tag="members_wanted/1"):
    """Query of `node` to a peer for members of the set.

    statements: the robots about which all orders and ends are requested.
    """

    node: Text
    requested: tuple[Requested, ...]
    statements: tuple[Author, ...] = ()


class Members(Message, frozen=True, kw_only=True, tag="members/1"):
    """Members of the set from `node`: key and bytes of each as its author published it.

    signatures: of each, by its author; empty in a team without keys.
    """

    node: Text
    keys: tuple[Text, ...]
    payloads: tuple[bytes, ...]
    signatures: tuple[bytes, ...]

    def check(self) -> None:
        if not len(self.keys) == len(self.payloads) == len(self.signatures):
            raise ValueError("wrong length: keys, payloads and signatures")


class FoldRequest(Message, frozen=True, kw_only=True, tag="fold_wanted/1"):
    """Query to the centre, or to a peer that folds on request, for the map of its set."""


class Certificate(Message, frozen=True, kw_only=True, tag="certificate/1"):
    """A robot's certificate (DER) for its signatures; a member of the set."""

    robot: Name
    certificate: Annotated[bytes, Meta(min_length=1, max_length=8192)]


class Signature(Message, frozen=True, kw_only=True, tag="signature/1"):
    """Signature of a member by its author, a robot or an operator, for peers that relay it.

    robot: the subject of the member. member: 32 bytes, the BLAKE2b of the key's length (2 bytes,
    little-endian), key and payload. signature: an operator's follows its certificate (DER), and
    this its length (2 bytes, little-endian).
    """

    robot: Name
    member: Annotated[bytes, Meta(min_length=32, max_length=32)]
    signature: Annotated[bytes, Meta(min_length=1, max_length=8192)]


class Concluded(Message, frozen=True, kw_only=True, tag="concluded/1"):
    """The final map of a peer's fold; a member of the set that no map uses.

    digest: of its set. sha256: of the map's payload. submaps: number in its set. serial: number of
    the final map; a set that grows afterwards has another one.
    """

    robot: Name
    serial: Count
    digest: Digest
    sha256: Annotated[bytes, Meta(min_length=32, max_length=32)]
    submaps: Count
