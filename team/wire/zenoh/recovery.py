"""What has not arrived of what was published is asked for at its publisher's cache.

Zenoh's advanced subscriber does most of this, but not all: of late joiners some get a part of the
history. So what arrives of each publisher is counted (`team.wire.zenoh.arrivals`), compared with
its heartbeats, and what has been missing for half a second is asked for.
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
"""In the key of what an advanced publisher says beside its publications."""
_BEAT = struct.Struct("<I")  # a heartbeat's payload: the number of the last publication
_LOOK_S = 0.1  # between two looks at what is missing
_ANSWER_S = 10.0
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Heartbeat:
    """A publisher's number of the last publication on a key."""

    key: str
    publisher: str
    newest: int


@dataclass
class CacheAnswer:
    """An answer of a publisher's cache that has come to its end: what was asked, what came."""

    key: str
    publisher: str
    first: int
    repeated: bool
    newest: int = -1
    failed: bool = False


class Recovery:
    """Of one session. Heartbeats and answers go into `put` on Zenoh's thread; all else is one's."""

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
        """Listen to the heartbeats of the publishers of a key, with the session's prefix."""
        self._session.declare_subscriber(
            f"{key}{ADVANCED}**",
            Callback(self._beat, indirect=False),
            allowed_origin=zenoh.Locality.REMOTE,
        )

    def take_whole(self, channel: str) -> None:
        """Of this `latest` channel all is wanted that its publishers still have."""
        self._whole.add(channel)

    def _beat(self, sample: zenoh.Sample) -> None:
        """On the receiving thread: a heartbeat that says something new."""
        name, beat = str(sample.key_expr), sample.payload.to_bytes()
        if len(beat) == _BEAT.size and self._beats.get(name) != beat:
            self._beats[name] = beat
            key, _, rest = name.removeprefix(self._prefix).partition(ADVANCED)
            publisher = "/".join(rest.split("/")[:2])
            self._put(Heartbeat(key, publisher, *_BEAT.unpack(beat)))

    def heard(self, beat: Heartbeat) -> None:
        """A publisher's last number is known."""
        self._arrivals_of(beat.key, beat.publisher, beat.newest).know(beat.newest)
        self._incomplete.add((beat.key, beat.publisher))

    def answered(self, answer: CacheAnswer) -> list[Sample]:
        """A cache has answered in full: what is delivered now, since the rest is gone."""
        if not answer.repeated or answer.failed or answer.newest < 0:
            return []
        arrivals = self._arrivals_of(answer.key, answer.publisher, answer.newest)
        return arrivals.answered(answer.first, answer.newest)

    def arrived(self, sample: Sample, source: zenoh.SourceInfo) -> list[Sample]:
        """A publication has come: what is delivered now, each once and in its order."""
        publisher, number = _numbered(source)
        arrivals = self._arrivals_of(sample.key, publisher, number)
        delivered = arrivals.take(number, sample)
        if arrivals.missing is not None:
            self._incomplete.add((sample.key, publisher))
        return delivered

    def _arrivals_of(self, key: str, publisher: str, heard: int) -> Arrivals[Sample]:
        """Of a `latest` channel nothing is asked for that is older than the first heard of."""
        found = self._arrivals.get((key, publisher))
        if found is None:
            row = row_of(key)
            whole = row is None or row.delivery == "all" or row.name in self._whole
            found = Arrivals(0 if whole else heard, in_order=whole)
            self._arrivals[key, publisher] = found
        return found

    def overdue(self, now_s: float) -> list[Sample]:
        """Request what has been missing for a while; returns samples that no longer wait for it."""
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


def _numbered(info: zenoh.SourceInfo) -> tuple[str, int]:
    """The publisher, as its heartbeats name it, and its number of the publication."""
    return f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn
