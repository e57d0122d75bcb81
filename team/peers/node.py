"""Replicate the team's set between peers, over third robots, too.

A node publishes a summary, requests the members that it lacks, and answers requests.
"""

from collections import Counter
from collections.abc import Iterator, Sequence

import msgspec

from teamslam.team.peers.exchange import is_oversized, list_requested, make_answer, make_request
from teamslam.team.peers.members import CHANNELS, Member, member_of
from teamslam.team.peers.proofs import Proofs
from teamslam.team.peers.replica import RefusedError, Replica
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.codec import WireError, decoded, encoded

GIVEN_BYTES = 32 * 2**20  # most bytes of members per second, to all nodes together


def feed_order(message: m.Message) -> int:
    """Rank a statement in a fold's input: before the streams (negative) or after them."""
    match message:
        case m.Withdrawal() | m.Verdict() | m.SavedMap():
            return -1
        case m.GivenUp():  # a given-up robot whose stream has ended is complete
            return 2
        case _:
            return 1


def new_of_streams(replica: Replica, fed: dict[Stream, int]) -> Iterator[m.Message]:
    """Yield members of streams beyond the counts `fed` in the order of time, each submap after its
    inter-robot measurements.
    """
    parcels: list[tuple[int, Stream, int]] = []
    for stream, share in sorted(replica.streams.items()):
        given = fed.get(stream, -1)
        if share.start is None or given >= share.count:
            continue
        if given < 0:
            yield share.start.message
        latest_ns = 0
        for sequence in range(max(given, 0), share.count):
            latest_ns = max(latest_ns, share.submaps[sequence].message.stamp_ns)
            parcels.append((latest_ns, stream, sequence))
        fed[stream] = share.count
    for _, stream, sequence in sorted(parcels):
        yield from (member.message for member in replica.streams[stream].parcel(sequence))


SUMMARY_S = 1.0  # shortest interval [s] between two summaries
LAST_S = 0.2  # the same once all have concluded: peers compare their maps and leave soon
REPEAT_S = 10.0  # longest interval [s], for a node whose appearance was not noticed
PATIENCE_S = 3.0  # time [s] after which an unanswered request goes to another node
FRESH_S = 25.0  # age [s] beyond which a summary does not prove reach
MOST_OPEN = 16_384  # most open requests per node


