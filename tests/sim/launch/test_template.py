"""The template: a process that is forked from one with threads could wait for a lock for ever."""

import os
import socket
import threading

import pytest

from sim.launch import template


def test_nothing_is_forked_from_a_process_that_has_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    forks: list[int] = []
    monkeypatch.setattr(os, "fork", lambda: forks.append(1))
    done = threading.Event()
    thread = threading.Thread(target=done.wait)
    asks, asked = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with asks, asked:
        thread.start()
        socket.send_fds(asks, [b'["router"]'], [asks.fileno()])
        with pytest.raises(SystemExit, match="threads: a fork would not be safe"):
            template._serve(template._received(asked), asked, os.getpid())
        done.set()
        thread.join()
    assert forks == []
