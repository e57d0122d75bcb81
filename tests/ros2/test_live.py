import struct
import time
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext

from teamslam.sim.datasets.folder import folder
from teamslam.sim.importing.bag import import_bag
from teamslam.sim.publisher.node import WorldNode
from teamslam.sim.world.config import FolderWorld
from teamslam.team.config import RobotConfig
from teamslam.team.datum import Datum
from teamslam.team.driver.driver import Driver
from teamslam.team.driver.journal import Journal
from teamslam.team.driver.measurement_messages import MeasurementError
from teamslam.team.driver.node import SourceNode
from teamslam.team.ros2.arrivals import MOST_PUBLISHERS, Lost, number_of
from teamslam.team.ros2.topics import RobotTopics, Topics, TopicsError, load_topics
from teamslam.team.ros2.translator import Measured
from teamslam.team.ros2_driver import BEHIND_S, SILENT_S, Ros2Driver
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.foreign_keys import ForeignKeys, ForeignSample
from tests import build
from tests.ros2 import messages as ros
from tests.support import wait_until
from tests.teams import world_of

S = 10**9


ODOMETRY, TAGS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
TOPICS = RobotTopics(
    odometry="/r1/odom", use="twist", detections=("/r1/tags",), teammates={"5": "r2"}
)


class Robot(Driver):
    sensor_mount: tuple[float, float, float] | None = None
    antenna: tuple[float, float] | None = None

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def odometry(self, t: Decimal, forward: float, yaw_rate: float) -> None:
        if any(name == "odometry" and t <= at for name, at, *_ in self.calls):
            raise MeasurementError("time goes back")
        self.calls.append(("odometry", t, forward, yaw_rate))

    def odometry_pose(self, t: Decimal, x: float, y: float, theta: float) -> None:
        self.calls.append(("pose", t, x, y, theta))

    def observe_points(self, t: Decimal, ids: Any, xy: Any, covariances: Any) -> None:
        assert covariances is None
        self.calls.append(("points", t, ids.tolist(), xy.tolist()))

    def sight(self, t: Decimal, teammates: Any, ranges: Any, bearings: Any) -> None:
        self.calls.append(("sight", t, list(teammates), ranges.tolist(), bearings.tolist()))

    def fix(self, t: Decimal, x: float, y: float, covariance: Any) -> None:
        self.calls.append(("fix", t, x, y, covariance))


def odometry(k: int) -> bytes:
    return ros.cdr(ODOMETRY, ros.odometry(k * S, ros.pose(), 0.5 * k, 0.1))


def tags(k: int) -> bytes:
    seen = [("7", ros.pose(3.0, 4.0)), ("5", ros.pose(1.0, 0.0))]
    return ros.cdr(TAGS, ros.detections(k * S + 1, "base_link", seen))


def by_rmw(topic: str, kind: str) -> str:
    package, _, name = kind.split("/")
    return f"0/{topic.strip('/')}/{package}::msg::dds_::{name}_/{ros.STORE.hash_rihs01(kind)}"


def by_bridge(topic: str, kind: str) -> str:
    return topic.strip("/")


EXPECTED = [
    ("odometry", Decimal(1), 0.5, 0.1),
    ("odometry", Decimal(2), 0.5, 0.1),
    ("points", Decimal("2.000000001"), [7], [[3.0, 4.0]]),
    ("sight", Decimal("2.000000001"), ["r2"], [1.0], [0.0]),
    ("odometry", Decimal(3), 1.0, 0.1),
]


