"""Queries that a node answers, and those that it sends, over one session."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh
from zenoh.handlers import Callback

from teamslam.team.wire.bus import Answer, BusError, Sample, read_reply
from teamslam.team.wire.channels import Channel
from teamslam.team.wire.codec import WireError, encoded
from teamslam.team.wire.messages import Message

_ANSWER_S = 10.0
_LOG = logging.getLogger("teamslam")


@dataclass(frozen=True, repr=False)
class Question:
    """A received query and the function that answers it."""

    query: zenoh.Query
    answer: Answer

    def reply(self) -> None:
        """Answer the query; the sender of an invalid request receives the error."""
        request = b"" if self.query.payload is None else self.query.payload.to_bytes()
        with self.query as query:
            try:
                for payload in self.answer(request):
                    query.reply(query.key_expr, payload)  # blocks as its query does
            except ValueError as error:
                query.reply_err(str(error))


@dataclass(frozen=True)
class Reply:
    """One reply to a request; without a payload its end, or an error with its reason."""

    channel: Channel
    name: str
    payload: bytes | None
    wrong: str = ""


class Queries:
    """Queries of one session. Zenoh's thread calls `put`; all other methods are for one thread."""

    def __init__(
        self, session: zenoh.Session, prefix: str, put: Callable[[Question | Reply], None]
    ) -> None:
        self._session = session
        self._prefix = prefix
        self._put = put
        self._requests: set[tuple[str, str]] = set()

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        """Pass the queries of this channel to `put`, with the function that answers them."""

        def take(query: zenoh.Query) -> None:
            self._put(Question(query, answer))

        self._session.declare_queryable(
            self._prefix + channel.key(name), Callback(take, indirect=False)
        )

    def ask(self, channel: Channel, name: str, request: Message, timeout_s: float) -> list[bytes]:
        """Query and return the replies' payloads in order; raises `BusError` as the bus does."""
        key = self._prefix + channel.key(name)
        replies = self._session.get(
            key,
            payload=encoded(request),
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,  # each reply, not the newest per key
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        payloads: list[bytes] = []
        for reply in replies:
            if reply.ok is None:
                text = _reason(reply.err)
                raise BusError(f"{key}: {text} (waited at most {timeout_s} s)")
            payloads.append(reply.ok.payload.to_bytes())
        return payloads

    def request(self, channel: Channel, name: str, request: Message) -> None:
        """Query without waiting: replies go to `put`. No effect while the same query is open."""
        if (channel.name, name) in self._requests:
            return
        self._requests.add((channel.name, name))

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._put(Reply(channel, name, reply.ok.payload.to_bytes()))
            elif reply.err is not None:
                self._put(Reply(channel, name, None, _reason(reply.err)))

        self._session.get(
            self._prefix + channel.key(name),
            Callback(take, drop=lambda: self._put(Reply(channel, name, None)), indirect=False),
            payload=encoded(request),
            timeout=_ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def read_reply(self, reply: Reply) -> list[Sample]:
        """Convert a reply to a sample; empty for the end or an invalid reply."""
        key = reply.channel.key(reply.name)
        if reply.payload is None:
            self._requests.discard((reply.channel.name, reply.name))
            if reply.wrong:
                _LOG.warning("%s: %s (waited at most %s s)", key, reply.wrong, _ANSWER_S)
            return []
        try:
            return [read_reply(reply.channel, reply.name, reply.payload, time.time_ns())]
        except WireError as error:
            _LOG.warning("%s: dropped a reply: %s", key, error)
            return []


def _reason(error: zenoh.ReplyError | None) -> str:
    text = "" if error is None else error.payload.to_bytes().decode("utf-8", "replace")
    return text or "no answer"
