"""The attachment of a publication: stamps, counter, and a hash of its key.

32 bytes, `<qqq8s`: team time [ns], the publisher's wall clock [ns] and counter of the key, and the
8-byte BLAKE2b of the whole key (UTF-8): data in flight when a link is cut can arrive under another
key. The length is the version of the format.
"""

import hashlib
import struct
from functools import lru_cache
from typing import NamedTuple

_FORMAT = struct.Struct("<qqq8s")
_WITHOUT_HASH = 24


class Attachment(NamedTuple):
    """Team time [ns]; the publisher's wall clock [ns], and its counter of the key."""

    stamp_ns: int
    wall_ns: int
    counter: int


class AttachmentError(ValueError):
    """A publication without a valid attachment, or published on another key."""


@lru_cache(maxsize=4096)
def hash_of(key: str) -> bytes:
    """Return the 8-byte hash of a whole key, with its `team/<team>/`."""
    return hashlib.blake2b(key.encode(), digest_size=8).digest()


def pack(key: str, attachment: Attachment) -> bytes:
    """Pack the attachment of a publication on a whole key."""
    return _FORMAT.pack(*attachment, hash_of(key))


def unpack(key: str, data: bytes) -> Attachment:
    """Unpack the attachment of a publication on this key; raises `AttachmentError`."""
    if len(data) == _WITHOUT_HASH:
        raise AttachmentError("its attachment has no hash of the key: an older version's publisher")
    if len(data) != _FORMAT.size:
        raise AttachmentError(f"no attachment of {_FORMAT.size} bytes beside it")
    stamp_ns, wall_ns, counter, of = _FORMAT.unpack(data)
    if of != hash_of(key):
        raise AttachmentError("it was published on another key")
    return Attachment(stamp_ns, wall_ns, counter)
