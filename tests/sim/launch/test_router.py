"""A router that dies while a launch starts is started again, like every process of a team."""

import os
import signal
import time
from pathlib import Path

import pytest

from teamslam.sim.launch import launch as launching
from teamslam.sim.launch.launch import entered
from teamslam.sim.launch.processes import Starter
from teamslam.sim.launch.supervisor import Supervised, end_all
from teamslam.team.wire.bus import BusError
from teamslam.team.wire.zenoh.bus import ZenohBus


def test_a_router_that_is_killed_before_the_launch_has_entered_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The router restarts at its former address before the team receives it."""
    monkeypatch.setattr(launching, "ROUTER_PATIENCE_S", 120.0)  # a busy machine
    router = Supervised(
        "router", ["router", "--listen", "tcp/127.0.0.1:0"], tmp_path, Starter(time.time_ns())
    )
    tried: list[str] = []

    def enter(endpoint: str) -> ZenohBus:
        tried.append(endpoint)
        if len(tried) == 1:
            os.kill(router.child.pid, signal.SIGKILL)
            while router.child.exit is None:
                time.sleep(0.01)
            raise BusError("no router answers")
        return ZenohBus("team", endpoint, 60.0)

    endpoint, bus = entered(router, enter)
    bus.close()
    end_all([router.child])
    assert tried == [endpoint, endpoint]
    assert router.restarts == 1
