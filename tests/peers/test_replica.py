import random

import msgspec
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.peers.fold import PeerFold
from teamslam.central.peers.robot import PeerRobot
from teamslam.team.config import RobotConfig
from teamslam.team.door import MOST_COUNT
from teamslam.team.peers.exchange import MOST_ASKED, make_request
from teamslam.team.peers.members import LARGEST_MEMBER, Member, member_of
from teamslam.team.peers.node import GIVEN_BYTES, PeerNode
from teamslam.team.peers.replica import MOST_SEQUENCES, RefusedError, Replica
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.peers.teams import Storm, done, member, parcel, start
from tests.support import example

ROBOTS, THREE = ("r1", "r2"), ("r1", "r2", "r3")
REQUEST = encoded(
    build.members_request(node="robot/r2", requested=(build.requested(robot="r2", last=39),))
)


def node_with(name: str, submaps: int) -> PeerNode:
    """A peer of three that has this part of r2's stream."""
    node = PeerNode(name, THREE)
    for each in (start("r2"), *(one for k in range(submaps) for one in parcel("r2", k))):
        node.take(each, "robot/r2")
    return node


def replica_of(*members: Member, share: int = 2**20) -> Replica:
    replica = Replica(ROBOTS, share)
    for each in members:
        replica.add(each)
    return replica


def digest_of(replica: Replica) -> bytes:
    return replica.summary("", 0, 0).digest


def test_who_claims_millions_of_submaps_keeps_nobody_from_what_is_there():
    node, honest = PeerNode("robot/r1", THREE), node_with("robot/r2", 4)
    claim = build.holding(robot="r2", sequences=(0, 2_000_000))
    lie = build.set_summary(node="robot/r3", holdings=(claim,) * 3)
    asked: list[str] = []
    for second in range(12):
        out = [*node.take_summary(lie), *node.tick(float(second))]
        out += node.take_summary(honest.replica.summary("robot/r2", second, 0))
        for each in out:
            if each.channel is ch.MEMBERS:
                asked.append(each.name)
                assert sum(1 + w.last - w.first for w in each.message.requested) <= MOST_ASKED
                if each.name == "robot/r2":
                    for reply in honest.answer(encoded(each.message)):
                        node.take_carried(decoded(reply, m.Members))
    assert asked[0] == "robot/r3"
    assert node.replica.submaps == 4
    stranger = msgspec.structs.replace(lie, node="robot/x9")
    assert node.take_summary(stranger) == []
    assert "not in this team" in node.last_refused


def test_questions_without_end_are_given_so_many_bytes_a_second():
    node = node_with("robot/r1", 40)
    one = sum(map(len, node.answer(REQUEST)))
    node._given_bytes += GIVEN_BYTES
    assert one > 0
    assert node.answer(REQUEST) == []
    node.tick(2.0)
    assert sum(map(len, node.answer(REQUEST))) == one


def test_questions_in_another_nodes_name_take_nothing_from_that_node():
    """Names in requests are not proven: r3's requests as r2 do not count against r2."""
    node = node_with("robot/r1", 40)
    while node._given_bytes < GIVEN_BYTES // 4:  # more than a node is sent in a second
        assert node.answer(REQUEST)
        node._given_bytes += GIVEN_BYTES // 16
    assert node.answer(REQUEST)


def test_a_conclusion_of_a_serial_without_bound_is_refused_and_the_own_next_one_is_valid():
    replica = Replica(ROBOTS)
    last = build.concluded(serial=2**63 - 1)
    with pytest.raises(RefusedError, match="no peer has more than"):
        replica.add(member(ch.CONCLUDED, last))
    node = PeerNode("robot/r1", ROBOTS)
    node.take(member(ch.CONCLUDED, msgspec.structs.replace(last, serial=MOST_COUNT)), "robot/r1")
    fold = PeerFold(CentralConfig(), ROBOTS, node)
    fold.final = example(m.FusedMap)
    concluded = fold.conclusion("r1")
    assert concluded is not None
    assert decoded(encoded(concluded)) == concluded
    replica.add(member(ch.CONCLUDED, concluded))


def test_of_two_members_of_one_name_the_same_stays_whichever_came_first():
    (one,) = parcel("r1", 0)
    assert isinstance(one.message, m.Submap)
    other = member(ch.SUBMAP, msgspec.structs.replace(one.message, gated=7))
    sets = [replica_of(start("r1"), a, b) for a, b in ((one, other), (other, one))]
    assert digest_of(sets[0]) == digest_of(sets[1])
    kept = min((one, other), key=lambda each: each.hash)
    assert all(each.share_of(("r1", 1)).submaps[0] is kept for each in sets)


def test_more_inter_robot_measurements_than_a_submap_says_end_with_equal_sets():
    look, own = parcel("r1", 0, ["r2"])
    assert isinstance(look.message, m.SightingFactor)
    extra = member(ch.SIGHTING_FACTOR, msgspec.structs.replace(look.message, stamp_ns=1))
    orders = ((look, own, extra), (extra, own, look), (extra, look, own))
    assert len({digest_of(replica_of(start("r1"), *order)) for order in orders}) == 1


