"""Signatures by a node's own key: any peer can relay a robot's message, and all can verify it.

ECDSA over P-256 with SHA-256 of the team's name and the 32 bytes that name the member; verified
with the node's certificate, which the team's authority has issued.
"""

import re
from datetime import UTC, datetime
from functools import lru_cache

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from team.keys.credentials import Credentials
from team.keys.roster import KeysError

_ALGORITHM = ec.ECDSA(hashes.SHA256())


class Signer:
    """Signs as one node, and verifies certificates that the team's authority has issued.

    certificate: the node's own, DER. Raises KeysError for a key of another kind.
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

    def sign(self, named: bytes) -> bytes:
        """The signature of the member with this name."""
        return self._key.sign(self._team.encode() + b"\0" + named, _ALGORITHM)

    def refusal(self, node: str, certificate: bytes) -> str | None:
        """Why a certificate is not a valid one of the node, in words; None if it is."""
        return _refusal(self._authority, self._team, node, certificate)

    def is_signed(self, certificate: bytes, named: bytes, signature: bytes) -> bool:
        """Whether the signature of this name was made with the key of the certificate."""
        try:
            key = x509.load_der_x509_certificate(certificate).public_key()
            if not isinstance(key, ec.EllipticCurvePublicKey):
                return False
            key.verify(signature, self._team.encode() + b"\0" + named, _ALGORITHM)
        except (InvalidSignature, ValueError):
            return False
        return True


@lru_cache(maxsize=1024)
def _refusal(authority: x509.Certificate, team: str, node: str, certificate: bytes) -> str | None:
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
    if len(names) < 2 or names[1] != team or not re.fullmatch(rf"{node}(\.\d+)?", names[0]):
        return f"a certificate of {' of '.join(names)}, not of {node} of {team}"
    if not found.not_valid_before_utc <= datetime.now(UTC) <= found.not_valid_after_utc:
        return "a certificate that is not valid at this time"
    return None
