"""Whether a member that a third node carries was said by whom it is about.

Every robot states its certificate, itself a member, and signs each of its members on a key of its
own (`robot/r1/signature`), for whoever carries them. What an operator orders is not carried where
there are keys: who was out of reach hears it when it is ordered again.
"""

from typing import Protocol, runtime_checkable

from team.peers.members import Member, about
from team.peers.replica import Replica
from team.wire import messages as m

MOST_SIGNATURES = 500_000
"""Kept at the most; a robot has one for each of its members."""


@runtime_checkable
class Signs(Protocol):
    """Signs as one node, and checks others' signatures (`team.keys.signing.Signer`)."""

    certificate: bytes

    def sign(self, named: bytes) -> bytes:
        """The signature of what the bytes name."""

    def refusal(self, node: str, certificate: bytes) -> str | None:
        """Why a certificate is not the node's."""

    def is_signed(self, certificate: bytes, named: bytes, signature: bytes) -> bool:
        """Whether a certificate's key has signed what the bytes name."""


class Proofs:
    """The signatures that one peer has, and what it believes by them."""

    def __init__(self, robot: str, signer: Signs) -> None:
        self._robot = robot
        self._signer = signer
        self._signatures: dict[bytes, bytes] = {}

    def certificate(self) -> m.Certificate:
        """The robot's own certificate, as a member."""
        return m.Certificate(stamp_ns=0, robot=self._robot, certificate=self._signer.certificate)

    def signed(self, member: Member) -> m.Signature:
        """The robot's signature of a member of its own, to be said behind it."""
        signature = self.of(member)
        return m.Signature(
            stamp_ns=member.message.stamp_ns,
            robot=self._robot,
            member=member.hash,
            signature=signature,
        )

    def hear(self, said: m.Signature) -> None:
        """Keep a signature that a robot says on its own key."""
        if len(self._signatures) < MOST_SIGNATURES:
            self._signatures[said.member] = said.signature

    def of(self, member: Member) -> bytes:
        """A member's signature; empty where there is none yet, and of a certificate: the authority
        has signed that.
        """
        if isinstance(member.message, m.Certificate):
            return b""
        found = member.signature or self._signatures.get(member.hash, b"")
        if not found and about(member.message) == self._robot:
            found = self._signatures[member.hash] = self._signer.sign(member.hash)
        return found

    def refusal(self, member: Member, replica: Replica) -> str | None:
        """Why a carried member is not to be believed, in words; None: it is."""
        robot, message = about(member.message), member.message
        if isinstance(message, m.Certificate):
            return self._signer.refusal(f"robot-{robot}", message.certificate)
        if isinstance(message, m.Withdrawal | m.GivenUp | m.Verdict):
            return "an order is not carried where there are keys"
        known = replica.statements.get(robot, {}).get(("certificate", 0))
        if known is None or not isinstance(known.message, m.Certificate):
            return f"no certificate of {robot} is here yet"
        if not self._signer.is_signed(known.message.certificate, member.hash, member.signature):
            return f"not signed by {robot}"
        self._signatures[member.hash] = member.signature
        return None
