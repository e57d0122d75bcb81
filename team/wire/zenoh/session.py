"""Open a process's link to its team's router and monitor it: a star without discovery."""

import json
import threading
import time
from typing import TYPE_CHECKING, Literal

import zenoh
from zenoh.handlers import Callback

from teamslam.team.wire.bus import BusError
from teamslam.team.wire.codec import LARGEST_PAYLOAD
from teamslam.team.wire.logs import LOG

if TYPE_CHECKING:  # not needed without keys
    from teamslam.team.keys.credentials import Credentials

_LEASE_MS = 5_000  # silence after which a link counts as cut; detects a stopped process
_BLOCK_US = 10_000_000  # time that a full queue may block a publisher before its link is closed
FIRST_LOOK_S = 3.0  # time [s] without a connection after which a client examines the router
LINK_S = 1.0  # interval [s] between two checks of the link
LONGEST_S = 30.0  # longest interval [s] between two examinations of a failing link, which double
REPEAT_S = 60.0  # interval [s] at which a client without a router logs the reason again
ANSWER_S = 5.0  # timeout [s] of the query for our certificate's acceptance, and of an examination
DOOR = "router/door"
"""Key prefix on which a router with keys answers for a certificate's common name."""
ACCEPTED, REVOKED = b"accepted", b"revoked"


def open_session(settings: dict[str, object]) -> zenoh.Session:
    """Open a session with these settings and those that all processes of a team share."""
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


def client(
    connect: str,
    patience_s: float,
    keys: "Credentials | None",
    stop: threading.Event | None = None,
) -> zenoh.Session:
    """Open a client's session; raises `BusError` after `patience_s`, or if the router refuses us.

    stop: wait until this event for a router that accepts connections without answering.
    """
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
        settings |= tls_settings(keys, "connect") | {
            "transport/link/tls/verify_name_on_connect": True
        }
    deadline = time.monotonic() + patience_s
    wait_s = min(FIRST_LOOK_S, patience_s)
    while True:
        try:
            return open_session(settings | {"connect/timeout_ms": max(1, round(1e3 * wait_s))})
        except zenoh.ZError as error:
            from teamslam.team.wire.zenoh.handshake import examine  # ssl: only here

            found = examine(connect, keys)
            if found.refused is not None:
                raise BusError(found.refused) from error
            wait_s = deadline - time.monotonic()
            if wait_s <= 0.0 and found.accepts and stop is not None and not stop.is_set():
                LOG.warning("waiting for the router at %s: %s", connect, found.waits_for)
                wait_s = FIRST_LOOK_S
            if wait_s <= 0.0:
                example = "tls/HOST:PORT" if keys is not None else "tcp/HOST:PORT"
                reason = f": {found.waits_for}" if found.waits_for else ""
                raise BusError(
                    f"no router answers at {connect} ({patience_s:g} s){reason}; start `teamslam "
                    "launch lab.toml` with your team's scenario, or has its run ended? Without "
                    f"launch start `teamslam router{' --keys DIR' if keys else ''}`, or give its "
                    f"endpoint, as {example}"
                ) from error


def tls_settings(keys: "Credentials", role: Literal["connect", "listen"]) -> dict[str, object]:
    """Return the settings of a link by mutual TLS."""
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(keys.authority),
            "enable_mtls": True,
            f"{role}_certificate": str(keys.certificate),
            f"{role}_private_key": str(keys.key),
            "close_link_on_expiration": True,
        },
    }


class RouterLink:
    """The link of one session to its router: logs why it is down; raises on evidence against it.

    Evidence is the result of a handshake (`handshake`), or the router's statement that its roster
    lacks our certificate: Zenoh connects a revoked one and drops its messages silently, so that
    query follows each new link. Silence never ends a process.
    """

    def __init__(self, session: zenoh.Session, connect: str, keys: "Credentials | None") -> None:
        self._session = session
        self._connect = connect
        self._keys = keys
        self._due = 0.0
        self._away_since: float | None = None
        self._logged_s: float | None = None
        self._examine_due = 0.0
        self._interval_s = LINK_S
        self._examining: threading.Thread | None = None
        self._router_ends: float | None = None
        self._waits_for = ""
        self._accepted_by = ""
        self._asking = False
        self._refused: str | None = None

    def look(self, now_s: float) -> None:
        """Check the link every LINK_S seconds; raises `BusError` on evidence against it."""
        if self._refused is not None:
            raise BusError(self._refused)
        if now_s < self._due:
            return
        self._due = now_s + LINK_S
        router = next((str(each) for each in self._session.info.routers_zid()), None)
        if router is None:
            self._wait(now_s)
        else:
            self._connected(router, now_s)

    def _connected(self, router: str, now_s: float) -> None:
        if self._logged_s is not None and self._away_since is not None:
            away_s = now_s - self._away_since
            LOG.warning("connected to the router at %s again, after %.0f s", self._connect, away_s)
        self._away_since = self._logged_s = None
        if self._keys is None:
            return
        if router != self._accepted_by and not self._asking:
            self._ask_whether_accepted(router, self._keys)
        # Zenoh may keep a link that came up just before its certificate expired.
        if self._router_ends is None or time.time() > self._router_ends:
            self._examine(now_s)
        else:
            self._interval_s = LINK_S

    def _wait(self, now_s: float) -> None:
        if self._away_since is None:
            self._away_since, self._interval_s = now_s, LINK_S
        away_s = now_s - self._away_since
        if away_s < FIRST_LOOK_S:
            return
        self._examine(now_s)
        if self._waits_for and (self._logged_s is None or now_s - self._logged_s >= REPEAT_S):
            self._logged_s = now_s
            LOG.warning(
                "waiting for the router at %s: %s, no link for %.0f s",
                self._connect, self._waits_for, away_s,
            )  # fmt: skip

    def _examine(self, now_s: float) -> None:
        running = self._examining is not None and self._examining.is_alive()
        if running or now_s < self._examine_due:
            return
        self._examine_due = now_s + self._interval_s
        self._interval_s = min(2.0 * self._interval_s, LONGEST_S)

        def run() -> None:
            from teamslam.team.wire.zenoh.handshake import examine  # ssl: only here

            found = examine(self._connect, self._keys, ANSWER_S)
            self._router_ends = found.router_ends or self._router_ends
            self._waits_for = found.waits_for or "a handshake succeeds, a link is being made"
            self._refused = found.refused

        self._examining = threading.Thread(target=run, name="handshake", daemon=True)
        self._examining.start()

    def _ask_whether_accepted(self, router: str, keys: "Credentials") -> None:
        self._asking = True

        def hear(reply: zenoh.Reply) -> None:
            answer = b"" if reply.ok is None else reply.ok.payload.to_bytes()
            if answer == ACCEPTED:
                self._accepted_by = router
            elif answer == REVOKED:
                self._refused = (
                    f"{self._connect}: the router does not accept {keys.certificate}: it is "
                    f"revoked, or the router has another roster. Copy the newest {keys.node}.pem "
                    "and .key, and roster.json to the router, and start both again"
                )

        def over() -> None:
            self._asking = False

        self._session.get(
            f"team/{keys.team}/{DOOR}/{keys.name}",
            Callback(hear, drop=over, indirect=False),
            timeout=ANSWER_S,
        )
