"""Digests by which messages name their inputs, and the announcement of a configuration."""

import msgspec

from teamslam.team.core import Blake2b
from teamslam.team.wire import messages as m

NO_MAP = bytes(8)  # the digest of no map


class Digest:
    """An incremental digest of byte strings."""

    def __init__(self) -> None:
        self._hash = Blake2b(8)

    def update(self, *parts: bytes) -> None:
        """Add byte strings, each with its length."""
        for part in parts:
            self._hash.update(len(part).to_bytes(8, "little"))
            self._hash.update(part)

    def copy(self) -> "Digest":
        """Return an independent copy."""
        other = Digest()
        other._hash = self._hash.copy()
        return other

    @property
    def value(self) -> bytes:
        """The 8-byte digest so far."""
        return self._hash.digest()


def digest_of(*parts: bytes) -> bytes:
    """Return the 8-byte BLAKE2b digest of byte strings."""
    digest = Digest()
    digest.update(*parts)
    return digest.value


def announce_configuration(
    node: str, incarnation: int, stamp_ns: int, configuration: msgspec.Struct
) -> m.Configuration:
    """Return the announcement of a configuration, with its digest."""
    text = msgspec.json.encode(configuration, order="deterministic")
    return m.Configuration(
        stamp_ns=stamp_ns,
        node=node,
        incarnation=incarnation,
        digest=digest_of(text),
        configuration=text.decode(),
    )
