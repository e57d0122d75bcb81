"""Verify by signatures that a member carried by a third node is its author's.

Certificates are members. A member is proven by any certificate of its author that the authority
issued, that is not revoked, and that had not expired at the member's stamp, by the author's clock.
A certificate of a later generation, or a roster, revokes the earlier ones. An operator's signature
contains its certificate.
"""

from typing import TYPE_CHECKING

from teamslam.team.peers.members import Member, about
from teamslam.team.peers.replica import Replica
from teamslam.team.wire import messages as m

if TYPE_CHECKING:
    from teamslam.team.keys.signing import Signer

MOST_SIGNATURES = 250_000  # most signatures stored per node; a robot has one per member
LARGEST_OF_ROBOT = 80  # most bytes of a robot's signature: ECDSA over P-256 has 72 at most
MOST_OF_OPERATOR = 10_000  # most stored signatures of operators
OPERATOR = "operator"
ORDERS = (m.Withdrawal, m.GivenUp, m.Verdict)  # members that operators sign


class Proofs:
    """Signatures of one peer."""

    def __init__(self, robot: str, signer: "Signer") -> None:
        self._robot = robot
        self._signer = signer
        self._signatures: dict[str, dict[bytes, bytes]] = {}
        self._operator = 1

    def certificate(self) -> m.Certificate:
        """Return the robot's own certificate, as a member."""
        return m.Certificate(stamp_ns=0, robot=self._robot, certificate=self._signer.certificate)

    def sign(self, member: Member) -> m.Signature:
        """Sign an own member; the message is published after it."""
        signature = self.of(member)
        return m.Signature(
            stamp_ns=member.message.stamp_ns,
            robot=self._robot,
            member=member.hash,
            signature=signature,
        )

    def take_signature(self, signature: m.Signature, publisher: str) -> None:
        """Store a signature that a robot or an operator publishes of its own members."""
        operators = publisher == OPERATOR
        if not operators and (
            publisher != signature.robot or len(signature.signature) > LARGEST_OF_ROBOT
        ):
            return
        signatures = self._signatures.setdefault(publisher, {})
        if len(signatures) < (MOST_OF_OPERATOR if operators else MOST_SIGNATURES):
            signatures[signature.member] = signature.signature

    def of(self, member: Member) -> bytes:
        """Return a member's signature; empty if missing, and for a certificate."""
        if isinstance(member.message, m.Certificate):
            return b""
        publisher = signed_by(member)
        signatures = self._signatures.setdefault(publisher, {})
        found = signatures.get(member.hash, b"")
        if publisher == self._robot:  # an earlier process may have had another key
            found = found or self._signer.sign(member.hash)
            signatures[member.hash] = found
            return found
        return member.signature or found

    def refusal(self, member: Member, replica: Replica) -> str | None:
        """Return why a carried member is rejected; None if accepted."""
        robot, message = about(member.message), member.message
        if isinstance(message, m.Certificate):
            found = self._signer.issued(f"robot-{robot}", message.certificate)
            return found if isinstance(found, str) else None
        why = (
            self._refused_order(member)
            if isinstance(message, ORDERS)
            else self._refused_of_robot(member, robot, replica)
        )
        if why is None:
            self._signatures.setdefault(signed_by(member), {})[member.hash] = member.signature
        return why

    def _refused_of_robot(self, member: Member, robot: str, replica: Replica) -> str | None:
        node = f"robot-{robot}"
        issued = [
            (found, certificate)
            for certificate in replica.certificates_of(robot)
            if not isinstance(found := self._signer.issued(node, certificate), str)
        ]
        if not issued:
            return f"no certificate of {robot} was received yet"
        least = max(self._signer.revoked(node) + 1, *(each.generation for each, _ in issued))
        signed_with = [
            each
            for each, certificate in issued
            if self._signer.is_signed(certificate, member.hash, member.signature)
        ]
        if not signed_with:
            return f"not signed by {robot}"
        if all(each.generation < least for each in signed_with):
            return f"signed with a certificate of {robot} that is revoked"
        if all(each.ends_ns < member.message.stamp_ns for each in signed_with):
            return f"stamped after the certificate of {robot} that signed it had ended"
        return None

    def _refused_order(self, member: Member) -> str | None:
        certificate, signature = _split(member.signature)
        issued = self._signer.issued(OPERATOR, certificate)
        if isinstance(issued, str):
            return f"an order with {issued}"
        self._operator = max(self._operator, issued.generation)
        if issued.generation < max(self._operator, self._signer.revoked(OPERATOR) + 1):
            return "an order with an operator's certificate that is revoked"
        if issued.ends_ns < member.message.stamp_ns:
            return "an order that is stamped after the operator's certificate had ended"
        if not self._signer.is_signed(certificate, member.hash, signature):
            return "an order that no operator has signed"
        return None


def signed_by(member: Member) -> str:
    """Return the author of a member: its robot, or `operator`."""
    return OPERATOR if isinstance(member.message, ORDERS) else about(member.message)


def sign_order(signer: "Signer", member: Member) -> m.Signature:
    """Sign an operator's order, with its certificate in front."""
    certificate = signer.certificate
    proof = len(certificate).to_bytes(2, "little") + certificate + signer.sign(member.hash)
    message = member.message
    return m.Signature(
        stamp_ns=message.stamp_ns, robot=about(message), member=member.hash, signature=proof
    )


def _split(proof: bytes) -> tuple[bytes, bytes]:
    length = int.from_bytes(proof[:2], "little")
    return proof[2 : 2 + length], proof[2 + length :]
