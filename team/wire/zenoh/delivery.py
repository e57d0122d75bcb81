"""Implement the deliveries of the table of channels by Zenoh's means.

stream: a plain publisher. latest: a cache and heartbeats; a late joiner requests the newest sample,
and after a cut or a drop the missed ones, as far back as the cache reaches. all: everything is
cached, and a late joiner requests it.
"""

from collections.abc import Callable

import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from teamslam.team.wire.bus import WHOLE_CACHE, cache_size
from teamslam.team.wire.channels import Channel, row_of

_HEARTBEAT_S = 0.25
_BLOCK = zenoh.CongestionControl.BLOCK
_RELIABLE = zenoh.Reliability.RELIABLE
PRIORITY = zenoh.Priority.DATA  # one priority for all samples preserves the order across keys
_REPLIES = ext.RepliesConfig(congestion_control=_BLOCK, priority=PRIORITY)
Publisher = zenoh.Publisher | ext.AdvancedPublisher


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
