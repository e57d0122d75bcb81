"""Order of members for a fold: orders, streams by time, `Done`, robots given up."""

from collections.abc import Iterator

from teamslam.team.peers.replica import Replica
from teamslam.team.store import Stream
from teamslam.team.wire import messages as m


def feed_order(message: m.Message) -> int:
    """Rank of a statement in a fold's input: before the streams (negative) or after them."""
    match message:
        case m.Withdrawal() | m.Verdict() | m.SavedMap():
            return -1
        case m.GivenUp():  # a given-up robot whose stream has ended is complete
            return 2
        case _:
            return 1


def new_of_streams(replica: Replica, fed: dict[Stream, int]) -> Iterator[m.Message]:
    """Yield members of streams that `fed` does not count yet: initial poses, then submaps by end
    time, each after its inter-robot measurements.

    A fold in the order of time undoes nothing.
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
