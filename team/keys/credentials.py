"""Credentials of a process, checked before connecting: Zenoh gives refused clients no reason."""

import re
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from teamslam.team.keys.roster import KeysError

CA = "ca.pem"
SOON = timedelta(days=7)  # remaining validity that causes a warning
_REMEDY = "make new ones by `teamslam keys` and copy them"


@dataclass(frozen=True)
class Credentials:
    """Checked files of a node; name: common name; ends: expiry."""

    node: str
    name: str
    team: str
    authority: Path
    certificate: Path
    key: Path
    ends: datetime
    readable_by_others: bool = False

    def context(self) -> ssl.SSLContext:
        """Make a TLS client context of the standard library."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(self.authority)
        context.load_cert_chain(self.certificate, self.key)
        return context

    def warnings(self, now: datetime | None = None) -> list[str]:
        """Warn of near expiry or a key readable by others."""
        found = []
        if self.ends - (now or datetime.now(UTC)) < SOON:
            found.append(
                f"{self.certificate} ends at {self.ends:%Y-%m-%d %H:%M} UTC: renew it by "
                f"`teamslam keys {self.team} --renew {self.node}`"
            )
        if self.readable_by_others:
            found.append(f"{self.key} can be read by others: chmod 600 {self.key}")
        return found


def credentials_of(
    folder: Path, node: str, team: str | None = None, now: datetime | None = None
) -> Credentials:
    """Load and check a node's files of a team (None: any); raises KeysError with the remedy."""
    paths = folder / CA, folder / f"{node}.pem", folder / f"{node}.key"
    for path in paths:
        if not path.is_file():
            raise KeysError(
                f"{path}: not found; {node} needs {CA}, {node}.pem and {node}.key in {folder}: "
                "copy them from where `teamslam keys` made them"
            )
    authority, certificate = _certificate(paths[0]), _certificate(paths[1])
    _check_fit(authority, certificate, *paths)
    now = now or datetime.now(UTC)
    for path, found in ((paths[0], authority), (paths[1], certificate)):
        if found.not_valid_after_utc <= now:
            raise KeysError(
                f"{path}: expired at {found.not_valid_after_utc:%Y-%m-%d %H:%M} UTC "
                f"(this machine's clock reads {now:%Y-%m-%d %H:%M}): renew it by "
                f"`teamslam keys TEAM -o DIR --renew {node}` and copy it, or put the clock right"
            )
        if found.not_valid_before_utc > now:
            raise KeysError(
                f"{path}: not valid before {found.not_valid_before_utc:%Y-%m-%d %H:%M} UTC; this "
                f"machine's clock reads {now:%Y-%m-%d %H:%M}: put the clock right"
            )
    common, owner = read_names(certificate)
    if not re.fullmatch(rf"{re.escape(node)}(\.\d+)?", common):
        raise KeysError(f"{paths[1]}: a certificate of {common!r}, not of {node}: {_REMEDY}")
    if team is not None and owner != team:
        raise KeysError(f"{paths[1]}: of the team {owner!r}, not of {team!r}; choose its folder")
    others = bool(paths[2].stat().st_mode & 0o077)
    return Credentials(node, common, owner, *paths, certificate.not_valid_after_utc, others)


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (ValueError, OSError) as error:
        raise KeysError(f"{path}: no certificate in PEM ({error}): {_REMEDY}") from None


def _check_fit(
    authority: x509.Certificate,
    certificate: x509.Certificate,
    authority_path: Path,
    path: Path,
    key_path: Path,
) -> None:
    try:
        key = serialization.load_pem_private_key(key_path.read_bytes(), password=None)
    except (ValueError, TypeError, OSError) as error:
        raise KeysError(f"{key_path}: no private key in PEM ({error}): {_REMEDY}") from None
    if key.public_key() != certificate.public_key():
        raise KeysError(f"{key_path} is not the key of {path}: {_REMEDY}, both together")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        raise KeysError(
            f"{path} is not of the authority in {authority_path}: they are from two folders; "
            "copy both from one"
        ) from None


def read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Read a private key that `teamslam keys` made; raises KeysError for another one."""
    key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise KeysError(f"{path}: not a key that `teamslam keys` made")
    return key


def read_names(certificate: x509.Certificate) -> tuple[str, str]:
    """Return node and team in a certificate; empty where it has none."""
    common, owner = (
        next((str(each.value) for each in certificate.subject.get_attributes_for_oid(oid)), "")
        for oid in (NameOID.COMMON_NAME, NameOID.ORGANIZATION_NAME)
    )
    return common, owner
