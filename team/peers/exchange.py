"""Requests between peers, given the other's summary, and their answers."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from itertools import islice

from teamslam.team.config import MAP
from teamslam.team.door import MOST_LIVES
from teamslam.team.peers.members import Member
from teamslam.team.peers.replica import (
    MOST_INTERVALS,
    MOST_MAPS,
    MOST_SEQUENCES,
    MOST_STREAMS,
    Replica,
    intervals,
)
from teamslam.team.store import Stream
from teamslam.team.wire import messages as m

MOST_REQUESTED = 64  # most intervals per request
MOST_ASKED = 512  # most submaps per request
ANSWER_BYTES = 1 * 2**20  # most bytes of members per answer, unless a single member is larger
BATCH_BYTES = 64 * 2**10  # bytes of members per message of an answer


def make_request(
    replica: Replica, summary: m.SetSummary, not_now: Collection[tuple[Stream, int]] = ()
) -> m.MembersRequest | None:
    """Request the members in a summary that this replica lacks; None: there are none.

    not_now: (stream, sequence) requested recently. A stream with equal sequences and another digest
    is requested whole.
    """
    if summary.digest == replica.digest:
        return None
    found: list[m.Requested] = []
    asked = 0
    for each in summary.holdings:
        if each.robot not in replica.robots or each.incarnation > MOST_LIVES:
            continue
        stream = each.robot, each.incarnation
        share = replica.share_of(stream)
        start = each.start and share.start is None and (stream, -1) not in not_now
        lacking = (
            k
            for first, last in _pairs(each.sequences)
            for k in range(max(first, share.count), min(last + 1, MOST_SEQUENCES))
            if k not in share.complete and (stream, k) not in not_now
        )
        lacks = list(islice(lacking, max(MOST_ASKED - asked, 0)))
        if not lacks and not start and _contradicts(replica, each) and (stream, -2) not in not_now:
            lacks, start = sorted(share.complete)[:MOST_ASKED], each.start
        asked += len(lacks)
        spans = _pairs(intervals(set(lacks), 0)) or ([(0, -1)] if start else [])
        for i, (first, last) in enumerate(spans[:MOST_REQUESTED]):
            found.append(
                m.Requested(
                    robot=each.robot,
                    incarnation=each.incarnation,
                    start=start and i == 0,
                    first=first,
                    last=last,
                )
            )
    stated = replica.announcement.statements
    statements = tuple(
        each.robot
        for each in summary.statements
        if (each.robot in replica.robots or each.robot.startswith(MAP))
        and each.digest != getattr(stated.get(each.robot), "digest", None)
        and ((each.robot, 0), -3) not in not_now
    )
    if not found and not statements:
        return None
    return m.MembersRequest(
        stamp_ns=summary.stamp_ns,
        node="",
        requested=tuple(found[:MOST_REQUESTED]),
        statements=statements,
    )


def is_oversized(replica: Replica, summary: m.SetSummary) -> bool:
    """Return whether a summary exceeds the bounds of this team's set."""
    return (
        len(summary.holdings) > MOST_STREAMS * len(replica.robots)
        or len(summary.statements) > len(replica.robots) + MOST_MAPS
        or any(len(each.sequences) > 2 * MOST_INTERVALS for each in summary.holdings)
    )


def list_requested(request: m.MembersRequest) -> Iterator[tuple[Stream, int]]:
    """Yield the (stream, sequence) of a request, as in `not_now`."""
    for each in request.requested:
        stream = each.robot, each.incarnation
        yield stream, -2
        if each.start:
            yield stream, -1
        yield from ((stream, k) for k in range(each.first, each.last + 1))
    yield from (((robot, 0), -3) for robot in request.statements)


def _contradicts(replica: Replica, holding: m.Holding) -> bool:
    stream = holding.robot, holding.incarnation
    mine = replica.announcement.holdings.get(stream)
    same = mine is not None and (mine.start, mine.sequences) == (holding.start, holding.sequences)
    return same and mine is not None and mine.digest != holding.digest


def make_answer(
    replica: Replica,
    request: m.MembersRequest,
    node: str,
    sign: Callable[[Member], bytes] | None = None,
) -> list[m.Members]:
    """Answer a request in batches, statements first; with keys (`sign`), signed members only."""
    batches: list[list[Member]] = [[]]
    total = size = 0
    for each in _list_members(replica, request):
        member = each if sign is None else replace(each, signature=sign(each))
        proven = bool(member.signature) or isinstance(member.message, m.Certificate)
        if sign is not None and not proven:
            continue
        if total and total + member.size > ANSWER_BYTES:
            break
        if batches[-1] and size + member.size > BATCH_BYTES:
            batches.append([])
            size = 0
        batches[-1].append(member)
        total, size = total + member.size, size + member.size
    return [
        m.Members(
            stamp_ns=request.stamp_ns,
            node=node,
            keys=tuple(each.key for each in batch),
            payloads=tuple(each.payload for each in batch),
            signatures=tuple(each.signature for each in batch),
        )
        for batch in batches
        if batch
    ]


def _list_members(replica: Replica, request: m.MembersRequest) -> Iterator[Member]:
    for robot in dict.fromkeys(request.statements):
        found = replica.statements.get(robot, {})
        yield from (found[name] for name in sorted(found))
    for each in request.requested[:MOST_REQUESTED]:
        share = replica.streams.get((each.robot, each.incarnation))
        if share is None:
            continue
        if each.start and share.start is not None:
            yield share.start
        for sequence in range(each.first, min(each.last, each.first + MOST_ASKED) + 1):
            if sequence in share.complete:
                yield from share.parcel(sequence)


def _pairs(ends: Sequence[int]) -> list[tuple[int, int]]:
    return list(zip(ends[::2], ends[1::2], strict=True))