@pytest.mark.parametrize("key", [by_rmw, by_bridge])
def test_topics_on_zenoh_become_a_driver_s_calls(network, key):
    router, endpoint = network
    robot = Robot()
    driver = Ros2Driver(robot, TOPICS)
    token = "@/beef/@ros2_lv/MP/r1§tags/vision_msgs§msg§Detection3DArray/:::"
    held = router.liveliness().declare_token(token) if key is by_bridge else None
    with ForeignKeys(endpoint, driver.keys, driver.tokens) as foreign:
        odom = router.declare_publisher(key("/r1/odom", ODOMETRY))
        tag = router.declare_publisher(key("/r1/tags", TAGS))
        wait_until(lambda: odom.matching_status.matching and tag.matching_status.matching)
        odom.put(odometry(1))
        odom.put(odometry(2)[:-7])
        odom.put(odometry(2))
        tag.put(tags(2))
        odom.put(odometry(1))
        odom.put(odometry(3))

        def done() -> bool:
            for sample in foreign.receive(0.05):
                driver.take(sample)
            return len(robot.calls) >= len(EXPECTED)

        wait_until(done)
    assert (held is not None) == (key is by_bridge)
    in_time = sorted(robot.calls, key=lambda call: call[1])  # Zenoh promises no order across keys
    assert in_time == EXPECTED
    assert driver.taken == {"/r1/odom": 5, "/r1/tags": 1}
    assert driver.dropped == {"/r1/odom: damaged": 1, "/r1/odom: refused": 1}


def test_hostile_payloads_are_counted_and_nothing_more():
    robot = Robot()
    driver = Ros2Driver(robot, TOPICS)
    random = np.random.default_rng(3)
    sound = odometry(1)
    for k in range(300):
        data = bytearray(sound)
        for at in random.integers(0, len(data), 3):
            data[at] = int(random.integers(256))
        cut = int(random.integers(len(data) + 1)) if k % 2 else len(data)
        driver.take(ForeignSample(by_rmw("/r1/odom", ODOMETRY), bytes(data[:cut])))
    driver.take(ForeignSample("0/r1/odom/what::msg::dds_::Ever_/RIHS01_0", b"1234"))
    assert driver.taken["/r1/odom"] == 301
    assert driver.dropped["/r1/odom: messages of type what/msg/Ever are not read"] == 1
    refused = sum(driver.dropped.values()) - 1
    assert 100 < refused < 300
    assert len(robot.calls) + refused == 300


def test_a_static_transform_says_where_the_sensor_sits():
    robot = Robot()
    driver = Ros2Driver(robot, RobotTopics(odometry="/odom", detections=("/tf",)))
    turned = (0.0, 0.0, 1.0, 0.0)
    still = ros.transforms((0, "base_link", "back", ros.vector(-0.5), turned))
    tag = ros.transforms((S, "back", "tag36h11:7", ros.vector(2.0, 1.0), (0.0, 0.0, 0.0, 1.0)))
    kind = "tf2_msgs/msg/TFMessage"
    driver.take(ForeignSample(by_rmw("/tf_static", kind), ros.cdr(kind, still)))
    driver.take(ForeignSample(by_rmw("/tf", kind), ros.cdr(kind, tag)))
    assert [call[0] for call in robot.calls] == ["points"]
    np.testing.assert_allclose(robot.calls[0][3], [[2.0, 1.0]], atol=1e-12)


