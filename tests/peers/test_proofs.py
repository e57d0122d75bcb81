"""What a third robot carries is believed by the signature of who said it, where there are keys."""

from pathlib import Path

import msgspec
import pytest

from team.keys.authority import make_keys
from team.keys.credentials import credentials_of
from team.keys.roster import nodes_of
from team.keys.signing import Signer
from team.peers.members import Member
from team.peers.node import PeerNode
from team.peers.proofs import OPERATOR, Proofs, signed_order
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.codec import decoded, encoded
from tests.peers.teams import member, parcel, start

ROBOTS = ("r1", "r2", "r3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made: Path = tmp_path_factory.mktemp("keys")
    make_keys(made, "t", nodes_of(ROBOTS))
    return made


@pytest.fixture(scope="module")
def nodes(folder: Path) -> dict[str, PeerNode]:
    """Peers with keys; r1 has said something, which r2 has heard."""
    found = {}
    for robot in ROBOTS:
        signer = Signer(credentials_of(folder, f"robot-{robot}", "t"))
        found[robot] = PeerNode(ch.robot_node(robot), ROBOTS, Proofs(robot, signer))
    return found


def proofs_of(node: PeerNode) -> Proofs:
    assert node.proofs is not None
    return node.proofs


def carried_to(node: PeerNode, carrier: PeerNode) -> list[Member]:
    (out,) = node.hear(carrier.replica.summary(carrier.node, 0, 0)) or [None]
    if out is None:
        return []
    return [
        each
        for reply in carrier.answer(encoded(out.message))
        for each in node.take_carried(decoded(reply, m.Members))
    ]


def test_what_is_signed_comes_over_a_third_robot_and_nothing_else_does(
    nodes: dict[str, PeerNode],
) -> None:
    said = [start("r1"), *parcel("r1", 0), *parcel("r1", 1)]
    certificate = member(ch.CERTIFICATE, proofs_of(nodes["r1"]).certificate())
    for node in (nodes["r1"], nodes["r2"]):
        node.take(certificate, "robot/r1")
    for each in said:
        nodes["r1"].take(each, "robot/r1")
        nodes["r2"].take(each, "robot/r1")
        own = proofs_of(nodes["r1"]).signed(each)
        proofs_of(nodes["r2"]).hear(own, "r1")
        wrong = msgspec.structs.replace(own, robot="r3", signature=b"of somebody else")
        proofs_of(nodes["r2"]).hear(wrong, "r3")
    invented = parcel("r1", 2)[0]
    nodes["r2"].take(invented, "robot/r1")
    assert set(carried_to(nodes["r3"], nodes["r2"])) >= {certificate}
    nodes["r3"].tick(10.0)
    carried_to(nodes["r3"], nodes["r2"])
    assert nodes["r3"].replica.submaps == 2
    assert nodes["r2"].replica.submaps == 3


def test_a_signature_of_somebody_else_proves_nothing(nodes: dict[str, PeerNode]) -> None:
    forged = parcel("r1", 5)[0]
    signature = proofs_of(nodes["r2"])._signer.sign(forged.hash)
    batch = m.Members(
        stamp_ns=0,
        node="robot/r2",
        keys=(forged.key,),
        payloads=(forged.payload,),
        signatures=(signature,),
    )
    assert nodes["r3"].take_carried(batch) == []
    assert "not signed by r1" in nodes["r3"].last_refused


def test_an_order_comes_over_a_third_robot_with_an_operators_signature_only(
    nodes: dict[str, PeerNode], folder: Path
) -> None:
    order = m.Withdrawal(stamp_ns=0, robot="r1", by="operator", reason="broken")
    said = member(ch.ORDER, order)
    carrier = Signer(credentials_of(folder, "robot-r2", "t"))
    batch = m.Members(
        stamp_ns=0,
        node="robot/r2",
        keys=(said.key,),
        payloads=(said.payload,),
        signatures=(signed_order(carrier, said).signature,),
    )
    assert nodes["r3"].take_carried(batch) == []
    assert "an order with a certificate of robot-r2" in nodes["r3"].last_refused
    assert nodes["r3"].take_carried(msgspec.structs.replace(batch, signatures=(b"",))) == []
    operator = Signer(credentials_of(folder, "operator", "t"))
    nodes["r2"].take(said, "operator")
    proofs_of(nodes["r2"]).hear(signed_order(operator, said), OPERATOR)
    nodes["r3"].tick(20.0)
    news = carried_to(nodes["r3"], nodes["r2"])
    assert said.payload in [each.payload for each in news]


def test_a_certificate_of_another_robot_is_nobodys_proof(nodes: dict[str, PeerNode]) -> None:
    own = proofs_of(nodes["r2"]).certificate()
    as_r1 = member(
        ch.CERTIFICATE, m.Certificate(stamp_ns=0, robot="r1", certificate=own.certificate)
    )
    refused = proofs_of(nodes["r3"]).refusal(as_r1, nodes["r3"].replica)
    assert refused == "a certificate of robot-r2 of t, not of robot-r1 of t"


def test_a_robot_that_signs_anothers_member_does_not_take_the_others_signature(
    nodes: dict[str, PeerNode],
) -> None:
    (of_r1,) = parcel("r1", 7)
    hearing = proofs_of(nodes["r2"])
    hearing.hear(proofs_of(nodes["r1"]).signed(of_r1), "r1")
    good = hearing.of(of_r1)
    junk = m.Signature(stamp_ns=0, robot="r3", member=of_r1.hash, signature=bytes(len(good)))
    hearing.hear(junk, "r3")
    assert good
    assert hearing.of(of_r1) == good
