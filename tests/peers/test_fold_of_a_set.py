"""A peer's final map is a function of its set, whatever came first and together with what."""

import random

from central.config import CentralConfig
from central.peers.fold import PeerFold
from team.peers.members import Member
from team.peers.node import PeerNode
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.codec import encoded
from tests.peers.teams import done, member, parcel, start

ROBOTS = ("r1", "r2")
END = m.End(
    stamp_ns=0,
    streams=tuple(m.StreamEnd(robot=r, incarnation=1, measurements=20) for r in ROBOTS),
)
ORDER = m.Withdrawal(stamp_ns=0, robot="r2", by="operator", reason="broken")


def folded(batches: list[list[Member]], ends_after: int) -> m.FusedMap:
    """The final map of a peer that gets its members in these portions."""
    node = PeerNode("robot/r1", ROBOTS)
    fold = PeerFold(CentralConfig(), ROBOTS, node)
    for k, batch in enumerate([*batches, []]):
        if k == ends_after:
            fold.note(END)
        for each in batch:
            node.take(each, "robot/r2")
        fold.grow()
    assert fold.final is not None
    return fold.final


def test_an_order_that_comes_with_the_last_of_a_stream_is_in_the_final_map() -> None:
    """The withdrawn robot is the last by name: its `Done` stood before the order."""
    members = [
        each
        for robot in ROBOTS
        for each in (start(robot), *parcel(robot, 0), *parcel(robot, 1), done(robot, 2))
    ]
    members.append(member(ch.ORDER, ORDER))
    rng = random.Random(1)
    found = set()
    for _ in range(25):
        order = rng.sample(members, len(members))
        cuts = sorted(rng.sample(range(len(members) + 1), rng.randrange(4)))
        batches = [order[a:b] for a, b in zip([0, *cuts], [*cuts, len(order)], strict=True)]
        final = folded(batches, rng.randrange(len(batches) + 1))
        assert final.withdrawn == ("r2",)
        found.add(encoded(final))
    assert len(found) == 1
