"""The bus over Zenoh: the one module that imports zenoh.

Every process is a client of one router, a star without discovery: what is not configured can not
connect, and the router is the one place where the traffic of a team can be refused or watched.

Beside each payload travels an attachment of 24 bytes, `<qqq`: team time [ns], the publisher's wall
clock [ns], the publisher's counter of this key. How a channel's delivery is kept:

stream: a plain publisher that blocks and never drops; a cut link loses what was sent meanwhile.
latest: a cache and heartbeats; a late joiner asks for the newest one, after a cut the receiver asks
        for what the heartbeat says it missed, as far back as the cache goes.
all:    as `latest` with everything cached, and a late joiner asks for everything.

Zenoh's advanced subscriber does most of this, but not all: of late joiners some get a part of the
history. So the bus counts what arrives of each publisher (`team.wire.arrivals`), compares with the
heartbeats, and asks the publisher's cache for what has been missing for half a second.

Samples, queries and liveliness go from Zenoh's receiving thread straight into one unbounded queue:
no thread is ours, the order of arrival is kept across subscriptions, and a slow node never stops
the link (the team's credit bounds the queue). A bus does not receive what it publishes itself.
"""

import json
import logging
import struct
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import TYPE_CHECKING, Self

import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from team.keys.roster import Roster
from team.wire.access import access_control
from team.wire.arrivals import Arrivals
from team.wire.bus import ALL_KEPT, Answer, BusError, Outgoing, Sample, kept_of, replied
from team.wire.channels import (
    ALIVE,
    FINAL_KEPT,
    FINAL_MAP,
    GIVEN_UP,
    ORDERS_KEPT,
    TALLY,
    Channel,
    row_of,
)
from team.wire.codec import LARGEST_PAYLOAD, WireError, decoded, encoded
from team.wire.handshake import router_ends, why_refused
from team.wire.kept import Kept
from team.wire.messages import FinalMapRequest, Liveliness, Message, Tally

if TYPE_CHECKING:  # a node without keys needs none of it
    from team.keys.credentials import Credentials

_ATTACHMENT = struct.Struct("<qqq")
_LEASE_MS = 5_000  # of silence before a link counts as cut: a stopped process is noticed
_BLOCK_US = 10_000_000  # that a full queue may stop a publisher before its link is closed
_HEARTBEAT_S = 0.25
_ALIVE_TIMEOUT_S = 5.0
FIRST_LOOK_S = 3.0
"""A client that has not come in for so long looks why."""
LINK_S = 1.0
"""Between two looks whether the router still lets a node with keys in."""
DEAF = 4
"""Looks in a row at which a router with a link is not heard: then it lets us hear nothing."""
DOOR = "router/door"
"""Where a router with keys holds a token, which every node that it lets in can see."""
REFUSALS = "error,zenoh_link_tls=warn"
"""What of Zenoh's log a router with keys shows: whom it refuses, and why."""
_ADVANCED = "/@adv/pub/"  # in the key of what an advanced publisher says beside its publications
_BEAT = struct.Struct("<I")  # a heartbeat's payload: the number of the last publication
_LOOK_S = 0.1  # between two looks at what is missing
_ANSWER_S = 10.0
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


@dataclass(frozen=True)
class _Heartbeat:
    key: str
    publisher: str
    newest: int


@dataclass
class _Cached:
    """An answer of a publisher's cache that has come to its end: what was asked, what came."""

    key: str
    publisher: str
    first: int
    repeated: bool
    newest: int = -1
    failed: bool = False


@dataclass(frozen=True)
class _Reply:
    """A reply to a request; without a payload: that was all, or why there is none."""

    channel: Channel
    name: str
    payload: bytes | None
    wrong: str = ""


_Item = _Reply | zenoh.Sample | _Token | _Question | _Heartbeat | _Cached | None
"""What the receiving thread hands over; None wakes a receiver when the bus closes."""


