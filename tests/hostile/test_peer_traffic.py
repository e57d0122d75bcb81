import msgspec
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.peers.fold import PeerFold
from teamslam.central.peers.main import PeerCentre
from teamslam.team.door import MOST_LIVES
from teamslam.team.peers.exchange import MOST_ASKED
from teamslam.team.peers.members import LARGEST_SIGNATURE
from teamslam.team.peers.node import MOST_OPEN, PATIENCE_S, PeerNode
from teamslam.team.peers.replica import MOST_INTERVALS, MOST_STREAMS
from teamslam.team.peers.set_file import SetFile
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import WireError, decoded, encoded
from tests import build
from tests.peers.teams import member, parcel, start

ROBOTS = ("r1", "r2", "r3")
LIAR = "robot/r3"


def node_of() -> PeerNode:
    return PeerNode("robot/r1", ROBOTS)


def claim(robot: str = "r2", incarnation: int = 1, last: int = 10**6) -> m.Holding:
    return build.holding(robot=robot, incarnation=incarnation, sequences=(0, last))


def summary_of(*holdings: m.Holding, serial: int = 0) -> m.SetSummary:
    return build.set_summary(node=LIAR, serial=serial, holdings=holdings)


def members_of(*keys: str, payload: bytes = b"x", signature: bytes = b"", node: str = LIAR):
    n = len(keys)
    return build.members(node=node, keys=keys, payloads=(payload,) * n, signatures=(signature,) * n)


def asked_in(out: list) -> int:
    requests = [each.message for each in out if each.channel is ch.MEMBERS]
    return sum(w.last - w.first + 1 for each in requests for w in each.requested)


def test_a_node_that_gives_nothing_is_not_asked_for_more_and_more():
    node = node_of()
    asked = 0
    for serial in range(100):
        asked += asked_in(node.take_summary(summary_of(claim(), claim("r3"), serial=serial)))
        asked += asked_in(node.request_rest(LIAR))
    assert MOST_OPEN <= asked <= MOST_OPEN + MOST_ASKED
    node.tick(PATIENCE_S + 1.0)
    assert asked_in(node.take_summary(summary_of(claim(), claim("r3")))) > 0


def test_what_has_arrived_is_not_counted_as_owed():
    node, honest = node_of(), PeerNode("robot/r2", ROBOTS)
    for each in (start("r2"), *(one for k in range(40) for one in parcel("r2", k, ["r3"]))):
        honest.take(each, "robot/r2")
    (out,) = node.take_summary(honest.replica.summary("robot/r2", 0, 0))
    assert asked_in([out]) == 40
    for reply in honest.answer(encoded(out.message)):
        node.take_carried(decoded(reply, m.Members))
    owed = sum(of[1] == "robot/r2" for of in node._asked.values())
    assert owed == 1  # the stream's own mark


def test_a_summary_names_each_stream_once_and_no_more_than_a_team_can_have():
    for twice in (summary_of(claim(), claim()), summary_of(claim("r3"), claim("r2"))):
        with pytest.raises(WireError, match="not ascending"):
            decoded(encoded(twice), m.SetSummary)
    gaps = tuple(each for k in range(MOST_INTERVALS + 1) for each in (4 * k, 4 * k + 1))
    lives = (claim(robot, k) for robot in ROBOTS for k in range(MOST_STREAMS + 1))
    words = tuple(m.Statements(robot=f"x{k}", count=1, digest=bytes(8)) for k in range(9))
    large = (
        summary_of(msgspec.structs.replace(claim(), sequences=gaps)),
        summary_of(*lives),
        msgspec.structs.replace(summary_of(), statements=words),
    )
    node = node_of()
    for each in large:
        assert node.take_summary(decoded(encoded(each), m.SetSummary)) == []
        assert "more than a team can have" in node.last_refused
    assert node.tick(2.0)[0].channel is ch.SET_SUMMARY
    assert asked_in(node.take_summary(summary_of(claim(incarnation=MOST_LIVES + 1)))) == 0


def test_who_is_not_in_the_team_is_neither_asked_nor_answered_nor_counted():
    node = node_of()
    for each in (start("r2"), *parcel("r2", 0)):
        node.take(each, "robot/r2")
    for k in range(50):
        stranger = f"robot/x{k}"
        pose = start(f"x{k}")
        node.take_carried(members_of(pose.key, payload=pose.payload, node=stranger))
        node.take(pose, stranger)
        want = build.requested(robot="r2", last=0)
        request = build.members_request(node=stranger, requested=(want,))
        assert node.answer(encoded(request)) == []
    assert set(node.carried) == {"robot/r2"}
    assert "not in this team" in node.last_refused
    centre = PeerCentre(CentralConfig(), ROBOTS)
    for name in ("robot/x1", "robot/r2", "recorder"):
        centre.handle(build.liveliness(node=name))
    assert centre.others == {"robot/r2"}


def test_a_large_signature_is_refused_and_does_not_cut_the_file(tmp_path):
    node = node_of()
    poses = [start(robot) for robot in ROBOTS]
    huge = bytes(5 * 2**20)
    for pose, signature in zip(poses, (b"", huge, b""), strict=True):
        node.take_carried(members_of(pose.key, payload=pose.payload, signature=signature))
    assert f"{len(huge)} bytes, {LARGEST_SIGNATURE} at most" in node.last_refused
    store = SetFile(tmp_path / "r1.set")
    store.append(node.unsaved)
    store.close()
    again = SetFile(tmp_path / "r1.set")
    again.close()
    assert [each.key for each in again.members] == [poses[0].key, poses[2].key]


def test_a_robot_that_contradicts_itself_again_and_again_does_not_begin_the_fold_as_often():
    team = ("r2",)
    node = PeerNode("robot/r1", team)
    fold = PeerFold(CentralConfig(), team, node)
    for each in (start("r2"), *parcel("r2", 0)):
        node.take(each, "robot/r2")
        fold.grow()
    own = parcel("r2", 0)[-1]
    versions = (
        member(ch.SUBMAP, msgspec.structs.replace(own.message, gated=k)) for k in range(1, 400)
    )
    smaller = sorted((v for v in versions if v.hash < own.hash), key=lambda each: each.hash)
    for each in smaller[:0:-1]:
        node.take(each, "robot/r2")
        fold.grow()
    assert node.replica.replacements == len(smaller) - 1 >= 3, "the smallest hash remains"
    assert fold.restarts == 0
    fold.refresh()
    assert fold.restarts == 1
    fold.refresh()
    assert fold.restarts == 1, "it is begun anew for a change only"
    last = build.done(stamp_ns=10**6, robot="r2", measurements=10, submaps=1)
    node.take(member(ch.ROBOT_DONE, last), "robot/r2")
    assert node.take(smaller[0], "robot/r2")
    end = build.end(r2=10)
    fold.note(end)
    assert fold.restarts == 2
    final = fold.final
    assert final is not None
    fresh = PeerFold(CentralConfig(), team, clean := PeerNode("robot/r1", team))
    for each in node.replica.members():
        clean.take(each, "robot/r2")
    fresh.note(end)
    assert fresh.final is not None
    assert encoded(fresh.final) == encoded(final), "the final map is that of the set as it is"