class PeerNode:
    """One node's copy of the set, and its exchange with other nodes.

    carried: new members by node. proofs: None: every node is trusted. unsaved: new members.
    """

    listens: tuple[ch.Channel, ...] = (*CHANNELS, ch.SET_SUMMARY)

    def __init__(self, node: str, robots: Sequence[str], proofs: Proofs | None = None) -> None:
        self.node = node
        self.replica = Replica(robots)
        self.proofs = proofs
        self._now_s = 0.0
        self._serial = 0
        self._announced_digest: bytes | None = None
        self._announced_s = -REPEAT_S
        self._answer_s: float | None = None
        self._summaries: dict[str, tuple[float, m.SetSummary]] = {}
        self._asked: dict[tuple[Stream, int], tuple[float, str]] = {}
        self._failures: dict[str, int] = {}
        self._given_s = self._given_bytes = 0  # a second, and the bytes sent within it
        self.known = frozenset({*map(ch.robot_node, robots), "central"})
        self._fed: dict[Stream, int] = {}
        self._new_messages: list[m.Message] = []
        self.rebuild = False
        self.carried: Counter[str] = Counter()
        self.refused = 0
        self.last_refused = ""
        self.stamp_ns = 0
        self.unsaved: list[Member] = []

    # Members.

    def take(self, member: Member, carrier: str) -> bool:
        """Take a member from a node; return whether it is new."""
        try:
            outcome = self.replica.add(member)
        except RefusedError as error:
            self._refuse(f"{member.key}: {error}")
            return False
        if outcome == "known":
            return False
        self.carried[carrier] += 1
        self._note_arrival(member.message)
        self.unsaved.append(member)
        self.stamp_ns = max(self.stamp_ns, member.message.stamp_ns)
        if not isinstance(member.message, m.InitialPose | m.Submap | m.SightingFactor):
            self._new_messages.append(member.message)
        elif outcome == "replaced":
            self.rebuild = True
        return True

    def take_sample(self, sample: Sample, carrier: str) -> bool:
        """Take a member's sample; a certificate must be the authority's."""
        member = self._open(sample.key, sample.payload, b"", sample.key, is_carried=False)
        return member is not None and self.take(member, carrier)

    def take_carried(self, carried: m.Members) -> list[Member]:
        """Take members that another node carries; return the new ones."""
        if carried.node not in self.known:
            self._refuse(f"members from {carried.node[:80]}, not in this team")
            return []
        new: list[Member] = []
        rows = zip(carried.keys, carried.payloads, carried.signatures, strict=True)
        for key, payload, signature in rows:
            where = f"{key[:80]} from {carried.node}"
            member = self._open(key, payload, signature, where, is_carried=True)
            if member is not None and self.take(member, carried.node):
                new.append(member)
        return new

    def _open(
        self, key: str, payload: bytes, signature: bytes, where: str, *, is_carried: bool
    ) -> Member | None:
        try:
            member = member_of(key, payload, signature)
        except (WireError, ValueError) as error:
            self._refuse(f"{where}: {error}")
            return None
        is_checked = is_carried or isinstance(member.message, m.Certificate)
        if self.proofs is None or not is_checked:
            return member
        why = self.proofs.refusal(member, self.replica)
        if why is not None:
            self._refuse(f"{where}: {why}")
        return member if why is None else None

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.last_refused = why

    def new_messages(self) -> Iterator[m.Message]:
        """Yield queued messages for the fold: orders first, as it may end with a stream's last
        member.
        """
        statements, self._new_messages = self._new_messages, []
        statements.sort(key=feed_order)
        orders = sum(feed_order(each) < 0 for each in statements)
        yield from statements[:orders]
        yield from new_of_streams(self.replica, self._fed)
        yield from statements[orders:]

    def restart_fold(self) -> None:
        """Queue every stored member for a fresh fold."""
        self.rebuild = False
        self._fed.clear()
        self._new_messages = [member.message for member in self.replica.stated()]

    # Exchange.

    def take_summary(self, summary: m.SetSummary) -> list[Outgoing]:
        """Request a summary's missing members."""
        if summary.node == self.node:
            return []
        if summary.node not in self.known:
            self._refuse(f"a summary of {summary.node[:80]}, not in this team")
            return []
        if is_oversized(self.replica, summary):
            self._refuse(f"a summary of {summary.node} with more than a team can have")
            return []
        self._summaries[summary.node] = self._now_s, summary
        if self._announced_digest is not None and summary.digest != self._announced_digest:
            self.greet()
        return self._request_from(summary)

    def greet(self) -> None:
        """Publish a summary soon, for a node that has appeared."""
        self._answer_s = self._now_s if self._answer_s is None else self._answer_s

    def tick(self, now_s: float) -> list[Outgoing]:
        """Publish a due summary and repeat unanswered requests."""
        self._now_s = now_s
        self._forget_questions()
        out: list[Outgoing] = []
        by_trust = sorted(self._summaries, key=lambda node: self._failures.get(node, 0))
        for received_s, summary in [self._summaries[node] for node in by_trust]:
            if now_s - received_s < FRESH_S and summary.digest != self.replica.digest:
                out += self._request_from(summary)
        since_s = now_s - self._announced_s
        over = self.replica.concluded.keys() >= set(self.replica.robots)
        if since_s < (LAST_S if over else SUMMARY_S):
            return out
        digest = self.replica.digest
        if digest != self._announced_digest or self._answer_s is not None or since_s >= REPEAT_S:
            self._announced_digest, self._announced_s, self._answer_s = digest, now_s, None
            summary = self.replica.summary(self.node, self._serial, self.stamp_ns)
            self._serial += 1
            out.append(Outgoing(ch.SET_SUMMARY, self.node, summary))
        return out

    def _note_arrival(self, message: m.Message) -> None:
        if isinstance(message, m.InitialPose):
            self._asked.pop(((message.robot, message.incarnation), -1), None)
        elif isinstance(message, m.Submap | m.SightingFactor):
            stream = message.robot, message.incarnation
            if not self._lacks(stream, message.sequence):
                self._asked.pop((stream, message.sequence), None)

    def _forget_questions(self) -> None:
        """Let requests expire; nodes that failed to answer are asked last."""
        over = {name: of for name, of in self._asked.items() if of[0] <= self._now_s}
        for node in {node for name, (_, node) in over.items() if self._lacks(*name)}:
            self._failures[node] = self._failures.get(node, 0) + 1
        self._asked = {name: of for name, of in self._asked.items() if name not in over}

    def _lacks(self, stream: Stream, sequence: int) -> bool:
        return sequence >= 0 and sequence not in self.replica.share_of(stream).complete

    def request_rest(self, node: str) -> list[Outgoing]:
        """Request the rest of a summary."""
        received = self._summaries.get(node)
        return [] if received is None else self._request_from(received[1])

    def _request_from(self, summary: m.SetSummary) -> list[Outgoing]:
        if sum(node == summary.node for _, node in self._asked.values()) >= MOST_OPEN:
            return []
        request = make_request(self.replica, summary, self._asked)
        if request is None:
            return []
        until = self._now_s + PATIENCE_S, summary.node
        self._asked |= dict.fromkeys(list_requested(request), until)
        asked = msgspec.structs.replace(request, node=self.node)
        return [Outgoing(ch.MEMBERS, summary.node, asked)]

    def answer(self, request: bytes) -> list[bytes]:
        """Answer a `MembersRequest`; raises WireError."""
        query = decoded(request, m.MembersRequest)
        asker = query.node
        if asker not in self.known:
            self._refuse(f"a request of {asker[:80]}, not in this team")
            return []
        if int(self._now_s) != self._given_s:
            self._given_s, self._given_bytes = int(self._now_s), 0
        if self._given_bytes >= GIVEN_BYTES:
            self._refuse(f"requests for more than {GIVEN_BYTES} bytes a second")
            return []
        sign = None if self.proofs is None else self.proofs.of
        answer = make_answer(self.replica, query, self.node, sign)
        batches = [encoded(batch) for batch in answer]
        self._given_bytes += sum(map(len, batches))
        return batches

    @property
    def agrees(self) -> dict[str, bool]:
        """Whether each node's set equals this one."""
        digest = self.replica.digest
        return {n: s.digest == digest for n, (_, s) in sorted(self._summaries.items())}