class ZenohBus:
    """A bus over one Zenoh session: a client of the router at `connect`.

    keys: what this node shows the router, over TLS; None: nothing, over TCP. Raises `BusError` when
    no router answers there within `patience_s`, or one that refuses us or that we refuse. One
    thread publishes and receives; `close` may come from any.
    """

    def __init__(
        self,
        team: str,
        connect: str,
        patience_s: float = 10.0,
        keys: "Credentials | None" = None,
    ) -> None:
        self._prefix = f"team/{team}/"
        self._queue: SimpleQueue[_Item] = SimpleQueue()
        self._publishers: dict[str, _Publisher] = {}
        self._counters: dict[str, int] = {}
        self._wanted: set[tuple[str, str]] = set()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._requests: set[tuple[str, str]] = set()
        self._whole: set[str] = set()
        self._beats: dict[str, bytes] = {}
        self._arrivals: dict[tuple[str, str], Arrivals[Sample]] = {}
        self._incomplete: set[tuple[str, str]] = set()
        self._look_due = 0.0
        self._published: dict[str, int] = {}
        self._newest_ns = 0
        self._since_ns = time.time_ns()
        self.tap: Callable[[list[Sample]], None] | None = None
        """Is handed what this bus publishes and receives."""
        self._closed = threading.Event()
        self._keys = keys
        self._session = _client(connect, patience_s, keys)
        self._door = None if keys is None else _Door(self._session, connect, keys)

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
            with suppress(BusError):
                self._tell_tally()
            self._closed.set()
            self._session.close()  # type: ignore[no-untyped-call] # the stub has no `-> None`
            self._queue.put(None)

    def _tell_tally(self) -> None:
        """Whoever records is told how much there was of each key: a tail may have been lost."""
        if self._tokens:
            node = next(iter(self._tokens))
            counts = dict(sorted(self._published.items()))
            keys = tuple(counts)
            tally = Tally(
                stamp_ns=self._newest_ns,
                node=node,
                since_ns=self._since_ns,
                keys=keys,
                counts=tuple(counts.values()),
            )
            self.publish(Outgoing(TALLY, node, tally))

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
            self._published[sample.key] = max(
                self._published.get(sample.key, 0), sample.counter + 1
            )
            self._newest_ns = max(self._newest_ns, sample.stamp_ns)
            if self.tap is not None:
                self.tap([sample])
        except zenoh.ZError as error:
            raise BusError(f"{sample.key}: not published, {error}") from error

    def _declared(self, key: str) -> _Publisher:
        row = row_of(key)
        if row is None or row.delivery == "stream":
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
            cache=ext.CacheConfig(max_samples=kept_of(row), replies_config=_REPLIES),
            # Periodic, not sporadic: a sporadic heartbeat that falls into a cut is never repeated.
            sample_miss_detection=ext.MissDetectionConfig(
                heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
            ),
            publisher_detection=True,
        )

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        """From now on `receive` returns what is published there; asking twice changes nothing.

        whole: of a `latest` channel not the newest one, but all that the publishers still have.
        """
        self._check_open()
        if {(channel.name, "*"), (channel.name, name)} & self._wanted:
            return
        if name == "*" and any(wanted == channel.name for wanted, _ in self._wanted):
            raise BusError(
                f"{channel.name}: subscribed by name already, so `*` would deliver twice"
            )
        self._wanted.add((channel.name, name))
        if whole:
            self._whole.add(channel.name)
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
            history=_history(channel, whole=whole),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        self._session.declare_subscriber(
            f"{key}{_ADVANCED}**", Callback(self._note_beat, indirect=False), allowed_origin=remote
        )

    def _note_beat(self, sample: zenoh.Sample) -> None:
        """On the receiving thread: a heartbeat that says something new."""
        name, said = str(sample.key_expr), sample.payload.to_bytes()
        if len(said) == _BEAT.size and self._beats.get(name) != said:
            self._beats[name] = said
            key, _, rest = name.removeprefix(self._prefix).partition(_ADVANCED)
            publisher = "/".join(rest.split("/")[:2])
            self._queue.put(_Heartbeat(key, publisher, *_BEAT.unpack(said)))

    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        """All that has arrived, in order; waits at most `timeout_s` for the first.

        Queries are answered here, on the caller's thread: a node's state needs no lock. What has
        been missing for a while is asked for; it comes as it arrives, behind what came after it.
        """
        self._check_open()
        if self._door is not None:
            self._door.look(time.monotonic())
        samples: list[Sample] = []
        until = time.monotonic() + timeout_s
        with suppress(Empty):
            while True:
                wait = 0.0 if samples else until - time.monotonic()
                item = self._queue.get(timeout=wait) if wait > 0.0 else self._queue.get_nowait()
                if item is None:
                    break
                self._take(item, samples)
        samples += self._complete(time.monotonic())
        if self.tap is not None and samples:
            self.tap(samples)
        return samples

    def _take(self, item: _Item, samples: list[Sample]) -> None:
        match item:
            case _Question():
                _reply(item)
            case _Token():
                node = ALIVE.owner(str(item.sample.key_expr).removeprefix(self._prefix))
                if node is not None and node not in self._tokens:
                    alive = item.sample.kind == zenoh.SampleKind.PUT
                    payload = encoded(Liveliness(stamp_ns=0, node=node, alive=alive))
                    samples.append(Sample(ALIVE.key(node), payload, 0, time.time_ns(), 0))
            case _Heartbeat():
                self._arrivals_of(item.key, item.publisher, item.newest).know(item.newest)
                self._incomplete.add((item.key, item.publisher))
            case _Cached():
                if item.repeated and not item.failed and item.newest >= 0:
                    arrivals = self._arrivals_of(item.key, item.publisher, item.newest)
                    samples += arrivals.answered(item.first, item.newest)
            case _Reply():
                self._take_reply(item, samples)
            case zenoh.Sample():
                self._take_sample(item, samples)

    def _take_sample(self, item: zenoh.Sample, samples: list[Sample]) -> None:
        if item.attachment is None or len(item.attachment) != _ATTACHMENT.size:
            _LOG.warning("%s: dropped, no attachment of 24 bytes beside it", item.key_expr)
            return
        key = str(item.key_expr).removeprefix(self._prefix)
        stamp_ns, wall_ns, counter = _ATTACHMENT.unpack(item.attachment.to_bytes())
        sample = Sample(key, item.payload.to_bytes(), stamp_ns, wall_ns, counter)
        if item.source_info is None:  # of a plain publisher
            samples.append(sample)
            return
        publisher, number = _numbered(item.source_info)
        arrivals = self._arrivals_of(key, publisher, number)
        samples += arrivals.take(number, sample)
        if arrivals.missing is not None:
            self._incomplete.add((key, publisher))

    def _arrivals_of(self, key: str, publisher: str, heard: int) -> Arrivals[Sample]:
        """Of a `latest` channel nothing is asked for that is older than the first heard of."""
        found = self._arrivals.get((key, publisher))
        if found is None:
            row = row_of(key)
            whole = row is None or row.delivery == "all" or row.name in self._whole
            found = Arrivals(0 if whole else heard, in_order=whole)
            self._arrivals[key, publisher] = found
        return found

    def _complete(self, now_s: float) -> list[Sample]:
        """Ask for what has been missing for a while, without waiting; what waited in vain."""
        if now_s < self._look_due or not self._incomplete:
            return []
        self._look_due = now_s + _LOOK_S
        late: list[Sample] = []
        for key, publisher in sorted(self._incomplete):
            arrivals = self._arrivals[key, publisher]
            wanted = arrivals.due(now_s)
            if arrivals.missing is None:
                self._incomplete.discard((key, publisher))
            elif wanted is not None:
                self._ask_cache(key, publisher, *wanted)
            late += arrivals.overdue(now_s)
        return late

    def _ask_cache(self, key: str, publisher: str, first: int, last: int | None) -> None:
        cached = _Cached(key, publisher, first, repeated=last is None)

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                cached.failed = True
            elif reply.ok.source_info is not None:
                cached.newest = max(cached.newest, _numbered(reply.ok.source_info)[1])
                self._queue.put(reply.ok)

        until = "" if last is None else str(last)
        _LOG.info("%s: %d to %s are missing, asked for", key, first, until or "the newest")
        self._session.get(
            f"{self._prefix}{key}{_ADVANCED}{publisher}/**?_anyke;_sn={first}..{until}",
            Callback(take, drop=lambda: self._queue.put(cached), indirect=False),
            timeout=_ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            target=zenoh.QueryTarget.ALL,
            congestion_control=_BLOCK,
        )

    def again(self) -> None:
        """What was delivered of `all` and whole channels is asked for and delivered once more."""
        self._arrivals.clear()
        self._incomplete.clear()
        self._beats.clear()  # so that the next heartbeats are news

    def lacking(self) -> dict[str, list[tuple[int, int]]]:
        """What is known of and has not arrived: by key, intervals of a publisher's numbers.

        Of what a publisher does not have any more, too.
        """
        found: dict[str, list[tuple[int, int]]] = {}
        for (key, _), arrivals in sorted(self._arrivals.items()):
            if intervals := arrivals.lacking:
                found.setdefault(key, []).extend(intervals)
        return found

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

    def request(self, channel: Channel, name: str, request: Message) -> None:
        """Ask without waiting: the replies come out of `receive`, as samples of their channels.

        While the same is being asked nothing happens.
        """
        self._check_open()
        if (channel.name, name) in self._requests:
            return
        self._requests.add((channel.name, name))

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._queue.put(_Reply(channel, name, reply.ok.payload.to_bytes()))
            elif reply.err is not None:
                told = reply.err.payload.to_bytes().decode("utf-8", "replace")
                self._queue.put(_Reply(channel, name, None, told or "no answer"))

        self._session.get(
            self._prefix + channel.key(name),
            Callback(
                take, drop=lambda: self._queue.put(_Reply(channel, name, None)), indirect=False
            ),
            payload=encoded(request),
            timeout=_ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=_BLOCK,
        )

    def _take_reply(self, reply: _Reply, samples: list[Sample]) -> None:
        key = reply.channel.key(reply.name)
        if reply.payload is None:
            self._requests.discard((reply.channel.name, reply.name))
            if reply.wrong:
                _LOG.warning("%s: %s (waited at most %s s)", key, reply.wrong, _ANSWER_S)
            return
        try:
            samples.append(replied(reply.channel, reply.name, reply.payload, time.time_ns()))
        except WireError as error:
            _LOG.warning("%s: dropped a reply: %s", key, error)

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
        if self._keys is not None and time.time() > self._keys.ends.timestamp():
            raise BusError(
                f"{self._keys.certificate} has expired, so the router has closed the link: renew "
                f"it by `teamslam keys {self._keys.team} -o DIR --renew {self._keys.node}`, copy "
                "it, and start this process again"
            )