@pytest.mark.parametrize("topic", ["/tf_static", "/r1/tf_static"])
def test_what_was_published_once_before_the_driver_began_is_received(network, topic):
    router, endpoint = network
    robot = Robot()
    driver = Ros2Driver(robot, RobotTopics(odometry="/r1/odom", detections=("/r1/tags",)))
    kind = "tf2_msgs/msg/TFMessage"
    here = ros.transforms((0, "base_link", "eye", ros.vector(0.2), (0.0, 0.0, 1.0, 0.0)))
    seen = ros.cdr(TAGS, ros.detections(S, "eye", [("7", ros.pose(3.0, 4.0))]))
    latched = zenoh.ext.declare_advanced_publisher(
        router,
        by_rmw(topic, kind),
        cache=zenoh.ext.CacheConfig(max_samples=1),
        publisher_detection=True,
    )
    latched.put(ros.cdr(kind, here))
    with ForeignKeys(endpoint, driver.keys, driver.tokens, latched=driver.latched) as foreign:

        def has_come() -> bool:
            for sample in foreign.receive(0.05):
                driver.take(sample)
            return driver.taken[topic] > 0

        wait_until(has_come)
    driver.take(ForeignSample(by_rmw("/r1/tags", TAGS), seen))
    np.testing.assert_allclose(robot.calls[0][3], [[3.0, 4.0]], atol=1e-12)
    (mount,) = driver.mounts
    np.testing.assert_allclose(mount, (0.2, 0.0, np.pi))
    assert driver.warnings() == ()
    robot.sensor_mount = 0.2, 0.0, -np.pi
    assert driver.warnings() == ()
    robot.sensor_mount = 0.0, 0.0, 0.0
    (warning,) = driver.warnings()
    assert "at (0.2, 0, 3.142) on the base by its frames, and the scenario has it at (0," in warning


def test_a_sensor_whose_place_comes_late_is_there_from_then_on():
    robot = Robot()
    driver = Ros2Driver(robot, RobotTopics(odometry="/odom", detections=("/tags",)))
    kind = "tf2_msgs/msg/TFMessage"
    here = ros.transforms((0, "base_link", "eye", ros.vector(0.2), (0.0, 0.0, 1.0, 0.0)))
    for k in (1, 2):
        seen = ros.detections(k * S, "eye", [("7", ros.pose(3.0, 4.0))])
        driver.take(ForeignSample(by_rmw("/tags", TAGS), ros.cdr(TAGS, seen)))
        found = [mount[0] for mount in driver.mounts]
        driver.take(ForeignSample(by_rmw("/tf_static", kind), ros.cdr(kind, here)))
    assert found == [0.2]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[robots.r1", "not valid TOML"),
        ("domain = 1", "missing required field `robots`"),
        ("robots = {}", "no robot; give [robots.r1]"),
        ("[robots.r1]\nodom = '/odom'", "unknown field `odom`"),
        ("[robots.R1]\nodometry = '/odom'", "matching regex"),
    ],
)
def test_a_mistake_in_a_file_of_topics_is_named(tmp_path, text, words):
    (tmp_path / "topics.toml").write_text(text)
    with pytest.raises(TopicsError) as error:
        load_topics(tmp_path / "topics.toml")
    assert words in str(error.value)
    assert "topics.toml" in str(error.value)


def test_a_missing_file_of_topics_is_named_once(tmp_path):
    path = tmp_path / "none.toml"
    with pytest.raises(TopicsError) as error:
        load_topics(path)
    assert str(error.value) == f"{path}: can not be read: No such file or directory"


def test_a_sound_message_that_can_not_be_translated_is_set_aside_and_the_driver_goes_on():
    robot = Robot()
    driver = Ros2Driver(robot, TOPICS)
    key = by_rmw("/r1/odom", ODOMETRY)

    def broken(topic: str, record: object) -> list[Measured]:
        raise ZeroDivisionError("no such rotation")

    whole, driver._translator.take = driver._translator.take, broken
    driver.take(ForeignSample(key, odometry(1)))
    driver._translator.take = whole
    for k in range(2, 4):
        driver.take(ForeignSample(key, odometry(k)))
    assert driver.dropped == {"/r1/odom: set aside": 1}
    assert len(robot.calls) == 2


def numbered(number: int, gid: bytes = b"a" * 16) -> bytes:
    """The attachment of rmw_zenoh as its C++ serializer writes it."""
    named = struct.pack("<B15sqB16sq", 15, b"sequence_number", number, 16, b"source_timestamp", S)
    return named + struct.pack("<B10sB16s", 10, b"source_gid", 16, gid)


def plainly_numbered(number: int, gid: bytes = b"a" * 16) -> bytes:
    return struct.pack("<qqB16s", number, S, 16, gid)


