"""Signatures with a node's key: peers relay robots' messages, and all can verify them.

ECDSA over P-256 with SHA-256 of the team's name and the 32 bytes that name the member.
"""

import re
from functools import lru_cache

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from teamslam.team.keys.credentials import Credentials, read_key, read_names
from teamslam.team.keys.roster import ROSTER, Issued, KeysError, load_roster

_ALGORITHM = ec.ECDSA(hashes.SHA256())


class Signer:
    """Sign as one node, and verify certificates issued by the team's authority; raises KeysError.

    certificate: the node's own, DER. Revocations are read from a roster beside the node's files.
    """

    def __init__(self, own: Credentials) -> None:
        self._key = read_key(own.key)
        self._team = own.team
        self._authority = x509.load_pem_x509_certificate(own.authority.read_bytes())
        found = x509.load_pem_x509_certificate(own.certificate.read_bytes())
        self.certificate = found.public_bytes(serialization.Encoding.DER)
        folder = own.certificate.parent
        self._revoked: dict[str, int] = {}
        if (folder / ROSTER).exists():
            roster = load_roster(folder)
            if roster.team != own.team:
                raise KeysError(
                    f"{folder / ROSTER}: of the team {roster.team!r}, not of {own.team!r}: copy "
                    "that of this team, or remove it"
                )
            self._revoked = roster.revoked

    def sign(self, named: bytes) -> bytes:
        """Sign the member of this name."""
        return self._key.sign(self._team.encode() + b"\0" + named, _ALGORITHM)

    def issued(self, node: str, certificate: bytes) -> Issued | str:
        """Return generation and end of an issued certificate of the node, or why it is invalid."""
        return _issued(self._authority, self._team, node, certificate)

    def revoked(self, node: str) -> int:
        """Return the last revoked generation of the node; 0: none."""
        return self._revoked.get(node, 0)

    def is_signed(self, certificate: bytes, named: bytes, signature: bytes) -> bool:
        """Verify a signature of this name against a certificate."""
        try:
            key = _public_key(certificate)
            if isinstance(key, ec.EllipticCurvePublicKey):
                key.verify(signature, self._team.encode() + b"\0" + named, _ALGORITHM)
                return True
        except (InvalidSignature, ValueError):
            pass
        return False


@lru_cache(maxsize=1024)
def _issued(authority: x509.Certificate, team: str, node: str, certificate: bytes) -> Issued | str:
    try:
        found = x509.load_der_x509_certificate(certificate)
        found.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return "a certificate that the team's authority has not issued"
    common, owner = read_names(found)
    named = re.fullmatch(rf"{re.escape(node)}(?:\.([1-9]\d*))?", common)
    if owner != team or named is None:
        return f"a certificate of {common} of {owner}, not of {node} of {team}"
    ends_ns = 10**9 * int(found.not_valid_after_utc.timestamp())
    return Issued(int(named[1] or 1), ends_ns)


@lru_cache(maxsize=1024)
def _public_key(certificate: bytes) -> object:
    return x509.load_der_x509_certificate(certificate).public_key()
