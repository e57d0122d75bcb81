"""Requests publications that have not arrived from their publisher's cache.

Zenoh's advanced subscriber does most of this, but some late joiners receive only a part of the
history. The arrivals of each publisher are therefore counted (`team.wire.zenoh.arrivals`) and
compared with its heartbeats, and what has been missing for half a second is requested.
"""

import logging
import struct
from collections.abc import Callable
from dataclasses import dataclass

import zenoh
from zenoh.handlers import Callback

from team.wire.bus import Sample
from team.wire.channels import row_of
from team.wire.zenoh.arrivals import Arrivals

ADVANCED = "/@adv/pub/"
"""Part of the keys on which an advanced publisher sends its heartbeats."""
_BEAT = struct.Struct("<I")  # a heartbeat's payload: the number of the last publication
_LOOK_S = 0.1  # between two looks at what is missing
_ANSWER_S = 10.0
_NEVER = 2**63
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Heartbeat:
    """The number of a publisher's last publication on a key."""

    key: str
    publisher: str
    newest: int


@dataclass
class CacheAnswer:
    """A complete reply of a publisher's cache: the requested interval, and the samples."""

    key: str
    publisher: str
    first: int
    repeated: bool
    newest: int = -1
    failed: bool = False


class Recovery:
    """The recovery of one session. Zenoh's thread passes heartbeats and replies to `put`; all other
    methods are for one thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        put: Callable[[zenoh.Sample | Heartbeat | CacheAnswer], None],
    ) -> None:
        self._session = session
        self._prefix = prefix
        self._put = put
        self._whole: set[str] = set()
        self._beats: dict[str, bytes] = {}
        self._arrivals: dict[tuple[str, str], Arrivals[Sample]] = {}
        self._incomplete: set[tuple[str, str]] = set()
        self._look_due = 0.0

    def watch(self, key: str) -> None:
        """Subscribes to the heartbeats of the publishers of a key, given with the session's
        prefix.
        """
        self._session.declare_subscriber(
            f"{key}{ADVANCED}**",
            Callback(self._beat, indirect=False),
            allowed_origin=zenoh.Locality.REMOTE,
        )

    def take_whole(self, channel: str) -> None:
        """Requests all samples that the publishers of this `latest` channel still have."""
        self._whole.add(channel)

    def _beat(self, sample: zenoh.Sample) -> None:
        """Passes on a heartbeat with a new number; called on Zenoh's receiving thread."""
        name, beat = str(sample.key_expr), sample.payload.to_bytes()
        if len(beat) == _BEAT.size and self._beats.get(name) != beat:
            self._beats[name] = beat
            key, _, rest = name.removeprefix(self._prefix).partition(ADVANCED)
            publisher = "/".join(rest.split("/")[:2])
            if publisher:
                self._put(Heartbeat(key, publisher, *_BEAT.unpack(beat)))

    def take_heartbeat(self, beat: Heartbeat) -> None:
        """Records a publisher's last number."""
        self._arrivals_of(beat.key, beat.publisher, beat.newest).know(beat.newest)
        self._incomplete.add((beat.key, beat.publisher))

    def answered(self, answer: CacheAnswer) -> list[Sample]:
        """Records that a cache's reply is complete; returns the samples to be delivered now."""
        if not answer.repeated or answer.failed or answer.newest < 0:
            return []
        arrivals = self._arrivals_of(answer.key, answer.publisher, answer.newest)
        return arrivals.answered(answer.first, answer.newest)

    def arrived(self, sample: Sample, source: zenoh.SourceInfo) -> list[Sample]:
        """Records a received publication; returns the samples to be delivered now, each once and in
        order.
        """
        publisher, number = _numbered(source)
        arrivals = self._arrivals_of(sample.key, publisher, number)
        delivered = arrivals.take(number, sample)
        if arrivals.missing is not None:
            self._incomplete.add((sample.key, publisher))
        return delivered

    def _arrivals_of(self, key: str, publisher: str, first_known: int) -> Arrivals[Sample]:
        """The arrivals of one publisher on one key; on a `latest` channel nothing older than the
        first known number is requested, on a key of no channel nothing.

        After a link was cut, Zenoh may hand over samples on keys that are composed of parts of
        others: docs/decisions/07.
        """
        found = self._arrivals.get((key, publisher))
        if found is None:
            row = row_of(key)
            whole = row is not None and (row.delivery == "all" or row.name in self._whole)
            first = _NEVER if row is None else 0 if whole else first_known
            found = Arrivals(first, in_order=whole)
            self._arrivals[key, publisher] = found
        return found

    def overdue(self, now_s: float) -> list[Sample]:
        """Requests what has been missing for a while; returns samples that no longer wait for
        it.
        """
        if now_s < self._look_due or not self._incomplete:
            return []
        self._look_due = now_s + _LOOK_S
        late: list[Sample] = []
        for key, publisher in sorted(self._incomplete):
            arrivals = self._arrivals[key, publisher]
            requested = arrivals.due(now_s)
            if arrivals.missing is None:
                self._incomplete.discard((key, publisher))
            elif requested is not None:
                self._ask_cache(key, publisher, *requested)
            late += arrivals.overdue(now_s)
        return late

    def _ask_cache(self, key: str, publisher: str, first: int, last: int | None) -> None:
        answer = CacheAnswer(key, publisher, first, repeated=last is None)

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                answer.failed = True
            elif reply.ok.source_info is not None:
                answer.newest = max(answer.newest, _numbered(reply.ok.source_info)[1])
                self._put(reply.ok)

        until = "" if last is None else str(last)
        _LOG.info("%s: %d to %s are missing, asked for", key, first, until or "the newest")
        self._session.get(
            f"{self._prefix}{key}{ADVANCED}{publisher}/**?_anyke;_sn={first}..{until}",
            Callback(take, drop=lambda: self._put(answer), indirect=False),
            timeout=_ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            target=zenoh.QueryTarget.ALL,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def again(self) -> None:
        """Requests and delivers all samples of `all` channels and whole subscriptions once more."""
        self._arrivals.clear()
        self._incomplete.clear()
        self._beats.clear()  # so that the next heartbeats are news

    def lacking(self) -> dict[str, list[tuple[int, int]]]:
        """Samples that are known to exist and were not received: by key, intervals of a publisher's
        counters.

        It includes samples that their publisher no longer has.
        """
        found: dict[str, list[tuple[int, int]]] = {}
        for (key, _), arrivals in sorted(self._arrivals.items()):
            if intervals := arrivals.lacking:
                found.setdefault(key, []).extend(intervals)
        return found


def _numbered(info: zenoh.SourceInfo) -> tuple[str, int]:
    """The publisher, by the name that its heartbeats have, and its number of the publication."""
    return f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn
