import numpy as np
import pytest

from teamslam.sim.datasets.folder import folder
from teamslam.sim.importing.bag import import_bag
from teamslam.sim.publisher.node import WorldNode
from teamslam.sim.world.config import FolderWorld
from teamslam.team.config import RobotConfig
from teamslam.team.datum import Datum
from teamslam.team.driver.driver import Driver
from teamslam.team.ros2.topics import RobotTopics, Topics
from teamslam.team.ros2_driver import Ros2Driver
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.foreign_keys import ForeignSample
from tests import build
from tests.ros2 import messages as ros
from tests.teams import world_of

S = 10**9
ODOMETRY, TAGS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
FIX = "sensor_msgs/msg/NavSatFix"
DATUM = Datum(48.7, 9.1)


def drive() -> list[ros.Message]:
    random = np.random.default_rng(2)
    drove: list[ros.Message] = []
    x = y = theta = 0.0
    for k in range(1, 40):
        at = 1_700_000_000 * S + k * 100_000_007
        x, y, theta = x + random.normal(), y + random.normal(), theta + 0.3 * random.normal()
        moved = ros.odometry(at, ros.pose(x, y, yaw=theta), random.normal(), random.normal())
        drove.append((at, "/odom", ODOMETRY, moved))
        if k % 3 == 0:
            seen = [(str(i), ros.pose(*random.normal(size=2))) for i in (3, 8, 11)]
            drove.append((at, "/tags", TAGS, ros.detections(at, "base_link", seen)))
        if k % 5 == 0:
            degrees = 48.7 + 1e-5 * random.normal(), 9.1 + 1e-5 * random.normal()
            stated = (0.25, 0.0625, 0.5) if k % 2 else None
            drove.append((at, "/fix", FIX, ros.fix(at, "base_link", degrees, stated)))
    return drove


@pytest.mark.parametrize("use", ["pose", "twist"])
def test_live_and_as_a_bag_it_is_one_stream(tmp_path, use):
    topics = RobotTopics(odometry="/odom", detections=("/tags",), fixes="/fix", use=use)
    drove = drive()
    bag = ros.write_bag(tmp_path / "bag", drove)
    (tables,) = import_bag(bag, Topics(robots={"r1": topics}, datum=DATUM), None).tables
    tables.start((1.0, 2.0, 0.5))
    tables.write(tmp_path / "set")
    robot = Driver(
        "r1",
        team="t",
        connect="tcp/127.0.0.1:1",
        file=tmp_path / "r1.stream",
        start=(1.0, 2.0, 0.5),
        patience_s=0.0,
    )
    live = Ros2Driver(robot, topics, datum=DATUM)
    for _, topic, kind, message in drove:
        package, _, name = kind.split("/")
        key = f"0{topic}/{package}::msg::dds_::{name}_/TypeHashNotSupported"
        live.take(ForeignSample(key, ros.cdr(kind, message)))
    journal = robot._journal
    journal.mark("ended")
    sent = [journal.message(1, number) for number in range(journal.count(1))]
    robot.close()  # no receiver for the stream
    (stream,) = folder(FolderWorld(path=str(tmp_path / "set")), [RobotConfig(id="r1")]).streams
    world = WorldNode(
        world_of(stream), frozenset(), build.configuration(node="world", incarnation=0)
    )
    out = [each.message for _ in range(4) for each in world.publish(0.0)]
    expected = [each for each in out if isinstance(each, m.Measurement)]
    assert live.dropped == {}
    assert len(expected) == 1 + 38 + 13 + 7
    assert [encoded(each) for each in sent] == [encoded(each) for each in expected]
