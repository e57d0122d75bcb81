"""A process's link to its team's router: how it is opened, and whether the router still accepts it.

Every process is a client of one router, a star without discovery: a process that is not configured
can not connect, and the router is the single place where the traffic of a team is controlled or
watched.
"""

import json
import time
from typing import TYPE_CHECKING

import zenoh
from zenoh.handlers import Callback

from team.wire.bus import BusError
from team.wire.codec import LARGEST_PAYLOAD

if TYPE_CHECKING:  # a node without keys needs none of it
    from team.keys.credentials import Credentials

_LEASE_MS = 5_000  # of silence before a link counts as cut: a stopped process is noticed
_BLOCK_US = 10_000_000  # that a full queue may stop a publisher before its link is closed
FIRST_LOOK_S = 3.0
"""Time [s] without a connection after which a client finds out why."""
LINK_S = 1.0
"""Interval [s] at which a node with keys checks that the router still accepts it."""
DEAF = 4
"""Number of consecutive checks without any sample from a connected router, after which the node
concludes that the router withholds all samples.
"""
DOOR = "router/door"
"""Key of the token of a router with keys, which every accepted node can see."""


def opened(settings: dict[str, object]) -> zenoh.Session:
    """A session with these settings and those that all processes of a team share."""
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


def client(connect: str, patience_s: float, keys: "Credentials | None") -> zenoh.Session:
    """A client's session; raises `BusError` when no router answers, or one that refuses us."""
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
            return opened(settings | {"connect/timeout_ms": max(1, round(1e3 * wait_s))})
        except zenoh.ZError as error:
            from team.wire.zenoh.handshake import why_refused  # ssl: only here

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


class RouterAccess:
    """Checks whether a router with keys still accepts this node: Zenoh itself would retry silently.

    An absent router is waited for. Where the router no longer accepts us, or we no longer accept
    it, a handshake finds the reason; a router that connects us and then withholds all samples has a
    roster without our certificate: nothing else uses the key of its token.
    """

    def __init__(self, session: zenoh.Session, connect: str, keys: "Credentials") -> None:
        from team.wire.zenoh import handshake

        self._handshake = handshake
        self._session = session
        self._connect = connect
        self._keys = keys
        self._due = self._answered_at = 0.0
        self._router_ends = self._handshake.router_ends(connect, keys)
        self._answered = True
        self._deaf = 0

    def look(self, now_s: float) -> None:
        """Checks every LINK_S seconds; raises BusError with the reason."""
        if now_s < self._due:
            return
        self._due = now_s + LINK_S
        linked = bool(self._session.info.routers_zid())
        self._deaf = 0 if self._answered or not linked else self._deaf + 1
        self._answered_at = now_s if self._answered else self._answered_at
        # A link that comes up again just before the end Zenoh may keep behind it.
        ended = self._router_ends is not None and time.time() > self._router_ends
        if ended or now_s - self._answered_at > FIRST_LOOK_S:
            refused = self._handshake.why_refused(self._connect, self._keys)
            if refused is not None:
                raise BusError(refused)
            self._router_ends = self._handshake.router_ends(self._connect, self._keys)
        if self._deaf > DEAF:
            raise BusError(
                f"{self._connect}: the router gives {self._keys.certificate} a link, but lets it "
                "hear and say nothing: it is revoked, or the router has another roster. Copy the "
                f"newest {self._keys.node}.pem and .key, and roster.json to the router, and start "
                "both again"
            )
        self._answered = False

        def hear(reply: zenoh.Reply) -> None:
            self._answered = self._answered or reply.ok is not None

        key = f"team/{self._keys.team}/{DOOR}"
        self._session.liveliness().get(key, Callback(hear, indirect=False), timeout=LINK_S)
