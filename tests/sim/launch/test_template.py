"""The template process: start, end, and conditions of a fork."""

import os
import signal
import socket
import subprocess
import sys
import threading

import pytest

from sim import __main__ as program
from sim.launch import ahead, template


def test_nothing_is_forked_from_a_process_that_has_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process forked from one with threads may deadlock on a lock."""
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


@pytest.mark.skipif(sys.platform != "linux", reason="there is a template on Linux alone")
@pytest.mark.parametrize("words", [["no-such-scenario"], ["--no-such-option"]])
def test_a_launch_that_can_not_begin_leaves_no_template(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    started: list[ahead.Template] = []

    class Noted(ahead.Template):
        def __init__(self, output: int) -> None:
            super().__init__(output)
            started.append(self)

    monkeypatch.setattr(ahead, "Template", Noted)
    monkeypatch.setattr(ahead, "adopt_orphans", lambda: True)
    monkeypatch.setattr(sys, "argv", ["teamslam", "launch", *words])
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 2
    (one,) = started
    assert one.process.returncode is not None  # killed, or it saw first that nobody asks any more
    assert ahead.taken() is None
    assert words[0] in capfd.readouterr().err


COMPILES = """
import os, signal, socket
from sim.launch import template, warm_up
warm_up.is_warm = lambda *_: False
warm_up.fold_made_up_submaps = warm_up.follow_made_up_submaps = signal.pause
warm_up.run_to_the_first_submap = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
template._load_kernels("hybrid", "join", socket.socket())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is no template")
def test_a_template_that_is_ended_while_it_compiles_leaves_nobody_who_goes_on() -> None:
    """A launch was interrupted: the process that compiles the centre's kernels went on alone."""
    with subprocess.Popen([sys.executable, "-c", COMPILES], stdout=subprocess.PIPE) as process:
        process.communicate(timeout=100)  # both hold the pipe open until they end
        assert process.returncode == -signal.SIGKILL
