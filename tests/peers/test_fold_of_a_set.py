import random

import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.peers.fold import PeerFold
from teamslam.team.peers.members import Member
from teamslam.team.peers.node import PeerNode
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import encoded
from tests import build
from tests.peers.teams import done, member, parcel, start

ROBOTS = ("r1", "r2")
END = build.end(**dict.fromkeys(ROBOTS, 20))
ORDER = member(ch.ORDER, build.withdrawal(robot="r2", reason="broken"))
_GIVEN_UP = build.given_up(node="robot/r2", reason="not seen")
GIVEN_UP = Member(ch.GIVEN_UP.key("robot/r2"), encoded(_GIVEN_UP), _GIVEN_UP)


def folded(batches: list[list[Member]], ends_after: int) -> m.FusedMap:
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


@pytest.mark.parametrize(
    ("extra", "withdrawn"),
    [([ORDER], ("r2",)), ([GIVEN_UP], ()), ([ORDER, GIVEN_UP], ("r2",))],
    ids=["withdrawn", "given up and back", "both"],
)
def test_orders_are_in_the_final_map_whatever_came_with_the_last_of_a_stream(extra, withdrawn):
    """The robot is the last by name: its `Done` precedes the order."""
    members = [
        each
        for robot in ROBOTS
        for each in (start(robot), *parcel(robot, 0), *parcel(robot, 1), done(robot, 2))
    ]
    members += extra
    rng = random.Random(1)
    found = set()
    for _ in range(12):
        order = rng.sample(members, len(members))
        cuts = sorted(rng.sample(range(len(members) + 1), rng.randrange(4)))
        batches = [order[a:b] for a, b in zip([0, *cuts], [*cuts, len(order)], strict=True)]
        final = folded(batches, rng.randrange(len(batches) + 1))
        assert (final.withdrawn, final.lost) == (withdrawn, ())
        found.add(encoded(final))
    assert len(found) == 1


def test_a_fold_is_given_submaps_in_the_order_of_time():
    """Order by robots would restart the fold and cost three times as much."""
    node = PeerNode("robot/r1", ROBOTS)
    for robot in reversed(ROBOTS):
        for each in (done(robot, 3), *parcel(robot, 2), *parcel(robot, 1), *parcel(robot, 0)):
            node.take(each, "robot/r2")
        node.take(start(robot), "robot/r2")
    given = list(node.new_messages())
    submaps = [each for each in given if isinstance(each, m.Submap)]
    assert [each.robot for each in submaps] == ["r1", "r2"] * 3
    assert [each.stamp_ns for each in submaps] == sorted(each.stamp_ns for each in submaps)
    assert all(isinstance(each, m.InitialPose) for each in given[:2])
    assert all(isinstance(each, m.Done) for each in given[-2:])
