"""The bus over Zenoh: the one module that imports zenoh.

Every process is a client of one router, a star without discovery: what is not configured can not
connect, and the router is the one place where the traffic of a team can be refused or watched.

Beside each payload travels an attachment of 24 bytes, `<qqq`: team time [ns], the publisher's wall
clock [ns], the publisher's counter of this key. How a channel's delivery is kept:

stream: a plain publisher that blocks and never drops; a cut link loses what was sent meanwhile.
latest: a cache and heartbeats; a late joiner asks for the newest one, after a cut the receiver asks
        for what the heartbeat says it missed, as far back as the cache goes.
all:    as `latest` with everything cached, and a late joiner asks for everything.

Samples, queries and liveliness go from Zenoh's receiving thread straight into one unbounded queue:
no thread is ours, the order of arrival is kept across subscriptions, and a slow node never stops
the link (the team's credit bounds the queue). A bus does not receive what it publishes itself.
"""

import json
import logging
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Self

import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from team.wire.bus import Answer, BusError, Outgoing, Sample
from team.wire.channels import ALIVE, Channel, channel_of
from team.wire.codec import LARGEST_PAYLOAD, encoded
from team.wire.messages import FusedMap, Liveliness, MapEstimate, Message, Prior

_ATTACHMENT = struct.Struct("<qqq")
_LEASE_MS = 5_000  # of silence before a link counts as cut: a stopped process is noticed
_BLOCK_US = 10_000_000  # that a full queue may stop a publisher before its link is closed
_HEARTBEAT_S = 0.25
_ALIVE_TIMEOUT_S = 5.0
_LATEST_KEPT = 1_024  # of a `latest` key, so that a cut of minutes recovers; 1 would recover 1
_MAPS_KEPT = 16  # of a `latest` key of maps: a joint covariance may take megabytes
_ALL_KEPT = 1_000_000
_LOG = logging.getLogger(__name__)

_BLOCK = zenoh.CongestionControl.BLOCK
_RELIABLE = zenoh.Reliability.RELIABLE
_PRIORITY = zenoh.Priority.DATA  # one for all, so that the order across keys is kept
_REPLIES = ext.RepliesConfig(congestion_control=_BLOCK, priority=_PRIORITY)
_Publisher = zenoh.Publisher | ext.AdvancedPublisher


@dataclass(frozen=True)
class _Token:
    sample: zenoh.Sample


@dataclass(frozen=True, repr=False)
class _Question:
    query: zenoh.Query
    answer: Answer


_Item = zenoh.Sample | _Token | _Question | None
"""What the receiving thread hands over; None wakes a receiver when the bus closes."""


