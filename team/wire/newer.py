"""Decides which of two messages of a `latest` channel is newer: by their contents, not by arrival.

Zenoh orders the samples of one publisher on one key. Even so, a restarted centre, a late joiner's
cache and a repeated reply deliver older messages after newer ones, and a robot that used them would
go back in time. Each order here is total, so that receivers of the same messages end with the same
message, in whatever order they arrive.
"""

from collections.abc import Sequence

from team.wire import messages as m

SetOrder = tuple[int, int, int, tuple[tuple[str, int, int], ...]]


def set_order(received: int, withdrawn: int, members: Sequence[m.VersionEntry]) -> SetOrder:
    """Sort key of a set: first the number of submaps that the centre had received, then the number
    of withdrawn robots, then the set's size.

    The number of received submaps only grows, whichever robots are withdrawn or reinstated. With
    the same submaps the fold may still withdraw a robot, as further ticks close, but reinstates
    none; of sets with equal numbers the larger one contains the other.
    """
    vector = tuple(sorted((each.robot, each.incarnation, each.sequence) for each in members))
    return received, withdrawn, sum(each.sequence + 1 for each in members), vector


def is_newer_prior(new: m.Prior, known: m.Prior | None) -> bool:
    """Compares incarnation, then set, then the robot's own number of submaps in the set."""

    def order(prior: m.Prior) -> tuple[int, SetOrder, int]:
        members = set_order(prior.heard, prior.withdrawn, prior.members)
        return prior.incarnation, members, prior.sequence

    return known is None or order(new) > order(known)


def is_newer_map(new: m.FusedMap, known: m.FusedMap | None) -> bool:
    """Compares: a final map is the newest; then exchange, then set, and a complete map before a
    provisional one.
    """

    def order(fused: m.FusedMap) -> tuple[bool, int, SetOrder, bool]:
        members = set_order(fused.heard, len(fused.withdrawn), fused.members)
        return fused.final, fused.exchange, members, not fused.provisional

    return known is None or order(new) > order(known)


def further(new: m.Progress, known: m.Progress | None) -> m.Progress:
    """The robot's progress as the larger numbers of both messages; of a newer incarnation, that
    message.

    A restarted process first reports smaller numbers than in its earlier life. The larger ones
    remain true: the same measurements give the same submaps.
    """
    if known is None or new.incarnation > known.incarnation:
        return new
    if new.incarnation < known.incarnation:
        return known
    return m.Progress(
        stamp_ns=max(new.stamp_ns, known.stamp_ns),
        node=new.node,
        robot=new.robot,
        incarnation=new.incarnation,
        measurements=max(new.measurements, known.measurements),
        submaps=max(new.submaps, known.submaps),
    )


def later_end(new: m.End, known: m.End | None) -> m.End:
    """The end of the streams by the larger counter of each stream in both messages; notes of
    `new`.
    """
    if known is None:
        return new
    streams = {each.robot: each for each in known.streams}
    for each in new.streams:
        before = streams.get(each.robot)
        if before is None or (each.incarnation, each.measurements) > (
            before.incarnation,
            before.measurements,
        ):
            streams[each.robot] = each
    ordered = tuple(streams[robot] for robot in sorted(streams))
    return m.End(stamp_ns=max(new.stamp_ns, known.stamp_ns), streams=ordered, notes=new.notes)


def later_head(new: m.StreamHead, known: m.StreamHead | None) -> m.StreamHead:
    """The message with the larger counter; of equal ones the newer, unless only the other says
    "ended".
    """

    def order(head: m.StreamHead) -> tuple[int, int, bool]:
        return head.incarnation, head.measurements, head.state == "ended"

    return new if known is None or order(new) >= order(known) else known
