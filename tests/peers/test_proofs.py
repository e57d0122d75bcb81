from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.peers.robot import PeerRobot
from teamslam.team.config import RobotConfig
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import nodes_of
from teamslam.team.keys.signing import Signer
from teamslam.team.peers.members import Member
from teamslam.team.peers.node import PeerNode
from teamslam.team.peers.proofs import OPERATOR, Proofs, sign_order
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.peers.teams import member, parcel, start

ROBOTS = ("r1", "r2", "r3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made: Path = tmp_path_factory.mktemp("keys")
    make_keys(made, "t", nodes_of(ROBOTS))
    return made


def signer_of(folder: Path, name: str, **options: object) -> Signer:
    return Signer(credentials_of(folder, name, "t", **options))


def peer_of(folder: Path, robot: str) -> PeerNode:
    proofs = Proofs(robot, signer_of(folder, f"robot-{robot}"))
    return PeerNode(ch.robot_node(robot), ROBOTS, proofs)


@pytest.fixture(scope="module")
def nodes(folder):
    return {robot: peer_of(folder, robot) for robot in ROBOTS}


def batch_of(each: Member, signature: bytes) -> m.Members:
    """The batch in which r2 carries a member."""
    one = {"keys": (each.key,), "payloads": (each.payload,), "signatures": (signature,)}
    return build.members(node="robot/r2", **one)


def proofs_of(node: PeerNode) -> Proofs:
    assert node.proofs is not None
    return node.proofs


def carried_to(node: PeerNode, carrier: PeerNode) -> list[Member]:
    (out,) = node.take_summary(carrier.replica.summary(carrier.node, 0, 0)) or [None]
    if out is None:
        return []
    return [
        each
        for reply in carrier.answer(encoded(out.message))
        for each in node.take_carried(decoded(reply, m.Members))
    ]


def test_what_is_signed_comes_over_a_third_robot_and_nothing_else_does(nodes):
    said = [start("r1"), *parcel("r1", 0), *parcel("r1", 1)]
    certificate = member(ch.CERTIFICATE, proofs_of(nodes["r1"]).certificate())
    for node in (nodes["r1"], nodes["r2"]):
        node.take(certificate, "robot/r1")
    for each in said:
        nodes["r1"].take(each, "robot/r1")
        nodes["r2"].take(each, "robot/r1")
        own = proofs_of(nodes["r1"]).sign(each)
        proofs_of(nodes["r2"]).take_signature(own, "r1")
        wrong = msgspec.structs.replace(own, robot="r3", signature=b"of somebody else")
        proofs_of(nodes["r2"]).take_signature(wrong, "r3")
    invented = parcel("r1", 2)[0]
    nodes["r2"].take(invented, "robot/r1")
    assert set(carried_to(nodes["r3"], nodes["r2"])) >= {certificate}
    nodes["r3"].tick(10.0)
    carried_to(nodes["r3"], nodes["r2"])
    assert nodes["r3"].replica.submaps == 2
    assert nodes["r2"].replica.submaps == 3


def test_a_signature_of_somebody_else_proves_nothing(nodes):
    forged = parcel("r1", 5)[0]
    signature = proofs_of(nodes["r2"])._signer.sign(forged.hash)
    assert nodes["r3"].take_carried(batch_of(forged, signature)) == []
    assert "not signed by r1" in nodes["r3"].last_refused


def test_an_order_comes_over_a_third_robot_with_an_operators_signature_only(nodes, folder):
    said = member(ch.ORDER, build.withdrawal(reason="broken"))
    of_carrier = sign_order(signer_of(folder, "robot-r2"), said).signature
    assert nodes["r3"].take_carried(batch_of(said, of_carrier)) == []
    assert "an order with a certificate of robot-r2" in nodes["r3"].last_refused
    assert nodes["r3"].take_carried(batch_of(said, b"")) == []
    operator = signer_of(folder, "operator")
    nodes["r2"].take(said, "operator")
    proofs_of(nodes["r2"]).take_signature(sign_order(operator, said), OPERATOR)
    nodes["r3"].tick(20.0)
    news = carried_to(nodes["r3"], nodes["r2"])
    assert said.payload in [each.payload for each in news]


def test_a_certificate_of_another_robot_is_nobodys_proof(nodes):
    own = proofs_of(nodes["r2"]).certificate()
    as_r1 = member(ch.CERTIFICATE, msgspec.structs.replace(own, robot="r1"))
    refused = proofs_of(nodes["r3"]).refusal(as_r1, nodes["r3"].replica)
    assert refused == "a certificate of robot-r2 of t, not of robot-r1 of t"


class Renewed:
    """r1 in a running team, with each of its certificates; r2 receives from r1, r3 from r2."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        make_keys(folder, "t", nodes_of(ROBOTS))
        self.r2, self.r3 = peer_of(folder, "r2"), peer_of(folder, "r3")
        self.now_s = 100.0

    def own(self) -> Proofs:
        return Proofs("r1", signer_of(self.folder, "robot-r1"))

    def say(self, proofs: Proofs, *members: Member) -> None:
        self.r2.take(member(ch.CERTIFICATE, proofs.certificate()), "robot/r1")
        for each in members:
            self.r2.take(each, "robot/r1")
            proofs_of(self.r2).take_signature(proofs.sign(each), "r1")

    def submaps_of_r3(self) -> int:
        for _ in range(3):
            self.now_s += 10.0
            self.r2.tick(self.now_s)
            summary = self.r2.replica.summary(self.r2.node, 0, 0)
            for out in (*self.r3.tick(self.now_s), *self.r3.take_summary(summary)):
                if out.channel is ch.MEMBERS:
                    for reply in self.r2.answer(encoded(out.message)):
                        self.r3.take_carried(decoded(reply, m.Members))
        return len(self.r3.replica.share_of(("r1", 1)).complete)


def test_a_certificate_that_is_renewed_while_the_team_runs_splits_nothing(tmp_path):
    team = Renewed(tmp_path)
    team.say(team.own(), start("r1"), *parcel("r1", 0), *parcel("r1", 1))
    make_keys(tmp_path, "t", [], renew=["robot-r1"])
    team.say(team.own(), *parcel("r1", 2))
    assert team.submaps_of_r3() == 3
    assert team.r3.replica.digest == team.r2.replica.digest
    make_keys(tmp_path, "t", [], renew=["robot-r1"])
    team.say(team.own(), *parcel("r1", 3))
    assert team.submaps_of_r3() == 4, "after r3 had the earlier ones"


def test_what_a_revoked_key_has_signed_is_refused_until_its_author_signs_it_anew(tmp_path):
    """The next generation's certificate proves the revocation, without a roster."""
    team = Renewed(tmp_path)
    stolen = team.own()
    make_keys(tmp_path, "t", [], revoke=["robot-r1"])
    make_keys(tmp_path, "t", nodes_of(ROBOTS))
    (tmp_path / "roster.json").unlink()
    team.say(stolen, start("r1"), *parcel("r1", 0))
    team.say(team.own(), *parcel("r1", 1))
    team.submaps_of_r3()
    assert sorted(team.r3.replica.share_of(("r1", 1)).submaps) == [1]
    assert "signed with a certificate of r1 that is revoked" in team.r3.last_refused
    team.say(team.own(), start("r1"), *parcel("r1", 0))
    assert team.submaps_of_r3() == 2


def test_a_roster_beside_the_own_key_names_who_is_revoked_without_a_successor(tmp_path):
    team = Renewed(tmp_path)
    stolen = team.own()
    make_keys(tmp_path, "t", [], revoke=["robot-r1"])
    team.say(stolen, start("r1"), *parcel("r1", 0))
    assert team.submaps_of_r3() == 1, "its process was started before the revocation"
    team.r3 = peer_of(tmp_path, "r3")
    assert team.submaps_of_r3() == 0
    assert "revoked" in team.r3.last_refused


def test_what_is_stamped_after_its_certificate_had_ended_is_refused_and_before_it_is_not(tmp_path):
    now = datetime.now(UTC)
    make_keys(tmp_path, "t", nodes_of(ROBOTS), now=now - timedelta(days=3))
    team = Renewed(tmp_path)
    make_keys(tmp_path, "t", [], renew=["robot-r1"], days=1.0, now=now - timedelta(days=2))
    then = now - timedelta(days=1.5)
    old = Proofs("r1", signer_of(tmp_path, "robot-r1", now=then))
    day_ns = 86_400 * 10**9
    now_ns = int(now.timestamp()) * 10**9
    late, early = (
        build.initial_pose(incarnation=k, stamp_ns=now_ns - k * day_ns // 2) for k in (1, 3)
    )
    team.say(old, member(ch.START, late), member(ch.START, early))
    team.submaps_of_r3()
    assert [*team.r3.replica.streams] == [("r1", 3)]
    assert "stamped after the certificate of r1" in team.r3.last_refused


def test_a_certificate_that_is_not_the_authoritys_takes_no_place_of_the_true_one(tmp_path):
    team = Renewed(tmp_path / "own")
    make_keys(tmp_path / "strange", "t", nodes_of(ROBOTS))
    strange = Proofs("r1", signer_of(tmp_path / "strange", "robot-r1"))
    forged = member(ch.CERTIFICATE, strange.certificate())
    assert not team.r2.take_sample(forged.as_sample(0), "robot/r1")
    assert "the team's authority has not issued" in team.r2.last_refused
    true = member(ch.CERTIFICATE, team.own().certificate())
    assert team.r2.take_sample(true.as_sample(0), "robot/r1")


def test_an_order_by_an_operators_key_that_is_revoked_is_refused_once_the_next_one_is_seen(
    tmp_path,
):
    team = Renewed(tmp_path)
    stolen = signer_of(tmp_path, "operator")
    make_keys(tmp_path, "t", [], revoke=["operator"])
    make_keys(tmp_path, "t", nodes_of(ROBOTS))
    present = signer_of(tmp_path, "operator")

    def carried(signer: Signer, robot: str, to: PeerNode, stamp_ns: int = 0) -> list[Member]:
        said = member(ch.ORDER, build.withdrawal(stamp_ns=stamp_ns, robot=robot))
        return to.take_carried(batch_of(said, sign_order(signer, said).signature))

    assert carried(stolen, "r1", team.r3), "nothing that it has seen says otherwise"
    assert carried(present, "r2", team.r3)
    assert not carried(stolen, "r3", team.r3)
    assert "an operator's certificate that is revoked" in team.r3.last_refused
    with_roster = peer_of(tmp_path, "r3")
    assert not carried(stolen, "r1", with_roster), "its roster says so from the beginning"
    assert not carried(present, "r1", with_roster, stamp_ns=2**62 - 1)
    assert "stamped after the operator's certificate had ended" in with_roster.last_refused


def test_a_robot_that_is_started_again_signs_its_stored_members_with_its_present_key(tmp_path):
    team = Renewed(tmp_path)
    said = [start("r1"), *parcel("r1", 0)]
    make_keys(tmp_path, "t", [], revoke=["robot-r1"])
    make_keys(tmp_path, "t", nodes_of(ROBOTS))
    signer = signer_of(tmp_path, "robot-r1")
    robot = PeerRobot(RobotConfig("r1"), CentralConfig(), ROBOTS, signer=signer)
    robot.keep(Member(each.key, each.payload, each.message, b"of the key before") for each in said)
    signatures = [each.message for each in robot.begin() if isinstance(each.message, m.Signature)]
    own = team.own()
    for each in said:
        (found,) = [s.signature for s in signatures if s.member == each.hash]
        assert own._signer.is_signed(own.certificate().certificate, each.hash, found)


def test_a_robot_that_signs_anothers_member_does_not_take_the_others_signature(nodes):
    (of_r1,) = parcel("r1", 7)
    hearing = proofs_of(nodes["r2"])
    hearing.take_signature(proofs_of(nodes["r1"]).sign(of_r1), "r1")
    good = hearing.of(of_r1)
    junk = m.Signature(stamp_ns=0, robot="r3", member=of_r1.hash, signature=bytes(len(good)))
    hearing.take_signature(junk, "r3")
    assert good
    assert hearing.of(of_r1) == good
