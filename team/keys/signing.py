"""Signatures by a node's own key: any peer can relay a robot's message, and all can verify it.

ECDSA over P-256 with SHA-256 of the team's name and the 32 bytes that name the member; verified
with the node's certificate, which the team's authority has issued. A node may have had several
certificates: each renewal issues one of the same generation, and the first one after a revocation
begins the next generation. The proof of a certificate does not depend on the time of the
check.
"""

import re
from functools import lru_cache

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from team.keys.credentials import Credentials
from team.keys.roster import ROSTER, Issued, KeysError, load_roster

_ALGORITHM = ec.ECDSA(hashes.SHA256())


class Signer:
    """Signs as one node, and verifies certificates that the team's authority has issued.

    certificate: the node's own, DER. Revocations are read from a roster beside the node's files,
    where there is one. Raises KeysError for a key of another kind, or an unusable roster.
    """

    def __init__(self, own: Credentials) -> None:
        key = serialization.load_pem_private_key(own.key.read_bytes(), password=None)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise KeysError(f"{own.key}: not a key that `teamslam keys` made")
        self._key = key
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
        """The signature of the member with this name."""
        return self._key.sign(self._team.encode() + b"\0" + named, _ALGORITHM)

    def issued(self, node: str, certificate: bytes) -> Issued | str:
        """The generation and the end of a certificate that the authority has issued for the node;
        otherwise why it is none, in words.
        """
        return _issued(self._authority, self._team, node, certificate)

    def revoked(self, node: str) -> int:
        """The last generation of the node's certificates that the roster names as revoked; 0:
        none.
        """
        return self._revoked.get(node, 0)

    def is_signed(self, certificate: bytes, named: bytes, signature: bytes) -> bool:
        """Whether the signature of this name was made with the key of the certificate."""
        key = _public_key(certificate)
        if key is None:
            return False
        try:
            key.verify(signature, self._team.encode() + b"\0" + named, _ALGORITHM)
        except (InvalidSignature, ValueError):
            return False
        return True


@lru_cache(maxsize=1024)
def _issued(authority: x509.Certificate, team: str, node: str, certificate: bytes) -> Issued | str:
    try:
        found = x509.load_der_x509_certificate(certificate)
        found.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return "a certificate that the team's authority has not issued"
    names = [
        str(value.value)
        for oid in (NameOID.COMMON_NAME, NameOID.ORGANIZATION_NAME)
        for value in found.subject.get_attributes_for_oid(oid)[:1]
    ]
    named = re.fullmatch(rf"{re.escape(node)}(?:\.([1-9]\d*))?", names[0]) if names else None
    if len(names) < 2 or names[1] != team or named is None:
        return f"a certificate of {' of '.join(names)}, not of {node} of {team}"
    ends_ns = 10**9 * int(found.not_valid_after_utc.timestamp())
    return Issued(int(named[1] or 1), ends_ns)


@lru_cache(maxsize=1024)
def _public_key(certificate: bytes) -> ec.EllipticCurvePublicKey | None:
    try:
        key = x509.load_der_x509_certificate(certificate).public_key()
    except ValueError:
        return None
    return key if isinstance(key, ec.EllipticCurvePublicKey) else None
