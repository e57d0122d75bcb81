"""Robots' own logs complete each other."""

import threading
from pathlib import Path

from teamslam.team.recording.merge import merge
from teamslam.team.recording.own_log import own_log
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as c
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.support import odometry, received, submap


def test_what_a_bus_sends_and_receives_is_in_its_own_log_and_merged_there_once(
    tmp_path: Path,
) -> None:
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    with (
        router() as at, own_log(paths[0], "t") as a, own_log(paths[1], "t") as b,
        ZenohBus("t", at) as robot, ZenohBus("t", at) as centre,
    ):  # fmt: skip
        robot.tap, centre.tap = a, b
        centre.subscribe(c.SUBMAP)
        for i in range(5):
            robot.publish(Outgoing(c.SUBMAP, "alpha", submap(i)))
            robot.publish(Outgoing(c.ODOMETRY, "alpha", odometry(i)))
        received(centre, 5)
    submaps, measurements = c.SUBMAP.key("alpha"), c.ODOMETRY.key("alpha")
    found = [{k: n for k, (n, _) in open_log(path).counts().items()} for path in paths]
    assert found == [{submaps: 5, measurements: 5}, {submaps: 5}]
    merged = merge([open_log(path) for path in paths], tmp_path / "whole.mcap")
    assert merged == (10, 5)


def test_what_a_robot_has_asked_for_is_in_its_own_log_and_what_a_death_cost_it_is_known(
    tmp_path: Path,
) -> None:
    """Killed and started again, a robot had the measurements of its source, and its log had not."""
    path = tmp_path / "a.mcap"
    with router() as at, own_log(path, "t") as log, ZenohBus("t", at) as source:
        source.answer(c.MEASUREMENTS, "alpha", lambda _: [encoded(odometry(i)) for i in (1, 2, 5)])
        answering = threading.Event()
        thread = threading.Thread(target=lambda: answers(source, answering))
        thread.start()
        with ZenohBus("t", at) as robot:
            robot.tap = log
            wanted = build.measurements_request(robot="alpha", first=1, last=5)
            for _ in range(2):
                assert len(robot.ask(c.MEASUREMENTS, "alpha", wanted, 10.0)) == 3
        answering.set()
        thread.join()
        assert [(first, last) for _, first, last in log.lost("alpha")] == [(0, 0), (3, 4)]
        assert log.lost("bravo") == []
    assert {k: n for k, (n, _) in open_log(path).counts().items()} == {c.ODOMETRY.key("alpha"): 3}


def answers(bus: ZenohBus, until: threading.Event) -> None:
    """A node that does nothing but answer."""
    while not until.is_set():
        bus.receive(0.05)
