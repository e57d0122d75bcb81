"""Messages of any process, on its state; operators' orders; the exchange of the team's set."""

from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.team.wire.messages.base import (
    Author,
    Count,
    Digest,
    Document,
    Message,
    Name,
    Real,
    StampNs,
    Text,
)


class Configuration(Message, frozen=True, kw_only=True, tag="configured/1"):
    """A node's configuration (JSON); `digest` is its 8-byte name elsewhere."""

    node: Text
    incarnation: Count
    digest: Digest
    configuration: Document


class Progress(Message, frozen=True, kw_only=True, tag="progress/1"):
    """Counts of measurements and submaps of a stream that a node has handled.

    A robot reports consumed measurements (during an exchange of maps: received ones); it sends no
    further submap before stamp_ns. The centre reports submaps in its set, the recorder recorded
    measurements.
    """

    node: Text
    robot: Name
    incarnation: Count
    measurements: Count
    submaps: Count


class Status(Message, frozen=True, kw_only=True, tag="status/1"):
    """State, figures and warnings of a node, for people.

    run: id of the recorder's log, which names the run; empty from other nodes.
    """

    node: Text
    state: Text
    figures: dict[str, Real]
    warnings: tuple[Text, ...] = ()
    run: Text = ""


class Fault(Message, frozen=True, kw_only=True, tag="fault/1"):
    """A message that a node could not handle and set aside; stamp_ns is the message's.

    origin: its key, or the query's for a reply, or the name of a duty without message. count: the
    publisher's counter of the key; −1: none. message: its tag; empty before it was decoded. error,
    text: the exception's class and text. place: module:function:line. digest: 8 bytes, the
    payload's BLAKE2b.
    """

    node: Text
    origin: Text
    count: Annotated[int, Meta(ge=-1, le=2**63 - 1)]
    message: Text
    error: Text
    text: Text
    place: Text
    digest: Digest


class Liveliness(Message, frozen=True, kw_only=True, tag="liveliness/1"):
    """Appearance or loss of a node's liveliness token; recorded as an input of other nodes."""

    node: Text
    alive: bool


class Tally(Message, frozen=True, kw_only=True, tag="tally/1"):
    """Number of messages that a process has published on each key, at its end.

    since_ns: the process's wall clock at its beginning [ns since 1970].
    """

    node: Text
    since_ns: StampNs
    keys: tuple[Text, ...]
    counts: tuple[Count, ...]

    def check(self) -> None:
        if len(self.keys) != len(self.counts):
            raise ValueError(f"{len(self.counts)} counts of {len(self.keys)} keys")


class KeptRequest(Message, frozen=True, kw_only=True, tag="kept_wanted/1"):
    """Query to the router for stored samples, newest last.

    channels: their names. node: the requesting node. run_ns: age of its run; ends of a team are
    sent if they are younger, or if a process of this node was in that run and left without a
    `Tally`.
    """

    channels: tuple[Text, ...]
    node: Text = ""
    run_ns: Count = 0


class Kept(Message, frozen=True, kw_only=True, tag="kept/1"):
    """A stored sample of the router, with its attachment, as its author published it."""

    key: Text
    payload: bytes
    wall_ns: StampNs
    counter: Count


class Withdrawal(Message, frozen=True, kw_only=True, tag="withdrawal/1"):
    """Withdrawal of a robot or of a saved map, for good; a member of the set.

    The map is that of the set without the robot's submaps and inter-robot factors. by: "operator"
    or "central".
    """

    robot: Author
    by: Text
    reason: Text


class WithdrawalHeard(Message, frozen=True, kw_only=True, tag="withdrawal_heard/1"):
    """An order to withdraw `withdrawn` that `robot` repeated, in logs of earlier versions.

    No node publishes or receives it.
    """

    robot: Name
    withdrawn: Name
    by: Text
    reason: Text


class LocalLandmark(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """An unnamed landmark of submap (robot, incarnation, sequence): its number is 2³¹ + `local`."""

    robot: Author
    incarnation: Count
    sequence: Count
    local: Annotated[int, Meta(ge=0, lt=2**31)]


class Judgement(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Statement that two local landmarks are one, or two."""

    first: LocalLandmark
    second: LocalLandmark
    same: bool


class Verdict(Message, frozen=True, kw_only=True, tag="verdict/1"):
    """An operator's statement that two local landmarks are one, or two; a member of the set.

    Of contradicting verdicts "two" holds. robot: that of the first landmark. withdrawn: this
    judgement is taken back, for good.
    """

    robot: Author
    judgement: Judgement
    by: Text
    reason: Text
    withdrawn: bool = False

    def check(self) -> None:
        if self.judgement.first == self.judgement.second:
            raise ValueError("out of bounds: a verdict on one landmark and itself")
        if self.robot != self.judgement.first.robot:
            raise ValueError("out of bounds: a verdict in the name of another robot")


class GivenUp(Message, frozen=True, kw_only=True, tag="given_up/1"):
    """Order that no process waits for a node.

    The final map names a robot with missing data as lost. by: "operator", "launch" or "central".
    """

    node: Text
    by: Text
    reason: Text


class TeamEnd(Message, frozen=True, kw_only=True, tag="team_end/1"):
    """Order that ends all streams of a live team."""

    by: Text
    reason: Text


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
