"""The bus over Zenoh: publish, subscribe, query and answer for one process of the team.

Zenoh's receiving thread fills one unbounded queue: the order of arrival is preserved across
subscriptions, and a slow node never blocks the link (the team's credit bounds the queue).
"""

import atexit
import threading
import time
from collections.abc import Collection
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Self

import zenoh
from zenoh.handlers import Callback

from teamslam.team.wire.bus import Answer, BusError, Outgoing, Sample, Tap, read_reply
from teamslam.team.wire.channels import ALIVE, KEPT, REPLIES, TALLY, Channel, row_of
from teamslam.team.wire.codec import LARGEST_PAYLOAD, WireError, encoded
from teamslam.team.wire.logs import LOG, cut
from teamslam.team.wire.messages import Liveliness, Message, Tally
from teamslam.team.wire.zenoh.delivery import (
    PRIORITY,
    Attachment,
    AttachmentError,
    Publisher,
    declare_publisher,
    pack,
    subscribe,
    unpack,
)
from teamslam.team.wire.zenoh.recovery import Recovery, Work
from teamslam.team.wire.zenoh.session import RouterLink, client

if TYPE_CHECKING:  # not needed without keys
    from teamslam.team.keys.credentials import Credentials

_ALIVE_TIMEOUT_S = 5.0
_ANSWER_S = 10.0
_EACH_REPLY: dict[str, Any] = {
    "consolidation": zenoh.ConsolidationMode.NONE,  # each reply, not the newest per key
    "congestion_control": zenoh.CongestionControl.BLOCK,
}
_FLUSH = "router/flush"
_FLUSH_S = 10.0  # a closing bus waits this long for a router that reads slowly or is stopped
MOST_WAITING = 1_000
"""Queue length beyond which an observing node drops dispensable samples, of some 10 kB each."""
MOST_KEYS = 16_384  # most keys on which a bus receives samples; a team of 100 robots has 4,500


