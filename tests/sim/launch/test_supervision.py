import os
import signal
import time

import pytest

from teamslam.sim.launch import launch as launching
from teamslam.sim.launch.launch import enter_team
from teamslam.sim.launch.processes import Child, end_all, environment_of
from teamslam.sim.launch.supervision import Silence, Supervised, supervise
from teamslam.sim.launch.watch import Watch
from teamslam.team.wire.bus import BusError, MemoryBus, MemoryNetwork, Sample
from teamslam.team.wire.zenoh.bus import ZenohBus


class Quiet(Child):
    pid = 0
    exit = None
    is_stopped = is_computing = False

    def __init__(self, pid: int) -> None:
        self.pid, self.started = pid, 999.0


class Stopped(Quiet):
    is_stopped = True


class Service(Supervised):
    def __init__(self, number: int) -> None:
        self.name, self.child = f"robot-r{number}", Quiet(100 + number)


class Team:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, count: int) -> None:
        self.now = 1000.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        self.watch, self.silence = Watch(), Silence(None)
        self.services = [Service(k) for k in range(count)]

    def hears(self, *numbers: int) -> None:
        for k in numbers:
            self.watch.last_message[f"robot/r{k}"] = self.now

    def after(self, seconds: float) -> list[str]:
        self.now, known = self.now + seconds, len(self.watch.notes)
        self.silence.look(self.services, self.watch)
        return self.watch.notes[known:]


def test_of_many_silent_processes_one_line_says_how_many(monkeypatch):
    team = Team(monkeypatch, 50)
    team.hears(*range(50))
    (said,) = team.after(11.0)
    assert "50 processes, robot-r0, robot-r1, robot-r2 among them, have sent no message" in said
    lines = 0
    for k in range(100):  # an overloaded computer: rare messages, at each one's times
        team.hears(k % 50)
        lines += len(team.after(1.0))
    assert lines <= 2
    team.services[7].child = Stopped(107)
    team.hears(7)
    team.after(0.0)
    assert any("robot-r7 (pid 107) is stopped" in text for text in team.after(11.0))


class Ending(Quiet):
    def __init__(self, status: int) -> None:
        self.exit = status


def test_a_process_that_fails_five_times_is_given_up_whatever_it_says():
    """Without a router a process ends with status 2, as on wrong use; it may restart."""
    service = Service(0)
    service.fruitless, service.reached, service.given_up = 0, -1.0, False
    given_up = []
    for status in (-9, 2, 2, 1, 2):
        service.child = Ending(status)
        service.died(0.0)
        given_up.append(service.given_up)
    assert given_up == [False] * 4 + [True]


class Refused(MemoryBus):
    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        raise BusError("operator.pem has expired")


def test_a_launch_whose_own_link_is_refused_supervises_on_until_the_processes_have_ended():
    services = [Service(k) for k in range(3)]
    turns: list[list[str]] = []
    for service in services:
        service.over = service.given_up = False
        service.due = service.ended_s = None
        service.child.measure = lambda: None

    def show(watch: Watch) -> None:
        turns.append(list(watch.failures))
        if len(turns) == 3:
            for service in services:
                service.child = Ending(0)

    supervise(services, Refused(MemoryNetwork()), Watch(), show, None)
    assert len(turns) == 4
    assert turns[-1] == ["operator.pem has expired"]
    assert all(service.over for service in services)


def test_a_router_that_is_killed_before_the_launch_has_entered_is_started_again(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(launching, "ROUTER_PATIENCE_S", 120.0)  # a busy machine
    router = Supervised(
        "router",
        ["router", "--listen", "tcp/127.0.0.1:0"],
        tmp_path,
        environment_of(time.time_ns()),
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

    endpoint, bus = enter_team(router, enter)
    bus.close()
    end_all([router.child])
    assert tried == [endpoint, endpoint]
    assert router.restarts == 1
