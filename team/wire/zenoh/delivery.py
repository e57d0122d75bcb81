"""Implement the deliveries of the table of channels by Zenoh's means.

stream: a plain publisher. latest: a cache and heartbeats; a late joiner requests the newest sample,
and after a cut or a drop the missed ones, as far back as the cache reaches. all: everything is
cached, and a late joiner requests it.

The attachment of a publication has 32 bytes, `<qqq8s`: team time [ns], the publisher's wall clock
[ns] and counter of the key, and the 8-byte BLAKE2b of the whole key (UTF-8): data in flight when a
link is cut can arrive under another key. The length is the version of the format.
"""

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from teamslam.team.core import blake2b
from teamslam.team.wire.bus import WHOLE_CACHE, cache_size
from teamslam.team.wire.channels import Channel, row_of

_HEARTBEAT_S = 0.25
_BLOCK = zenoh.CongestionControl.BLOCK
_RELIABLE = zenoh.Reliability.RELIABLE
PRIORITY = zenoh.Priority.DATA  # one priority for all samples preserves the order across keys
_REPLIES = ext.RepliesConfig(congestion_control=_BLOCK, priority=PRIORITY)
Publisher = zenoh.Publisher | ext.AdvancedPublisher
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
    return blake2b(key.encode(), 8)


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


def declare_publisher(session: zenoh.Session, prefix: str, key: str) -> Publisher:
    """Declare a publisher with the key's delivery (default: stream)."""
    row = row_of(key)
    if row is None or row.delivery == "stream":
        return session.declare_publisher(
            prefix + key,
            congestion_control=_BLOCK,
            priority=PRIORITY,
            reliability=_RELIABLE,
        )
    return ext.declare_advanced_publisher(
        session,
        prefix + key,
        congestion_control=_BLOCK,
        priority=PRIORITY,
        reliability=_RELIABLE,
        cache=ext.CacheConfig(max_samples=cache_size(row), replies_config=_REPLIES),
        # Periodic, not sporadic: a sporadic heartbeat that falls into a cut is never repeated.
        sample_miss_detection=ext.MissDetectionConfig(
            heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
        ),
        publisher_detection=True,
    )


def subscribe(
    session: zenoh.Session,
    key: str,
    channel: Channel,
    put: Callable[[zenoh.Sample], None],
    *,
    whole: bool,
) -> None:
    """Pass the samples of other publishers to `put`, on Zenoh's thread."""
    callback = Callback(put, indirect=False)
    remote = zenoh.Locality.REMOTE
    if channel.delivery == "stream":
        session.declare_subscriber(key, callback, allowed_origin=remote)
        return
    has_all = whole or channel.delivery == "all"
    ext.declare_advanced_subscriber(
        session,
        key,
        callback,
        allowed_origin=remote,
        # No detection of late publishers for one sample: after a cut the publisher counts as late,
        # and a query for one sample would replace the recovery of all.
        history=ext.HistoryConfig(
            max_samples=WHOLE_CACHE if has_all else 1, detect_late_publishers=has_all
        ),
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )
