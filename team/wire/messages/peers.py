"""What peers say of the team's set, and what proves who said what."""

from typing import Annotated

import msgspec
from msgspec import Meta

from team.wire.messages.base import Count, Digest, Message, Name, StampNs, Text


class Holding(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """What a node has of one stream: whether its initial pose, and which submaps, each with all
    inter-robot measurements from it.

    sequences: first, last, first, last, … of closed intervals, ascending, with gaps between them.
    digest: of what is there, whatever the order in which it came. newest_ns: the end of the newest.
    """

    robot: Name
    incarnation: Count
    start: bool
    sequences: tuple[Count, ...]
    digest: Digest
    newest_ns: StampNs = 0


class Statements(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """How many orders and last words about a robot a node has, and their digest."""

    robot: Name
    count: Count
    digest: Digest


class SetSummary(Message, frozen=True, kw_only=True, tag="set_summary/1"):
    """What a peer has of the team's set, so that others can ask for what they lack.

    serial: counts the summaries of this process. digest: of all of it; equal digests are equal
    sets. holdings: by robot and incarnation, statements: by robot, both ascending.
    """

    node: Text
    serial: Count
    digest: Digest
    holdings: tuple[Holding, ...]
    statements: tuple[Statements, ...]

    def check(self) -> None:  # noqa: D102
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
    """Of one stream: its initial pose if `start`, and submaps first … last (none: last < first)."""

    robot: Name
    incarnation: Count
    start: bool
    first: Count
    last: int


class MembersRequest(Message, frozen=True, kw_only=True, tag="members_wanted/1"):
    """A query to a peer for members of the set. node: who asks.

    statements: the robots of whom all orders and last words are wanted.
    """

    node: Text
    requested: tuple[Requested, ...]
    statements: tuple[Name, ...] = ()


class Members(Message, frozen=True, kw_only=True, tag="members/1"):
    """Members of the set as `node` has them: the key and the very bytes of who first said each.

    signatures: of each, by who said it; empty where the team has no keys.
    """

    node: Text
    keys: tuple[Text, ...]
    payloads: tuple[bytes, ...]
    signatures: tuple[bytes, ...]

    def check(self) -> None:  # noqa: D102
        if not len(self.keys) == len(self.payloads) == len(self.signatures):
            raise ValueError("wrong length: keys, payloads and signatures")


class FoldRequest(Message, frozen=True, kw_only=True, tag="fold_wanted/1"):
    """A query to a peer that folds on request: the map of the set as it is there now."""


class Certificate(Message, frozen=True, kw_only=True, tag="certificate/1"):
    """A robot's certificate (DER), by which its signatures can be checked: a member of the set."""

    robot: Name
    certificate: Annotated[bytes, Meta(min_length=1, max_length=8192)]


class Signature(Message, frozen=True, kw_only=True, tag="signature/1"):
    """A signature of a member, by who said it, for whoever carries it: a robot's, or an operator's.

    robot: that the member is about. member: 32 bytes, the BLAKE2b of the key's length (2 bytes,
    little-endian), key and payload. signature: an operator's stands behind its certificate (DER),
    and this behind its length (2 bytes, little-endian).
    """

    robot: Name
    member: Annotated[bytes, Meta(min_length=32, max_length=32)]
    signature: Annotated[bytes, Meta(min_length=1, max_length=8192)]


class Concluded(Message, frozen=True, kw_only=True, tag="concluded/1"):
    """A peer has the final map of its own fold. digest: its set's. sha256: of the map's payload.

    submaps: in its set. serial: counts the peer's final maps: one of a set that has grown since
    is another one. A member of the set, on which no map rests.
    """

    robot: Name
    serial: Count
    digest: Digest
    sha256: Annotated[bytes, Meta(min_length=32, max_length=32)]
    submaps: Count
