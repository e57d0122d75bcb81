"""Read and publish keys outside a team, such as those of ROS 2, as raw samples."""

import json
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import zenoh
from zenoh import ext
from zenoh.handlers import FifoChannel

from teamslam.team.wire.bus import BusError

PATIENCE_S = 10.0  # timeout [s] of the connection
TOKENS_S = 5.0  # timeout [s] for the list of tokens that are present
CAPACITY = 65_536
"""Capacity [messages] of a subscription. A full channel blocks Zenoh's thread, and the router then
drops messages.
"""
AT_ONCE = 10_000  # most messages per subscription and call of `receive`
LOOK_S = 0.005  # polling interval [s] while nothing has arrived


class ForeignSample(NamedTuple):
    """A publication with its attachment, or a liveliness token (`alive`: it appeared)."""

    key: str
    payload: bytes
    attachment: bytes = b""
    token: bool = False
    alive: bool = True


class ForeignKeys:
    """Subscriptions to keys and tokens at a router or peer; raises BusError where none answers.

    Zenoh's thread fills one channel per subscription without running Python. Samples of one key
    keep their order. latched: keys whose earlier samples are requested from the publishers' caches.
    """

    def __init__(
        self,
        connect: str,
        keys: Sequence[str],
        tokens: Sequence[str],
        latched: Sequence[str] = (),
    ) -> None:
        config = zenoh.Config()
        settings: dict[str, object] = {
            "mode": "client",
            "connect/endpoints": [connect],
            "connect/timeout_ms": round(1e3 * PATIENCE_S),
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "timestamping/enabled": True,  # required by the caches of latched keys
        }
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise BusError(f"no answer at {connect} ({PATIENCE_S:g} s): {error}") from None
        self._announced: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        liveliness = self._session.liveliness()
        self._first = [
            _of_token(reply.ok)
            for token in tokens
            for reply in liveliness.get(token, timeout=TOKENS_S)
            if reply.ok is not None
        ]
        self._tokens: list[Any] = [
            liveliness.declare_subscriber(token, FifoChannel(CAPACITY)) for token in tokens
        ]
        self._samples: list[Any] = [
            self._session.declare_subscriber(key, FifoChannel(CAPACITY)) for key in keys
        ]
        self._samples += [
            ext.declare_advanced_subscriber(
                self._session,
                key,
                FifoChannel(CAPACITY),
                history=ext.HistoryConfig(detect_late_publishers=True),
            )
            for key in latched
        ]
        # For publishers whose cache answers on their own key, as in older versions.
        self._first += [
            _of_sample(reply.ok)
            for key in latched
            for reply in self._session.get(key, timeout=TOKENS_S)
            if reply.ok is not None
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()  # type: ignore[no-untyped-call] # zenoh leaves out `-> None`

    @property
    def identity(self) -> str:
        """The session's Zenoh identity, as in liveliness tokens."""
        return str(self._session.info.zid())

    def announce(self, token: str) -> None:
        """Declare a liveliness token, which lasts until the session closes."""
        if token not in self._announced:
            self._announced[token] = self._session.liveliness().declare_token(token)

    def publish(
        self, key: str, payload: bytes, attachment: bytes | None = None, *, latched: bool = False
    ) -> None:
        """Publish, unless the network is slow; late subscribers receive a latched message."""
        publisher = self._publishers.get(key)
        if publisher is None:
            drop = zenoh.CongestionControl.DROP
            if latched:
                publisher = ext.declare_advanced_publisher(
                    self._session, key, congestion_control=drop, cache=ext.CacheConfig(1),
                    publisher_detection=True,
                )  # fmt: skip
            else:
                publisher = self._session.declare_publisher(key, congestion_control=drop)
            self._publishers[key] = publisher
        publisher.put(payload, attachment=attachment)

    def receive(self, timeout_s: float) -> list[ForeignSample]:
        """Return up to AT_ONCE samples per subscription; wait `timeout_s` for the first."""
        until = time.monotonic() + timeout_s
        while True:
            found = self._take_samples()
            if found or time.monotonic() >= until:
                return found
            time.sleep(LOOK_S)

    def _take_samples(self) -> list[ForeignSample]:
        """Return tokens first: they announce the types of the samples that follow."""
        found, self._first = self._first, []
        for channel in self._tokens:
            found += [_of_token(sample) for sample in _some_of(channel)]
        for channel in self._samples:
            found += [_of_sample(sample) for sample in _some_of(channel)]
        return found


def _some_of(channel: Any) -> list[zenoh.Sample]:
    found: list[zenoh.Sample] = []
    while len(found) < AT_ONCE and (sample := channel.try_recv()) is not None:
        found.append(sample)
    return found


def _of_token(sample: zenoh.Sample) -> ForeignSample:
    alive = sample.kind == zenoh.SampleKind.PUT
    return ForeignSample(str(sample.key_expr), b"", token=True, alive=alive)


def _of_sample(sample: zenoh.Sample) -> ForeignSample:
    attached = b"" if sample.attachment is None else sample.attachment.to_bytes()
    return ForeignSample(str(sample.key_expr), sample.payload.to_bytes(), attached)
