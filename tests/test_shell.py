"""A node's shell: what it says while the node waits."""

import logging
import threading

import pytest

from team import shell
from team.shell import Shell
from team.wire import messages as m
from team.wire.bus import MemoryBus, MemoryNetwork, Outgoing


class Waiting:
    """A node that waits, then works."""

    finished = False
    state = "waiting"

    def begin(self) -> list[Outgoing]:
        return []

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        return []

    def status(self) -> m.Status:
        return m.Status(0, "world", self.state, {}, ("waiting for robot/r2",))


def test_a_node_that_waits_is_heard_of_again_and_again_until_it_works(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "teamslam")
    clock = [100.0]
    monkeypatch.setattr(shell.time, "monotonic", lambda: clock[0])
    node = Waiting()
    turning = Shell(MemoryBus(MemoryNetwork()), node, "world", threading.Event())
    said = []
    for now in range(100, 136):
        clock[0] = float(now)
        node.state = "waiting" if now < 125 else "publishing"
        turning.report()
        said.append(len(caplog.messages))
    assert caplog.messages == ["waiting for robot/r2"] * 2, "after 10 s and 20 s"
    assert said.index(1) == 10