class ZenohBus:
    """A bus over one Zenoh session: a client of the router at `connect`.

    Raises `BusError` when no router answers there within `patience_s`. One thread publishes and
    receives; `close` may come from any.
    """

    def __init__(self, team: str, connect: str, patience_s: float = 10.0) -> None:
        self._prefix = f"team/{team}/"
        self._queue: SimpleQueue[_Item] = SimpleQueue()
        self._publishers: dict[str, _Publisher] = {}
        self._counters: dict[str, int] = {}
        self._wanted: set[tuple[str, str]] = set()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._closed = threading.Event()
        self._session = _client(connect, patience_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave: what was published is sent first, the tokens go, a waiting receiver returns."""
        if not self._closed.is_set():
            self._closed.set()
            self._session.close()  # type: ignore[no-untyped-call] # the stub has no `-> None`
            self._queue.put(None)

    def publish(self, out: Outgoing) -> int:
        """Encode and publish, stamped with this machine's wall clock; the payload's bytes.

        Blocks while the link is busy; after ten seconds Zenoh gives the link up and connects anew.
        """
        counter = self._counters.get(out.key, 0)
        self._counters[out.key] = counter + 1
        stamp_ns = out.message.stamp_ns
        payload = encoded(out.message)
        self.publish_raw(Sample(out.key, payload, stamp_ns, time.time_ns(), counter))
        return len(payload)

    def publish_raw(self, sample: Sample) -> None:
        """Publish a sample as it is, with the delivery that the table promises for its key.

        A key that is not in the table is a stream.
        """
        self._check_open()
        if len(sample.payload) > LARGEST_PAYLOAD:
            raise BusError(
                f"{sample.key}: {len(sample.payload)} bytes, {LARGEST_PAYLOAD} at most; "
                "split the map or send blocks instead of the joint covariance"
            )
        attachment = _ATTACHMENT.pack(sample.stamp_ns, sample.wall_ns, sample.counter)
        try:
            publisher = self._publishers.get(sample.key)
            if publisher is None:
                publisher = self._publishers[sample.key] = self._declared(sample.key)
            publisher.put(sample.payload, attachment=attachment)
        except zenoh.ZError as error:
            raise BusError(f"{sample.key}: not published, {error}") from error

    def _declared(self, key: str) -> _Publisher:
        found = channel_of(key)
        if found is None or found[0].delivery == "stream":
            return self._session.declare_publisher(
                self._prefix + key,
                congestion_control=_BLOCK,
                priority=_PRIORITY,
                reliability=_RELIABLE,
            )
        return ext.declare_advanced_publisher(
            self._session,
            self._prefix + key,
            congestion_control=_BLOCK,
            priority=_PRIORITY,
            reliability=_RELIABLE,
            cache=ext.CacheConfig(max_samples=_kept(found[0]), replies_config=_REPLIES),
            # Periodic, not sporadic: a sporadic heartbeat that falls into a cut is never repeated.
            sample_miss_detection=ext.MissDetectionConfig(
                heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
            ),
            publisher_detection=True,
        )

    def subscribe(self, channel: Channel, name: str = "*") -> None:
        """From now on `receive` returns what is published there; asking twice changes nothing."""
        self._check_open()
        if {(channel.name, "*"), (channel.name, name)} & self._wanted:
            return
        if name == "*" and any(wanted == channel.name for wanted, _ in self._wanted):
            raise BusError(
                f"{channel.name}: subscribed by name already, so `*` would deliver twice"
            )
        self._wanted.add((channel.name, name))
        key = self._prefix + channel.key(_every(channel, name))
        callback = Callback(self._queue.put, indirect=False)
        remote = zenoh.Locality.REMOTE
        if channel.delivery == "stream":
            self._session.declare_subscriber(key, callback, allowed_origin=remote)
            return
        ext.declare_advanced_subscriber(
            self._session,
            key,
            callback,
            allowed_origin=remote,
            history=_history(channel),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        """All that has arrived, in order; waits at most `timeout_s` for the first.

        Queries are answered here, on the caller's thread: a node's state needs no lock.
        """
        self._check_open()
        samples: list[Sample] = []
        try:
            item = self._queue.get(timeout=timeout_s) if timeout_s > 0 else self._queue.get_nowait()
            while item is not None:
                self._take(item, samples)
                item = self._queue.get_nowait()
        except Empty:
            pass
        return samples

    def _take(self, item: zenoh.Sample | _Token | _Question, samples: list[Sample]) -> None:
        if isinstance(item, _Question):
            _reply(item)
        elif isinstance(item, _Token):
            node = ALIVE.owner(str(item.sample.key_expr).removeprefix(self._prefix))
            if node is not None and node not in self._tokens:
                alive = item.sample.kind == zenoh.SampleKind.PUT
                payload = encoded(Liveliness(0, node, alive))
                samples.append(Sample(ALIVE.key(node), payload, 0, time.time_ns(), 0))
        elif item.attachment is None or len(item.attachment) != _ATTACHMENT.size:
            _LOG.warning("%s: dropped, no attachment of 24 bytes beside it", item.key_expr)
        else:
            stamp_ns, wall_ns, counter = _ATTACHMENT.unpack(item.attachment.to_bytes())
            key = str(item.key_expr).removeprefix(self._prefix)
            samples.append(Sample(key, item.payload.to_bytes(), stamp_ns, wall_ns, counter))

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        """Answer the queries of `channel`, within `receive`; a ValueError is told to the asker."""
        self._check_open()

        def ask(query: zenoh.Query) -> None:
            self._queue.put(_Question(query, answer))

        self._session.declare_queryable(
            self._prefix + channel.key(name), Callback(ask, indirect=False)
        )

    def ask(self, channel: Channel, name: str, request: Message, timeout_s: float) -> list[bytes]:
        """The replies' payloads in the order of the answer; empty when nobody answers.

        Raises `BusError` when an answer does not end within `timeout_s`, or is an error. This
        bus answers nobody meanwhile: two nodes must not ask one another at once.
        """
        self._check_open()
        key = self._prefix + channel.key(name)
        replies = self._session.get(
            key,
            payload=encoded(request),
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,  # each reply, not the newest per key
            congestion_control=_BLOCK,
        )
        payloads: list[bytes] = []
        for reply in replies:
            if reply.ok is None:
                told = b"no answer" if reply.err is None else reply.err.payload.to_bytes()
                text = told.decode("utf-8", "replace")
                raise BusError(f"{key}: {text} (waited at most {timeout_s} s)")
            payloads.append(reply.ok.payload.to_bytes())
        return payloads

    def declare_alive(self, node: str) -> None:
        """Hold a liveliness token until the bus is closed or its process dies."""
        self._check_open()
        if node not in self._tokens:
            key = self._prefix + ALIVE.key(node)
            self._tokens[node] = self._session.liveliness().declare_token(key)

    def watch_alive(self, node: str = "**") -> None:
        """Receive `Liveliness` samples when others' tokens appear and go, present ones first."""
        self._check_open()

        def notice(sample: zenoh.Sample) -> None:
            self._queue.put(_Token(sample))

        self._session.liveliness().declare_subscriber(
            self._prefix + ALIVE.key(node), Callback(notice, indirect=False), history=True
        )

    def is_alive(self, node: str) -> bool:
        """Whether anyone holds the node's liveliness token, as far as the router knows."""
        self._check_open()
        key = self._prefix + ALIVE.key(node)
        replies = self._session.liveliness().get(key, timeout=_ALIVE_TIMEOUT_S)
        return any(reply.ok is not None for reply in replies)

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise BusError("the bus is closed")


def _every(channel: Channel, name: str) -> str:
    """All names: a node's or a view's may have several parts."""
    return "**" if name == "*" and "{robot}" not in channel.template else name


def _kept(channel: Channel) -> int:
    if channel.delivery == "all":
        return _ALL_KEPT
    return _MAPS_KEPT if channel.message in (FusedMap, MapEstimate, Prior) else _LATEST_KEPT


def _history(channel: Channel) -> ext.HistoryConfig:
    # Where one is wanted, no detection of late publishers: after a cut the publisher counts as
    # late, and a query for one sample would take the place of the recovery of all.
    if channel.delivery == "latest":
        return ext.HistoryConfig(max_samples=1, detect_late_publishers=False)
    return ext.HistoryConfig(max_samples=_ALL_KEPT, detect_late_publishers=True)


def _reply(question: _Question) -> None:
    query = question.query
    request = b"" if query.payload is None else query.payload.to_bytes()
    with query:
        try:
            for payload in question.answer(request):
                query.reply(query.key_expr, payload)  # blocks as its query does
        except ValueError as error:  # the request is not sound: its sender is told
            query.reply_err(str(error))


def _session(settings: dict[str, object]) -> zenoh.Session:
    config = zenoh.Config()
    always: dict[str, object] = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/link/rx/max_message_size": LARGEST_PAYLOAD + 65_536,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _BLOCK_US,
    }
    for key, value in {**always, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _client(connect: str, patience_s: float) -> zenoh.Session:
    try:
        return _session(
            {
                "mode": "client",
                "connect/endpoints": [connect],
                "connect/timeout_ms": round(1e3 * patience_s),
                "connect/retry": {
                    "period_init_ms": 100,
                    "period_max_ms": 200,
                    "period_increase_factor": 1.5,
                },
            }
        )
    except zenoh.ZError as error:
        raise BusError(
            f"no router answers at {connect} ({patience_s:g} s): start `teamslam router`, "
            f"or give its endpoint, as tcp/HOST:PORT"
        ) from error


@contextmanager
def router(listen: str = "tcp/127.0.0.1:0") -> Iterator[str]:
    """A router in this process; yields the endpoint that it is bound to.

    Raises `BusError` when it can not listen there.
    """
    try:
        session = _session(
            {"mode": "router", "listen/endpoints": [listen], "adminspace/enabled": True}
        )
    except zenoh.ZError as error:
        raise BusError(
            f"can not listen at {listen}: the port is taken or the address is not this machine's; "
            f"choose another, or port 0 for any free one"
        ) from error
    with session:
        replies = session.get(f"@/{session.zid()}/router", timeout=2.0)
        locators = [json.loads(r.ok.payload.to_string())["locators"] for r in replies if r.ok]
        if not (locators and locators[0]):
            raise BusError(f"the router at {listen} does not tell its endpoint")
        yield str(locators[0][0])
