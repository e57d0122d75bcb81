"""The robot's process: one of a name."""

import threading

import pytest

from team.robot.main import RobotShell
from team.wire import channels as ch
from team.wire.bus import BusError, MemoryBus, MemoryNetwork
from tests.teams import config


def test_a_second_process_of_a_robot_is_refused_and_says_nothing_to_the_team() -> None:
    network = MemoryNetwork()
    first, viewer = MemoryBus(network), MemoryBus(network)
    first.declare_alive(ch.robot_node("r1"))
    viewer.subscribe(ch.ROBOT_CONFIG)
    second = RobotShell(MemoryBus(network), config("r1"), threading.Event(), patience_s=0.0)
    with pytest.raises(BusError, match="another process is robot/r1 in this team already: stop"):
        second.run()
    assert viewer.receive() == []


def test_a_robot_whose_earlier_life_has_gone_begins() -> None:
    network = MemoryNetwork()
    first, viewer = MemoryBus(network), MemoryBus(network)
    first.declare_alive(ch.robot_node("r1"))
    first.close()
    viewer.subscribe(ch.ROBOT_CONFIG)
    stop = threading.Event()
    stop.set()
    RobotShell(MemoryBus(network), config("r1"), stop, patience_s=0.0).run()
    assert len(viewer.receive()) == 1
