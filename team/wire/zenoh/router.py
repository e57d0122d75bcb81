"""The router of a team, and the messages that it stores for late joiners."""

import json
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import zenoh
from zenoh.handlers import Callback

from teamslam.team.keys.roster import Roster
from teamslam.team.wire.bus import BusError, Sample
from teamslam.team.wire.channels import ALIVE, KEPT, REPLIES, TALLY
from teamslam.team.wire.codec import WireError, decoded
from teamslam.team.wire.logs import LOG
from teamslam.team.wire.messages import KeptRequest
from teamslam.team.wire.zenoh.access import access_control
from teamslam.team.wire.zenoh.delivery import AttachmentError, unpack
from teamslam.team.wire.zenoh.session import ACCEPTED, DOOR, REVOKED, open_session, tls_settings
from teamslam.team.wire.zenoh.stored_samples import StoredMessages

if TYPE_CHECKING:  # not needed without keys
    from teamslam.team.keys.credentials import Credentials

REFUSALS = "error,zenoh_link_tls=warn"
"""Zenoh's log filter with keys: refused connections, with reasons."""
DROP_US = 300_000
"""Time [µs] that a publication waits for a subscriber's full queue before it is dropped.

Zenoh then drops further publications to it at once until it reads again: a stopped subscriber
delays the others once.
"""
DROP_LARGE_US = 1_000_000  # additional time [µs] for a publication of more than one batch
CLOSE_US = 2_000_000
"""Time [µs] that a reply or a query waits for a full queue before the link is closed.

Its process reconnects. A publication dropped for its size is fetched by a query, so a message of S
bytes needs a link of (S − 5 MB) in that time.
"""
QUEUE_BATCHES = 16  # batches of 64 kB per subscriber's queue, Zenoh's largest number
RX_THREADS = 128  # receiving threads; more than a team has links
_CONGESTION = "transport/link/tx/queue/congestion_control"
_DROPS = {
    "messages": ["put"],
    "flows": ["egress"],
    "overwrite": {"congestion_control": "drop"},
}
"""Publishers block on their own full queue; publications leaving the router do not."""
MOST_TEAMS = 1_000  # number of teams for which a router without keys stores messages


@contextmanager
def router(
    listen: str = "tcp/127.0.0.1:0", keys: "tuple[Credentials, Roster] | None" = None
) -> Iterator[str]:
    """Run a router in this process; yield its endpoint.

    keys: the router's credentials and the roster of accepted nodes, for TLS only. Raises `BusError`
    when it cannot listen there.
    """
    settings: dict[str, object] = {
        "mode": "router",
        "listen/endpoints": [listen],
        "adminspace/enabled": True,
        f"{_CONGESTION}/drop/wait_before_drop": DROP_US,
        f"{_CONGESTION}/drop/max_wait_before_drop_fragments": DROP_LARGE_US,
        f"{_CONGESTION}/block/wait_before_close": CLOSE_US,
        "transport/link/tx/queue/size/data": QUEUE_BATCHES,
        "qos/network": [_DROPS],
    }
    # A message to a slow subscriber blocks the thread of its publisher's link, and the slow link is
    # closed on one of these threads, too. The default is two.
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {RX_THREADS}))")
    if keys is not None:
        if not listen.startswith("tls/"):
            raise BusError(f"{listen}: with keys a router listens at tls/HOST:PORT")
        zenoh.init_log_from_env_or(REFUSALS)
        settings |= tls_settings(keys[0], "listen") | {"access_control": access_control(keys[1])}
    try:
        session = open_session(settings)
    except zenoh.ZError as error:
        raise BusError(
            f"can not listen at {listen}: the port is taken or the address is not this machine's; "
            f"choose another, or port 0 for any free one"
        ) from error
    with session:
        _Keeper(session, "*" if keys is None else keys[1].team)
        if keys is not None:
            _answer_door(session, keys[1])
        replies = session.get(f"@/{session.zid()}/router", timeout=2.0)
        locators = [json.loads(r.ok.payload.to_string())["locators"] for r in replies if r.ok]
        if not (locators and locators[0]):
            raise BusError(f"the router at {listen} does not report its endpoint")
        yield str(locators[0][0])


class _Keeper:
    """Stores each team's ends and operators' orders, and answers queries for them.

    team: the only team of a router with keys, for its access control; "*": any team.
    """

    def __init__(self, session: zenoh.Session, team: str) -> None:
        self._teams: defaultdict[str, StoredMessages] = defaultdict(StoredMessages)
        for channel in (TALLY, *REPLIES[KEPT]):
            for selector in channel.selectors():
                key = f"team/{team}/{selector}"
                session.declare_subscriber(key, Callback(self._take, indirect=False))
        for selector in ALIVE.selectors():
            session.liveliness().declare_subscriber(
                f"team/{team}/{selector}", Callback(self._token, indirect=False), history=True
            )
        session.declare_queryable(
            f"team/{team}/{KEPT.key()}", Callback(self._answer, indirect=False)
        )

    def _of(self, key: zenoh.KeyExpr) -> tuple[StoredMessages, str]:
        _, team, rest = str(key).split("/", 2)
        if team not in self._teams and len(self._teams) >= MOST_TEAMS:
            return StoredMessages(), rest  # not kept
        return self._teams[team], rest

    def _take(self, sample: zenoh.Sample) -> None:
        stored, key = self._of(sample.key_expr)
        if (node := TALLY.owner(key)) is not None:
            stored.last_word(node)
            return
        beside = b"" if sample.attachment is None else sample.attachment.to_bytes()
        try:
            attached = unpack(str(sample.key_expr), beside)
            stored.take(Sample(key, sample.payload.to_bytes(), *attached), time.monotonic())
        except (AttachmentError, WireError) as error:  # its receivers drop and log it
            LOG.debug("%r: not stored: %s", key[:80], error)

    def _token(self, sample: zenoh.Sample) -> None:
        stored, key = self._of(sample.key_expr)
        node = ALIVE.owner(key)
        if node is not None and stored.token(node, alive=sample.kind == zenoh.SampleKind.PUT):
            LOG.warning(
                "%s of %s has gone without a last word: it was killed or cut off, or its "
                "certificate has ended or is revoked",
                node,
                str(sample.key_expr).split("/", 2)[1],
            )

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            request = b"" if query.payload is None else query.payload.to_bytes()
            with suppress(WireError):
                stored, _ = self._of(query.key_expr)
                for reply in stored.answer(decoded(request, KeptRequest), time.monotonic()):
                    query.reply(query.key_expr, reply)


def _answer_door(session: zenoh.Session, roster: Roster) -> None:
    names = {roster.common_name(node) for node in roster.nodes}

    def answer(query: zenoh.Query) -> None:
        with query:
            accepted = str(query.key_expr).rpartition("/")[2] in names
            query.reply(query.key_expr, ACCEPTED if accepted else REVOKED)

    session.declare_queryable(f"team/{roster.team}/{DOOR}/*", Callback(answer, indirect=False))