@pytest.mark.parametrize("attached", [numbered, plainly_numbered])
def test_messages_that_never_came_are_counted_by_their_publisher_s_numbers(attached):
    driver = Ros2Driver(Robot(), TOPICS)
    key = by_rmw("/r1/odom", ODOMETRY)
    for k in (1, 2, 5, 6):
        driver.take(ForeignSample(key, odometry(k), attached(k)))
    driver.take(ForeignSample(key, odometry(7), attached(1, b"b" * 16)))  # started again: another
    driver.take(ForeignSample(key, odometry(8), attached(2, b"b" * 16)))
    assert driver.lost.count == {"/r1/odom": 2}
    figures = driver.figures()
    assert (figures["messages"], figures["messages_lost"]) == (6.0, 2.0)
    (said,) = driver.warnings()
    assert "/r1/odom: 2 messages were published and never came, 25.0 %" in said
    assert "keep_all" in said


def test_hostile_numbers_lose_nothing_and_fill_nothing():
    lost = Lost()
    random = np.random.default_rng(5)
    for k in range(2 * MOST_PUBLISHERS):
        lost.take("/odom", numbered(k, random.bytes(16)))
        lost.take("/odom", random.bytes(int(random.integers(90))))
    lost.take("/odom", numbered(-(2**63)))
    lost.take("/odom", numbered(2**63 - 1))
    lost.take("/odom", numbered(3))
    assert not lost.count
    assert len(lost._last) == MOST_PUBLISHERS
    assert number_of(b"") is None
    assert number_of(numbered(7)[:-1]) is None
    assert number_of(numbered(7).replace(b"sequence", b"sequense")) is None


def test_what_waits_is_handed_over_in_the_order_of_its_stamps():
    robot = Robot()
    driver = Ros2Driver(robot, TOPICS)
    for k in range(1, 400):  # all odometry first, as a reader that fell behind finds it
        driver.put(ForeignSample(by_rmw("/r1/odom", ODOMETRY), odometry(k)))
    for k in range(1, 400):
        driver.put(ForeignSample(by_rmw("/r1/tags", TAGS), tags(k)))
    while driver.waiting:
        driver.deliver(7)
    times = [call[1] for call in robot.calls]
    assert len(times) == 399 * 3
    assert times == sorted(times)


def test_a_driver_that_falls_behind_says_so_in_its_status(tmp_path, monkeypatch):
    monkeypatch.setattr("teamslam.team.ros2.arrivals.MOST_WAITING", 3)
    driver = Ros2Driver(Robot(), TOPICS)
    for k in range(1, 6):
        driver.put(ForeignSample(by_rmw("/r1/odom", ODOMETRY), odometry(k)))
    now = time.monotonic()
    monkeypatch.setattr("teamslam.team.ros2.arrivals.time.monotonic", lambda: now + 5.0 * BEHIND_S)
    node = SourceNode(Journal(tmp_path / "r1.stream", "r1"))
    node.fed = driver.figures(), driver.warnings()
    status = node.status()
    assert status.figures["messages_waiting"] == 3.0
    assert status.figures["messages_dropped"] == 2.0
    said = " ".join(status.warnings)
    assert "3 messages wait, the oldest for 5 s" in said
    assert "/r1/odom: 2 messages were dropped" in said


def test_odometry_that_does_not_come_is_named_with_what_to_look_at(monkeypatch):
    silent, heard = Ros2Driver(Robot(), TOPICS), Ros2Driver(Robot(), TOPICS)
    heard.put(ForeignSample(by_rmw("/r1/odom", ODOMETRY), odometry(1)))
    heard.deliver()
    assert not silent.warnings()
    now = time.monotonic()
    monkeypatch.setattr("teamslam.team.ros2_driver.time.monotonic", lambda: now + 2.0 * SILENT_S)
    assert not heard.warnings()
    (said,) = silent.warnings()
    assert "/r1/odom: no message yet: look at its name, at `domain`" in said


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
