import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import load_roster
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import BusError, Outgoing
from teamslam.team.wire.zenoh import session
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.handshake import examine
from teamslam.team.wire.zenoh.router import router
from tests.keys.certificates import TEAM
from tests.support import Link, submap, wait_until


def test_a_router_that_is_silent_for_longer_than_any_patience_ends_nobody(
    keys, monkeypatch, caplog
):
    """Its machine is busy or the radio is bad: connections stay or are made, without answers."""
    for name, value in {
        "FIRST_LOOK_S": 0.2, "LINK_S": 0.05, "ANSWER_S": 0.2, "_LEASE_MS": 1_000, "LONGEST_S": 0.3,
    }.items():  # fmt: skip
        monkeypatch.setattr(session, name, value)
    caplog.set_level(logging.WARNING, "teamslam")
    examined: list[str] = []

    def counted(*arguments: object) -> object:
        found = examine(*arguments)
        examined.append(found.waits_for)
        return found

    monkeypatch.setattr("teamslam.team.wire.zenoh.handshake.examine", counted)
    own = credentials_of(keys.own, "router"), load_roster(keys.own)
    centre, robot = (credentials_of(keys.own, node, TEAM) for node in ("central", "robot-r1"))
    with (
        router("tls/127.0.0.1:0", own) as endpoint,
        Link(endpoint) as link,
        ZenohBus(TEAM, link.endpoint, 20.0, centre) as far,
        ZenohBus(TEAM, endpoint, 20.0, robot) as near,
    ):
        far.subscribe(ch.SUBMAP)
        near.publish(Outgoing(ch.SUBMAP, "r1", submap(0, "r1")))
        wait_until(lambda: bool(far.receive(0.05)), what="a submap before")
        link.stall()

        def silent_for_long() -> bool:
            far.receive(0.05)
            unanswered = sum("TLS is not answered" in text for text in examined)
            return unanswered >= 3 and "waiting for the router" in caplog.text

        wait_until(silent_for_long, what="three handshakes without an answer")
        near.publish(Outgoing(ch.SUBMAP, "r1", submap(1, "r1")))
        link.mend()
        wait_until(lambda: bool(far.receive(0.05)), what="the submap of meanwhile")
        wait_until(lambda: not far.receive(0.05) and "again, after" in caplog.text, what="the log")
    waiting = [text for text in caplog.messages if "waiting for the router" in text]
    assert len(waiting) == 1, "the reason is logged once a minute"
    assert f"waiting for the router at {link.endpoint}: " in waiting[0]
    assert not [text for text in examined if "refuses" in text]


@contextmanager
def answering(answer: bytes | None) -> Iterator[str]:
    kept: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    link, _ = server.accept()
                except OSError:
                    return
                kept.append(link)
                if answer is not None:
                    with suppress(OSError):  # the client is gone
                        link.recv(65_536)
                        link.sendall(answer)
                        link.shutdown(socket.SHUT_WR)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"tls/127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
        thread.join()
    for link in kept:
        link.close()


@pytest.mark.parametrize(
    ("answer", "waits_for", "refused"),
    [
        (None, "TLS is not answered", ""),
        (b"", "was broken off", ""),
        (b"\x15\x03\x03\x00\x02\x02\x50", "was broken off", ""),  # internal error
        (b"\x15\x03\x03\x00\x02\x02\x30", "", "it is of another authority"),  # unknown CA
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "", "is not TLS"),
    ],
    ids=["silence", "end", "another alert", "alert about our certificate", "not TLS"],
)
def test_only_an_answer_about_certificates_refuses_a_link(keys, answer, waits_for, refused):
    with answering(answer) as endpoint:
        found = examine(endpoint, credentials_of(keys.own, "robot-r1", TEAM), 0.3)
    assert waits_for in found.waits_for
    assert bool(found.waits_for) == bool(waits_for)
    assert refused in (found.refused or "")
    assert bool(found.refused) == bool(refused)


@pytest.mark.parametrize("with_keys", [True, False], ids=["keys", "no keys"])
def test_a_process_that_starts_beside_a_stopped_router_waits_for_it(
    keys, with_keys, monkeypatch, caplog
):
    monkeypatch.setattr(session, "FIRST_LOOK_S", 0.2)
    monkeypatch.setattr("teamslam.team.wire.zenoh.handshake.TIMEOUT_S", 0.2)
    caplog.set_level(logging.WARNING, "teamslam")
    own = (credentials_of(keys.own, "router"), load_roster(keys.own)) if with_keys else None
    robot = credentials_of(keys.own, "robot-r1", TEAM) if with_keys else None
    stop, opened = threading.Event(), threading.Event()

    def start(endpoint: str, until: threading.Event | None) -> None:
        with ZenohBus(TEAM, endpoint, 0.3, robot, stop=until):
            opened.set()

    with (
        router(f"{'tls' if with_keys else 'tcp'}/127.0.0.1:0", own) as endpoint,
        Link(endpoint) as link,
    ):
        link.stall()
        with pytest.raises(BusError, match="no router answers"):
            start(link.endpoint, None)  # a command of an operator does not wait
        starting = threading.Thread(target=start, args=(link.endpoint, stop))
        starting.start()
        wait_until(lambda: "waiting for the router" in caplog.text, what="the reason in the log")
        assert not opened.is_set()
        link.mend()
        wait_until(opened.is_set, what="the link")
        starting.join()


def test_a_process_that_waits_for_a_silent_router_ends_when_it_is_told_to(keys, monkeypatch):
    monkeypatch.setattr(session, "FIRST_LOOK_S", 0.2)
    stop = threading.Event()
    stop.set()
    with answering(None) as endpoint, pytest.raises(BusError, match="no router answers"):
        ZenohBus(TEAM, endpoint, 0.3, credentials_of(keys.own, "robot-r1", TEAM), stop=stop)