class _Door:
    """Whether a router with keys still lets this node in: Zenoh would try for ever, silently.

    A router that is gone is waited for. One that does not take us any more, or that we do not take,
    is asked why by a handshake; one that gives us a link but lets us hear nothing has a roster
    without our certificate: there is nothing else on the key that it holds a token on.
    """

    def __init__(self, session: zenoh.Session, connect: str, keys: "Credentials") -> None:
        self._session = session
        self._connect = connect
        self._keys = keys
        self._due = self._heard_at = 0.0
        self._router_ends = router_ends(connect, keys)
        self._heard = True
        self._deaf = 0

    def look(self, now_s: float) -> None:
        """Look every LINK_S; raises BusError with the reason."""
        if now_s < self._due:
            return
        self._due = now_s + LINK_S
        linked = bool(self._session.info.routers_zid())
        self._deaf = 0 if self._heard or not linked else self._deaf + 1
        self._heard_at = now_s if self._heard else self._heard_at
        # A link that comes up again just before the end Zenoh may keep behind it.
        ended = self._router_ends is not None and time.time() > self._router_ends
        if ended or now_s - self._heard_at > FIRST_LOOK_S:
            refused = why_refused(self._connect, self._keys)
            if refused is not None:
                raise BusError(refused)
            self._router_ends = router_ends(self._connect, self._keys)
        if self._deaf > DEAF:
            raise BusError(
                f"{self._connect}: the router gives {self._keys.certificate} a link, but lets it "
                "hear and say nothing: it is revoked, or the router has another roster. Copy the "
                f"newest {self._keys.node}.pem and .key, and roster.json to the router, and start "
                "both again"
            )
        self._heard = False

        def hear(reply: zenoh.Reply) -> None:
            self._heard = self._heard or reply.ok is not None

        key = f"team/{self._keys.team}/{DOOR}"
        self._session.liveliness().get(key, Callback(hear, indirect=False), timeout=LINK_S)