def test_a_summary_names_gaps_and_what_is_asked_for_is_what_lacks():
    parcels = [parcel("r1", k)[0] for k in range(9)]
    here = replica_of(start("r1"), *(parcels[k] for k in (0, 1, 4, 5, 8)))
    (holding,) = here.summary("", 0, 0).holdings
    assert holding.sequences == (0, 1, 4, 5, 8, 8)
    there = replica_of(*parcels[:7])
    asked = make_request(here, there.summary("robot/r2", 0, 0))
    assert [(w.start, w.first, w.last) for w in asked.requested] == [(False, 2, 3), (False, 6, 6)]
    back = make_request(there, here.summary("robot/r1", 0, 0))
    assert [(w.start, w.first, w.last) for w in back.requested] == [(True, 8, 8)]


def test_a_submap_without_its_inter_robot_measurements_is_not_told_as_here():
    look, own = parcel("r1", 0, ["r2"])
    replica = replica_of(start("r1"), own)
    assert replica.summary("", 0, 0).holdings[0].sequences == ()
    replica.add(look)
    assert replica.summary("", 0, 0).holdings[0].sequences == (0, 0)


def test_what_is_kept_is_bounded_by_robot():
    with pytest.raises(RefusedError, match="of r9, not in this team"):
        replica_of(start("r9"))
    far = msgspec.structs.replace(parcel("r1", 0)[0].message, sequence=MOST_SEQUENCES)
    with pytest.raises(RefusedError, match="can not be"):
        replica_of(member(ch.SUBMAP, far))
    first, second, third = (parcel("r1", k)[0] for k in range(3))
    full = replica_of(first, second, share=first.size + second.size)
    with pytest.raises(RefusedError, match="the share of r1 is full"):
        full.add(third)
    assert full.add(start("r2")) == "new"


def test_what_is_no_member_is_refused_at_the_door():
    progress = build.progress(measurements=1)
    with pytest.raises(ValueError, match="no key of a set's members"):
        member_of("robot/r1/progress", encoded(progress))
    with pytest.raises(ValueError, match="too large"):
        member_of("robot/r1/submap", bytes(LARGEST_MEMBER + 1))
    own = done("r1", 1)
    with pytest.raises(ValueError, match="a message of 'r1' on the key"):
        member_of("robot/r2/done", own.payload)


def test_verdicts_are_members_each_of_its_own_and_so_is_that_one_is_withdrawn():
    first, second = (
        m.LocalLandmark(robot=robot, incarnation=1, sequence=0, local=3) for robot in ROBOTS
    )
    told = [
        member(ch.VERDICT, build.verdict(first, second, same=same, withdrawn=withdrawn))
        for same, withdrawn in ((True, False), (False, False), (True, True))
    ]
    one, other = replica_of(*told), replica_of(*reversed(told), told[0])
    assert digest_of(one) == digest_of(other)
    assert {each.payload for each in one.members()} == {each.payload for each in told}
    assert make_request(replica_of(*told[:2]), one.summary("n", 0, 0)) is not None


ORDERS = {
    "given up": (ch.GIVEN_UP, build.given_up(node="robot/r3", reason="lost")),
    "withdrawn": (ch.ORDER, build.withdrawal(robot="r3", reason="broken")),
}


def ended(robot: str) -> Sample:
    return member(ch.CONCLUDED, build.concluded(robot=robot, serial=1)).as_sample(0)


@pytest.fixture
def peer():
    return PeerRobot(RobotConfig("r2"), CentralConfig(), THREE)


def test_the_end_of_one_robot_is_not_the_end_of_the_team(peer):
    assert not peer.is_left_alone
    peer.take_end([ended("r1")])
    assert not peer.is_left_alone
    peer.take_end([ended("r3")])
    assert peer.is_left_alone
    assert not peer.peer.replica.concluded, "the set grows by what peers send"


@pytest.mark.parametrize("order", ORDERS)
def test_whom_an_operator_has_given_up_or_withdrawn_is_not_waited_for(peer, order):
    peer.take_end([ended("r1")])
    peer.keep([member(*ORDERS[order])])
    assert peer.is_left_alone


SCHEDULES = 200
SHARE = 4


@pytest.mark.parametrize("part", range(SHARE))
def test_after_any_schedule_all_peers_have_the_whole_set(part):
    for seed in range(part, SCHEDULES, SHARE):
        storm = Storm(seed)
        storm.run()
        found = {storm.digest(name) for name in storm.names}
        assert len(found) == 1, f"schedule {seed}: {len(found)} sets"
        for node in storm.nodes.values():
            whole = [share.count for share in node.replica.streams.values()]
            assert whole == [4, 4, 4], f"schedule {seed}: a fold is given {whole} submaps"
        assert not any(node.refused for node in storm.nodes.values()), seed


def test_without_questions_a_schedule_ends_with_different_sets():
    """Mutant: without questions lost members stay lost."""
    storm = Storm(7)
    storm.spread = lambda name, out: None
    storm.run()
    assert len({storm.digest(name) for name in storm.names}) > 1


# The fold of a set.


END = build.end(**dict.fromkeys(ROBOTS, 20))
ORDER = member(ch.ORDER, build.withdrawal(robot="r2", reason="broken"))
NOT_SEEN = build.given_up(node="robot/r2", reason="not seen")
GIVEN_UP = Member(ch.GIVEN_UP.key("robot/r2"), encoded(NOT_SEEN), NOT_SEEN)


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
