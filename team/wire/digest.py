"""The digests by which messages name their inputs, and the announcement of a configuration."""

import hashlib

import msgspec

from team.wire import messages as m

NO_MAP = bytes(8)
"""The digest that stands for no map."""


class Digest:
    """A digest that can be continued: of all parts that it was given so far."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=8)

    def update(self, *parts: bytes) -> None:
        """Adds more parts."""
        for part in parts:
            self._hash.update(len(part).to_bytes(8, "little"))
            self._hash.update(part)

    def copy(self) -> "Digest":
        """A separate digest of the same parts."""
        other = Digest()
        other._hash = self._hash.copy()
        return other

    @property
    def value(self) -> bytes:
        """The digest of the parts so far: 8 bytes."""
        return self._hash.digest()


def digest_of(*parts: bytes) -> bytes:
    """The 8-byte BLAKE2b digest by which messages name a configuration or a set."""
    digest = Digest()
    digest.update(*parts)
    return digest.value


def configured(
    node: str, incarnation: int, stamp_ns: int, configuration: msgspec.Struct
) -> m.Configuration:
    """The announcement of a configuration, with its digest."""
    text = msgspec.json.encode(configuration, order="deterministic")
    return m.Configuration(
        stamp_ns=stamp_ns,
        node=node,
        incarnation=incarnation,
        digest=digest_of(text),
        configuration=text.decode(),
    )