def _every(channel: Channel, name: str) -> str:
    """All names: a node's or a view's may have several parts."""
    return "**" if name == "*" and "{robot}" not in channel.template else name


def _numbered(info: zenoh.SourceInfo) -> tuple[str, int]:
    """The publisher, as its heartbeats name it, and its number of the publication."""
    return f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn


def _history(channel: Channel, *, whole: bool) -> ext.HistoryConfig:
    # Where one is wanted, no detection of late publishers: after a cut the publisher counts as
    # late, and a query for one sample would take the place of the recovery of all.
    if channel.delivery == "latest" and not whole:
        return ext.HistoryConfig(max_samples=1, detect_late_publishers=False)
    return ext.HistoryConfig(max_samples=ALL_KEPT, detect_late_publishers=True)


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


def _client(connect: str, patience_s: float, keys: "Credentials | None") -> zenoh.Session:
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [connect],
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 200,
            "period_increase_factor": 1.5,
        },
    }
    if keys is not None:
        if not connect.startswith("tls/"):
            raise BusError(f"{connect}: with keys a router is reached by tls/HOST:PORT")
        settings |= _client_tls(keys)
    deadline = time.monotonic() + patience_s
    wait_s = min(FIRST_LOOK_S, patience_s)
    while True:
        try:
            return _session(settings | {"connect/timeout_ms": max(1, round(1e3 * wait_s))})
        except zenoh.ZError as error:
            refused = why_refused(connect, keys)
            if refused is not None:
                raise BusError(refused) from error
            wait_s = deadline - time.monotonic()
            if wait_s <= 0.0:
                example = "tls/HOST:PORT" if keys is not None else "tcp/HOST:PORT"
                raise BusError(
                    f"no router answers at {connect} ({patience_s:g} s): start `teamslam router`, "
                    f"or give its endpoint, as {example}"
                ) from error


