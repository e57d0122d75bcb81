"""A robot's own log and another's make the whole: what one has not heard the other has."""

from pathlib import Path

from team.recording.merge import merge
from team.recording.own_log import own_log
from team.recording.reader import open_log
from team.wire import channels as c
from team.wire.bus import Outgoing
from team.wire.zenoh.bus import ZenohBus
from team.wire.zenoh.router import router
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
