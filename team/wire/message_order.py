"""The order of messages of `latest` channels, by content instead of arrival.

A restarted centre, a late joiner's cache and a repeated reply deliver older messages after newer
ones. Each order is total.
"""

from collections.abc import Sequence

import msgspec

from teamslam.team.wire import messages as m

SetOrder = tuple[int, int, int, tuple[tuple[str, int, int], ...]]


def set_order(received: int, withdrawn: int, members: Sequence[m.VersionEntry]) -> SetOrder:
    """Return the sort key of a set: number of received submaps, of withdrawn robots, and size.

    The first only grows; with the same submaps the fold may withdraw robots, but reinstates none;
    of sets with equal numbers the larger contains the other.
    """
    vector = tuple(sorted((each.robot, each.incarnation, each.sequence) for each in members))
    return received, withdrawn, sum(each.sequence + 1 for each in members), vector


def is_newer_prior(new: m.Prior, known: m.Prior | None) -> bool:
    """Compare priors by incarnation, then set, then the robot's number of submaps in the set."""

    def order(prior: m.Prior) -> tuple[int, SetOrder, int]:
        members = set_order(prior.heard, prior.withdrawn, prior.members)
        return prior.incarnation, members, prior.sequence

    return known is None or order(new) > order(known)


def is_newer_map(new: m.FusedMap, known: m.FusedMap | None) -> bool:
    """Compare maps: final, exchange, set, complete before provisional."""

    def order(fused: m.FusedMap) -> tuple[bool, int, SetOrder, bool]:
        members = set_order(fused.heard, len(fused.withdrawn), fused.members)
        return fused.final, fused.exchange, members, not fused.provisional

    return known is None or order(new) > order(known)


def merge_progress(new: m.Progress, known: m.Progress | None) -> m.Progress:
    """Return the larger numbers of both, since a restarted process first reports smaller ones."""
    if known is None or new.incarnation > known.incarnation:
        return new
    if new.incarnation < known.incarnation:
        return known
    counts = ("stamp_ns", "measurements", "submaps")
    larger = {count: max(getattr(new, count), getattr(known, count)) for count in counts}
    return msgspec.structs.replace(new, **larger)


def merge_ends(new: m.End, known: m.End | None) -> m.End:
    """Return the end with the larger counter of each stream; notes of `new`."""
    if known is None:
        return new

    def counter(end: m.StreamEnd) -> tuple[int, int]:
        return end.incarnation, end.measurements

    streams: dict[str, m.StreamEnd] = {}
    for each in (*known.streams, *new.streams):
        streams[each.robot] = max(streams.get(each.robot, each), each, key=counter)
    ordered = tuple(streams[robot] for robot in sorted(streams))
    return m.End(stamp_ns=max(new.stamp_ns, known.stamp_ns), streams=ordered, notes=new.notes)


def later_head(new: m.StreamHead, known: m.StreamHead | None) -> m.StreamHead:
    """Return the message with the larger counter; of equal ones "ended", else the newer."""

    def order(head: m.StreamHead) -> tuple[int, int, bool]:
        return head.incarnation, head.measurements, head.state == "ended"

    return new if known is None or order(new) >= order(known) else known