def _client_tls(keys: "Credentials") -> dict[str, object]:
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(keys.authority),
            "enable_mtls": True,
            "connect_certificate": str(keys.certificate),
            "connect_private_key": str(keys.key),
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def _router_tls(keys: "Credentials", roster: Roster) -> dict[str, object]:
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(keys.authority),
            "enable_mtls": True,
            "listen_certificate": str(keys.certificate),
            "listen_private_key": str(keys.key),
            "close_link_on_expiration": True,
        },
        "access_control": access_control(roster),
    }


@contextmanager
def router(
    listen: str = "tcp/127.0.0.1:0", keys: "tuple[Credentials, Roster] | None" = None
) -> Iterator[str]:
    """A router in this process; yields the endpoint that it is bound to.

    keys: the router's own, and whom it lets in: then it speaks TLS alone, and says on stderr or
    stdout why it refuses whom. Raises `BusError` when it can not listen there.
    """
    settings: dict[str, object] = {
        "mode": "router",
        "listen/endpoints": [listen],
        "adminspace/enabled": True,
    }
    if keys is not None:
        if not listen.startswith("tls/"):
            raise BusError(f"{listen}: with keys a router listens at tls/HOST:PORT")
        zenoh.init_log_from_env_or(REFUSALS)
        settings |= _router_tls(*keys)
    try:
        session = _session(settings)
    except zenoh.ZError as error:
        raise BusError(
            f"can not listen at {listen}: the port is taken or the address is not this machine's; "
            f"choose another, or port 0 for any free one"
        ) from error
    with session:
        _Keeper(session)
        door = keys and session.liveliness().declare_token(f"team/{keys[1].team}/{DOOR}")
        replies = session.get(f"@/{session.zid()}/router", timeout=2.0)
        locators = [json.loads(r.ok.payload.to_string())["locators"] for r in replies if r.ok]
        if not (locators and locators[0]):
            raise BusError(f"the router at {listen} does not tell its endpoint")
        yield str(locators[0][0])
        del door  # held until here