class ZenohBus:
    """A bus over one Zenoh session: a client of the router at `connect`.

    keys: for TLS; None: TCP. sheds: dispensable channels. stop: wait for a silent router until this
    event. Raises `BusError` when no router answers within `patience_s`, or either side refuses the
    other. One thread publishes and receives; `close` may be called from any.
    """

    def __init__(
        self,
        team: str,
        connect: str,
        patience_s: float = 10.0,
        keys: "Credentials | None" = None,
        sheds: Collection[Channel] = (),
        stop: threading.Event | None = None,
    ) -> None:
        self._prefix = f"team/{team}/"
        self._sheds = frozenset(channel.name for channel in sheds)
        self._queue: SimpleQueue[Work | None] = SimpleQueue()
        self._publishers: dict[str, Publisher] = {}
        self._requested: set[tuple[str, str]] = set()
        self._open_queries: set[tuple[str, str]] = set()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._published: dict[str, int] = {}
        self._newest_ns = 0
        self._since_ns = time.time_ns()
        self.tap: Tap | None = None  # receives all samples that this bus publishes and receives
        self.dropped = 0
        """Samples dropped for a key of no channel, an unsound attachment, or another publisher's
        key.
        """
        self._keys_received: set[str] = set()
        self._counting = threading.Lock()
        self._closed = threading.Event()
        self._keys = keys
        self._session = client(connect, patience_s, keys, stop)
        self._recovery = Recovery(self._session, self._prefix, self._admit, self._queue.put)
        self._link = RouterLink(self._session, connect, keys)
        # While the interpreter ends no thread of Zenoh may call it any more.
        atexit.register(self._end_session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Publish what is pending, withdraw the tokens, and wake a waiting receiver."""
        if not self._closed.is_set():
            with suppress(BusError):
                self.publish_totals()
            self._closed.set()
            self._flush()
            atexit.unregister(self._end_session)
            self._end_session()
            self._queue.put(None)

    def _end_session(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call] # the stub has no `-> None`

    def _flush(self) -> None:
        """Wait until the router has received the publications: a query follows them."""
        with suppress(zenoh.ZError):
            for _ in self._session.get(
                self._prefix + _FLUSH,
                priority=PRIORITY,
                congestion_control=zenoh.CongestionControl.BLOCK,
                timeout=_FLUSH_S,
            ):
                pass

    def publish_totals(self) -> Tally | None:
        if not self._tokens:
            return None
        node = next(iter(self._tokens))
        own = TALLY.key(node)
        counts = dict(sorted({**self._published, own: self._published.get(own, 0) + 1}.items()))
        tally = Tally(
            stamp_ns=self._newest_ns,
            node=node,
            since_ns=self._since_ns,
            keys=tuple(counts),
            counts=tuple(counts.values()),
        )
        self.publish(Outgoing(TALLY, node, tally))
        return tally

    def publish(self, out: Outgoing) -> int:
        """Encode and publish; after ten seconds of a busy link Zenoh drops it and connects anew."""
        counter = self._published.get(out.key, 0)
        stamp_ns = out.message.stamp_ns
        payload = encoded(out.message)
        self.publish_raw(Sample(out.key, payload, stamp_ns, time.time_ns(), counter))
        return len(payload)

    def publish_raw(self, sample: Sample) -> None:
        """Publish a sample unchanged, with its key's delivery (default: stream)."""
        self._check_open()
        if len(sample.payload) > LARGEST_PAYLOAD:
            raise BusError(
                f"{sample.key}: {len(sample.payload)} bytes, {LARGEST_PAYLOAD} at most; "
                "split the map or send blocks instead of the joint covariance"
            )
        stamps = Attachment(sample.stamp_ns, sample.wall_ns, sample.counter)
        attachment = pack(self._prefix + sample.key, stamps)
        try:
            publisher = self._publishers.get(sample.key)
            if publisher is None:
                publisher = self._publishers[sample.key] = declare_publisher(
                    self._session, self._prefix, sample.key
                )
            publisher.put(sample.payload, attachment=attachment)
            before = self._published.get(sample.key, 0)
            self._published[sample.key] = max(before, sample.counter + 1)
            self._newest_ns = max(self._newest_ns, sample.stamp_ns)
            if self.tap is not None:
                self.tap([sample])
        except zenoh.ZError as error:
            raise BusError(f"{sample.key}: not published, {error}") from error

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        self._check_open()
        if {(channel.name, "*"), (channel.name, name)} & self._requested:
            return
        if name == "*" and any(requested == channel.name for requested, _ in self._requested):
            raise BusError(
                f"{channel.name}: subscribed by name already, so `*` would deliver twice"
            )
        self._requested.add((channel.name, name))
        if whole:
            self._recovery.take_whole(channel.name)
        put = self._shed if channel.name in self._sheds else self._admit
        for selector in channel.selectors(name):
            key = self._prefix + selector
            subscribe(self._session, key, channel, put, whole=whole)
            if channel.delivery != "stream" and channel.name not in self._sheds:
                self._recovery.watch(key)

    def _admit(self, sample: zenoh.Sample) -> None:
        if self._is_admitted(sample):
            self._queue.put(partial(self._take_sample, sample))

    def _is_admitted(self, sample: zenoh.Sample) -> bool:
        """Drop samples on keys of no channel or of too many keys."""
        key = str(sample.key_expr).removeprefix(self._prefix)
        if key not in self._keys_received:
            if row_of(key) is None:
                self._drop(key, "no channel has this key")
                return False
            if len(self._keys_received) >= MOST_KEYS:
                self._drop(key, f"samples of {MOST_KEYS} other keys came before")
                return False
            self._keys_received.add(key)
        return True

    def _drop(self, key: str, why: str) -> None:
        with self._counting:
            self.dropped += 1
        LOG.warning("%s: dropped, %s (%d so far)", cut(key, 80), why, self.dropped)

    def _shed(self, sample: zenoh.Sample) -> None:
        if self._queue.qsize() < MOST_WAITING:
            self._admit(sample)

    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        """Return the samples since the last call, and answer the queries on the caller's thread.

        Samples that arrive during the call are left for the next, which bounds it for a fast team.
        """
        self._check_open()
        self._link.look(time.monotonic())
        samples: list[Sample] = []
        until = time.monotonic() + timeout_s
        waiting: int | None = None
        with suppress(Empty):
            while waiting is None or waiting > 0:
                wait = 0.0 if samples else until - time.monotonic()
                work = self._queue.get(timeout=wait) if wait > 0.0 else self._queue.get_nowait()
                if work is None:  # the bus closes
                    break
                samples += work()
                if waiting is not None:
                    waiting -= 1
                elif samples or time.monotonic() >= until:
                    waiting = self._queue.qsize()
        samples += self._recovery.overdue(time.monotonic())
        if self.tap is not None and samples:
            self.tap(samples)
        return samples

    def _take_token(self, token: zenoh.Sample) -> list[Sample]:
        node = ALIVE.owner(str(token.key_expr).removeprefix(self._prefix))
        if node is None or node in self._tokens:
            return []
        alive = token.kind == zenoh.SampleKind.PUT
        payload = encoded(Liveliness(stamp_ns=0, node=node, alive=alive))
        return [Sample(ALIVE.key(node), payload, 0, time.time_ns(), 0)]

    def _take_sample(self, received: zenoh.Sample) -> list[Sample]:
        whole, attached = str(received.key_expr), received.attachment
        try:
            beside = unpack(whole, b"" if attached is None else attached.to_bytes())
        except AttachmentError as error:  # counts as missing: recovered from its publisher's cache
            self._drop(whole, str(error))
            return []
        key = whole.removeprefix(self._prefix)
        sample = Sample(key, received.payload.to_bytes(), *beside)
        row = row_of(key)
        is_shed = row is not None and row.name in self._sheds
        if received.source_info is None or is_shed:  # lost samples are not requested
            return [sample]
        return self._recovery.take_sample(sample, received.source_info)

    def redeliver(self) -> None:
        self._recovery.redeliver()

    def find_missing(self) -> dict[str, list[tuple[int, int]]]:
        return self._recovery.find_missing()

    def find_awaited(self) -> set[str]:
        return self._recovery.find_awaited()

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        self._check_open()

        def take(query: zenoh.Query) -> None:
            self._queue.put(partial(_reply_to, query, answer))

        self._session.declare_queryable(
            self._prefix + channel.key(name), Callback(take, indirect=False)
        )

    def ask(self, channel: Channel, name: str, request: Message, timeout_s: float) -> list[bytes]:
        """Query as a bus does; meanwhile this one answers no queries."""
        self._check_open()
        key = self._prefix + channel.key(name)
        payloads: list[bytes] = []
        for reply in self._session.get(
            key, payload=encoded(request), timeout=timeout_s, **_EACH_REPLY
        ):
            if reply.ok is None:
                text = _reason(reply.err)
                raise BusError(f"{key}: {text} (waited at most {timeout_s} s)")
            payloads.append(reply.ok.payload.to_bytes())
        if self.tap is not None and channel in REPLIES and channel is not KEPT:
            wall_ns = time.time_ns()
            with suppress(WireError):  # the caller decodes them and reports the error
                self.tap([read_reply(channel, name, payload, wall_ns) for payload in payloads])
        return payloads

    def request(self, channel: Channel, name: str, request: Message) -> None:
        self._check_open()
        if (channel.name, name) in self._open_queries:
            return
        self._open_queries.add((channel.name, name))

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                payload = reply.ok.payload.to_bytes()
                self._queue.put(partial(_read_reply, channel, name, payload))
            elif reply.err is not None:
                self._queue.put(partial(self._end_query, channel, name, _reason(reply.err)))

        def end() -> None:
            self._queue.put(partial(self._end_query, channel, name))

        self._session.get(
            self._prefix + channel.key(name),
            Callback(take, drop=end, indirect=False),
            payload=encoded(request),
            timeout=_ANSWER_S,
            **_EACH_REPLY,
        )

    def _end_query(self, channel: Channel, name: str, wrong: str = "") -> list[Sample]:
        self._open_queries.discard((channel.name, name))
        if wrong:
            LOG.warning("%s: %s (waited at most %s s)", channel.key(name), wrong, _ANSWER_S)
        return []

    def declare_alive(self, node: str) -> None:
        self._check_open()
        if node not in self._tokens:
            key = self._prefix + ALIVE.key(node)
            self._tokens[node] = self._session.liveliness().declare_token(key)

    def watch_alive(self, node: str = "*") -> None:
        self._check_open()

        def notice(sample: zenoh.Sample) -> None:
            if self._is_admitted(sample):
                self._queue.put(partial(self._take_token, sample))

        for selector in ALIVE.selectors(node):
            self._session.liveliness().declare_subscriber(
                self._prefix + selector, Callback(notice, indirect=False), history=True
            )

    def is_alive(self, node: str) -> bool:
        self._check_open()
        key = self._prefix + ALIVE.key(node)
        replies = self._session.liveliness().get(key, timeout=_ALIVE_TIMEOUT_S)
        return any(reply.ok is not None for reply in replies)

    def other_teams(self) -> list[str]:
        """Return the names of other teams with processes at this router."""
        self._check_open()
        keys = [
            str(reply.ok.key_expr)
            for selector in ALIVE.selectors()
            for reply in self._session.liveliness().get(
                f"team/*/{selector}", timeout=_ALIVE_TIMEOUT_S
            )
            if reply.ok is not None
        ]
        return sorted({each.split("/")[1] for each in keys if not each.startswith(self._prefix)})

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise BusError("the bus is closed")
        if self._keys is not None and time.time() > self._keys.ends.timestamp():
            raise BusError(
                f"{self._keys.certificate} has expired, so the router has closed the link: renew "
                f"it by `teamslam keys {self._keys.team} -o DIR --renew {self._keys.node}`, copy "
                "it, and start this process again"
            )


def _reply_to(query: zenoh.Query, answer: Answer) -> list[Sample]:
    """Answer a query; the sender of an invalid request receives the error."""
    request = b"" if query.payload is None else query.payload.to_bytes()
    with query:
        try:
            for payload in answer(request):
                query.reply(query.key_expr, payload)  # blocks as its query does
        except ValueError as error:
            query.reply_err(str(error))
    return []


def _read_reply(channel: Channel, name: str, payload: bytes) -> list[Sample]:
    try:
        return [read_reply(channel, name, payload, time.time_ns())]
    except WireError as error:
        LOG.warning("%s: dropped a reply: %s", channel.key(name), error)
        return []


def _reason(error: zenoh.ReplyError | None) -> str:
    text = "" if error is None else error.payload.to_bytes().decode("utf-8", "replace")
    return text or "no answer"
