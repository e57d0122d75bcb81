"""A team's certificate authority and the certificates that it issues, on curve P-256.

A certificate names node (CN) and team (O), the router's also its hosts. Validity begins an hour
early, since robot clocks differ.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from teamslam.team.keys.credentials import CA, read_key
from teamslam.team.keys.roster import (
    ROSTER,
    KeysError,
    Roster,
    choose_nodes,
    common_name,
    load_roster,
    roster_bytes,
)

CA_KEY = "ca.key"
AUTHORITY_DAYS = 3650
SKEW = timedelta(hours=1)
LOCAL = ("localhost", "127.0.0.1", "::1")  # hosts valid in every router certificate


@dataclass(frozen=True)
class Made:
    """Nodes with new, unchanged and revoked certificates."""

    made: tuple[str, ...]
    unchanged: tuple[str, ...]
    revoked: tuple[str, ...]
    ends: datetime


def make_keys(
    folder: Path,
    team: str,
    nodes: Iterable[str],
    *,
    hosts: Sequence[str] = (),
    days: float = 90.0,
    renew: Sequence[str] = (),
    revoke: Sequence[str] = (),
    now: datetime | None = None,
) -> Made:
    """Create a missing authority and missing certificates in the folder; raises KeysError.

    renew: nodes that get a new key and certificate under the same name. revoke: nodes whose name
    the router no longer accepts.
    """
    now = now or datetime.now(UTC)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    roster = load_roster(folder) if (folder / ROSTER).exists() else Roster(team, {})
    if roster.team != team:
        raise KeysError(f"{folder} holds the keys of the team {roster.team!r}, not of {team!r}")
    authority = _authority(folder, team, now)
    gone = choose_nodes(revoke, roster)
    if "router" in gone:
        raise KeysError("the router is not in its own roster of clients: renew it instead")
    renewed = [node for node in choose_nodes(renew, roster) if node not in gone]
    every_host = tuple(dict.fromkeys((*roster.hosts, *hosts)))
    if every_host != roster.hosts and "router" in roster.nodes and "router" not in renewed:
        renewed.append("router")  # its certificate names the hosts
    generations = {n: g for n, g in roster.nodes.items() if n not in gone}
    revoked = roster.revoked | {node: roster.nodes[node] for node in gone}
    missing = [node for node in nodes if node not in generations and node not in gone]
    generations |= {node: revoked.get(node, 0) + 1 for node in missing}
    roster = Roster(team, generations, every_host, revoked)
    ends = now + timedelta(days=days)
    for node in (*missing, *renewed):
        name = common_name(node, generations[node])
        _write_pair(folder, node, *_issue(authority, team, name, node, every_host, now, ends))
    for node in gone:
        for suffix in ("pem", "key"):
            (folder / f"{node}.{suffix}").unlink(missing_ok=True)
    _write(folder / ROSTER, roster_bytes(roster))
    new = (*missing, *renewed)
    unchanged = tuple(sorted(node for node in generations if node not in new))
    return Made(tuple(sorted(new)), unchanged, tuple(sorted(gone)), ends)


_Authority = tuple[x509.Certificate, ec.EllipticCurvePrivateKey]


def _authority(folder: Path, team: str, now: datetime) -> _Authority:
    paths = folder / CA, folder / CA_KEY
    if all(path.exists() for path in paths):
        return x509.load_pem_x509_certificate(paths[0].read_bytes()), read_key(paths[1])
    if any(path.exists() for path in paths) or (folder / ROSTER).exists():
        raise KeysError(
            f"{folder} has keys but not both {CA} and {CA_KEY}: certificates are made where the "
            "authority is; for a new authority choose an empty folder"
        )
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(team, f"authority of team {team}"[:64])
    certificate = _sign(name, key, name, key, now, now + timedelta(days=AUTHORITY_DAYS))
    _write_pair(folder, "ca", certificate, key)
    return certificate, key


def _issue(
    authority: _Authority,
    team: str,
    name: str,
    node: str,
    hosts: Sequence[str],
    now: datetime,
    ends: datetime,
) -> _Authority:
    key = ec.generate_private_key(ec.SECP256R1())
    issuer, issuer_key = authority
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    further: list[x509.ExtensionType] = [
        x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key())
    ]
    if node == "router":
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = [_host(host) for host in dict.fromkeys((*LOCAL, *hosts))]
        further.append(x509.SubjectAlternativeName(names))
    further.append(x509.ExtendedKeyUsage(usages))
    subject = _name(team, name)
    return _sign(subject, key, issuer.subject, issuer_key, now, ends, *further), key


def _sign(
    subject: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    issuer: x509.Name,
    issuer_key: ec.EllipticCurvePrivateKey,
    now: datetime,
    ends: datetime,
    *further: x509.ExtensionType,
) -> x509.Certificate:
    is_authority = key is issuer_key
    usage = x509.KeyUsage(
        digital_signature=not is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        encipher_only=False,
        decipher_only=False,
    )
    depth = 0 if is_authority else None
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, ends) - SKEW)
        .not_valid_after(ends)
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=depth), critical=True)
        .add_extension(usage, critical=True)
    )
    for extension in (x509.SubjectKeyIdentifier.from_public_key(key.public_key()), *further):
        builder = builder.add_extension(extension, critical=False)
    return builder.sign(issuer_key, hashes.SHA256())


def _name(team: str, common: str) -> x509.Name:
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, team),
            x509.NameAttribute(NameOID.COMMON_NAME, common),
        ]
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host.strip("[]")))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError:
        raise KeysError(f"{host!r} is no name or address of a host") from None


def _write_pair(
    folder: Path, name: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey
) -> None:
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    _write(folder / f"{name}.key", private)
    _write(folder / f"{name}.pem", certificate.public_bytes(serialization.Encoding.PEM))


def _write(path: Path, content: bytes) -> None:
    """Write the file atomically, readable by its owner only."""
    new = path.with_name(f".{path.name}.new")
    new.unlink(missing_ok=True)
    with os.fdopen(os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as file:
        file.write(content)
    new.replace(path)
