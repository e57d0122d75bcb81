"""Which of two messages of a `latest` channel is the newer one: by what they say, not by arrival.

Zenoh orders one publisher's samples on one key. A centre that was started again, a late joiner's
cache and a repeated answer bring older ones behind newer ones all the same, and a robot that takes
them steps back. Each order here is total, so that receivers that hear the same messages in any
order end with the same one.
"""

from collections.abc import Sequence

from team.wire import messages as m

SetOrder = tuple[int, int, tuple[tuple[str, int, int], ...]]


def set_order(heard: int, members: Sequence[m.VersionEntry]) -> SetOrder:
    """Of two sets the later one: that of the centre that had heard more, then the larger one.

    What a centre has heard only grows, whomever it withdraws or acquits; among equals a set that
    holds another one is the larger.
    """
    vector = tuple(sorted((each.robot, each.incarnation, each.sequence) for each in members))
    return heard, sum(each.sequence + 1 for each in members), vector


def is_newer_prior(new: m.Prior, held: m.Prior | None) -> bool:
    """By the incarnation, by the set, then by how far the robot's own submaps are in it."""

    def order(prior: m.Prior) -> tuple[int, SetOrder, int]:
        return prior.incarnation, set_order(prior.heard, prior.members), prior.sequence

    return held is None or order(new) > order(held)


def is_newer_map(new: m.FusedMap, held: m.FusedMap | None) -> bool:
    """The final one is the last; else by the round, by the set, and a settled one of equal sets."""

    def order(fused: m.FusedMap) -> tuple[bool, int, SetOrder, bool]:
        members = set_order(fused.heard, fused.members)
        return fused.final, fused.exchange, members, not fused.provisional

    return held is None or order(new) > order(held)


def further(new: m.Progress, held: m.Progress | None) -> m.Progress:
    """How far a robot has come by both: it goes over what it has said before, never behind it.

    Started again it says less than in its earlier life, whose words are true still: the same
    measurements give the same submaps.
    """
    if held is None or new.incarnation > held.incarnation:
        return new
    if new.incarnation < held.incarnation:
        return held
    return m.Progress(
        stamp_ns=max(new.stamp_ns, held.stamp_ns),
        node=new.node,
        robot=new.robot,
        incarnation=new.incarnation,
        measurements=max(new.measurements, held.measurements),
        submaps=max(new.submaps, held.submaps),
    )


def later_end(new: m.End, held: m.End | None) -> m.End:
    """Each stream's last counter by whichever says more of it; the newer one's notes."""
    if held is None:
        return new
    streams = {each.robot: each for each in held.streams}
    for each in new.streams:
        before = streams.get(each.robot)
        if before is None or (each.incarnation, each.measurements) > (
            before.incarnation,
            before.measurements,
        ):
            streams[each.robot] = each
    ordered = tuple(streams[robot] for robot in sorted(streams))
    return m.End(stamp_ns=max(new.stamp_ns, held.stamp_ns), streams=ordered, notes=new.notes)


def later_head(new: m.StreamHead, held: m.StreamHead | None) -> m.StreamHead:
    """Whichever says more of the stream; of equals the newer word on whether it goes on."""

    def order(head: m.StreamHead) -> tuple[int, int, bool]:
        return head.incarnation, head.measurements, head.state == "ended"

    return new if held is None or order(new) >= order(held) else held