class _Keeper:
    """Keeps each team's final map and orders at the router, and answers for who has left."""

    def __init__(self, session: zenoh.Session) -> None:
        self._teams: defaultdict[str, Kept] = defaultdict(Kept)
        for channel in (FINAL_MAP, GIVEN_UP, TALLY):
            key = f"team/*/{channel.key('**')}"
            session.declare_subscriber(key, Callback(self._take, indirect=False))
        session.liveliness().declare_subscriber(
            f"team/*/{ALIVE.key('**')}", Callback(self._token, indirect=False), history=True
        )
        for channel, answer in ((FINAL_KEPT, self._final), (ORDERS_KEPT, self._orders)):
            key = f"team/*/{channel.key()}"
            session.declare_queryable(key, Callback(answer, indirect=False))

    def _of(self, key: zenoh.KeyExpr) -> tuple[Kept, str]:
        """What is kept of a key's team, and the key within the team."""
        _, team, rest = str(key).split("/", 2)
        return self._teams[team], rest

    def _take(self, sample: zenoh.Sample) -> None:
        kept, key = self._of(sample.key_expr)
        if key == FINAL_MAP.key():
            kept.end(sample.payload.to_bytes(), time.monotonic())
        elif (node := GIVEN_UP.owner(key)) is not None:
            kept.order(node, sample.payload.to_bytes())
        elif (node := TALLY.owner(key)) is not None:
            kept.last_word(node)

    def _token(self, sample: zenoh.Sample) -> None:
        kept, key = self._of(sample.key_expr)
        node = ALIVE.owner(key)
        if node is not None and kept.token(node, alive=sample.kind == zenoh.SampleKind.PUT):
            _LOG.warning(
                "%s of %s has gone without a last word: it was killed or cut off, or its "
                "certificate has ended or is revoked",
                node,
                str(sample.key_expr).split("/", 2)[1],
            )

    def _final(self, query: zenoh.Query) -> None:
        with query:
            kept, _ = self._of(query.key_expr)
            found = kept.answer(_asker(query), time.monotonic())
            if found is not None:
                query.reply(query.key_expr, encoded(found))

    def _orders(self, query: zenoh.Query) -> None:
        with query:
            for order in self._of(query.key_expr)[0].orders():
                query.reply(query.key_expr, order)


def _asker(query: zenoh.Query) -> str:
    """The node that asks for a final map; nobody's name where it does not say."""
    with suppress(WireError):
        request = b"" if query.payload is None else query.payload.to_bytes()
        return decoded(request, FinalMapRequest).node
    return ""
