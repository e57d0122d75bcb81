import threading
import time
from collections.abc import Callable

import msgspec
import pytest

from teamslam.team.recording.parts import own_log
from teamslam.team.robot.main import RobotShell
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import BusError, MemoryBus, MemoryNetwork, Outgoing, Sample
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.support import odometry
from tests.teams import config, published, stream, submaps_of


def test_a_second_process_of_a_robot_is_refused_and_says_nothing_to_the_team():
    network = MemoryNetwork()
    first, viewer = MemoryBus(network), MemoryBus(network)
    first.declare_alive(ch.robot_node("r1"))
    viewer.subscribe(ch.ROBOT_CONFIG)
    second = RobotShell(MemoryBus(network), config("r1"), threading.Event(), patience_s=0.0)
    with pytest.raises(BusError, match="another process is robot/r1 in this team already: stop"):
        second.run()
    assert viewer.receive() == []


def test_a_robot_whose_earlier_life_has_gone_begins():
    network = MemoryNetwork()
    first, viewer = MemoryBus(network), MemoryBus(network)
    first.declare_alive(ch.robot_node("r1"))
    first.close()
    viewer.subscribe(ch.ROBOT_CONFIG)
    stop = threading.Event()
    stop.set()
    RobotShell(MemoryBus(network), config("r1"), stop, patience_s=0.0).run()
    assert len(viewer.receive()) == 1


class Source:
    def __init__(self, network: MemoryNetwork) -> None:
        self.network, self.bus = network, MemoryBus(network)
        self.start = published(stream("r1", 3))[0]
        self.asked: list[tuple[int, int, int]] = []
        self.bus.answer(ch.MEASUREMENTS, "r1", self.answer)

    def answer(self, request: bytes) -> list[bytes]:
        wanted = decoded(request, m.MeasurementsRequest)
        self.asked.append((wanted.incarnation, wanted.first, wanted.last))
        return [encoded(self.start)]

    def begins(self, incarnation: int) -> None:
        said = msgspec.structs.replace(self.start, incarnation=incarnation)
        self.bus.publish(Outgoing(ch.START, "r1", said))


def lived(
    source: Source, act: Callable[[], None], waits_s: float = 0.0, bus: MemoryBus | None = None
) -> RobotShell:
    stop, bus = threading.Event(), bus or MemoryBus(source.network)
    shell = RobotShell(bus, config("r1"), stop, patience_s=0.0)
    shell.shell.begin = act  # when it has subscribed
    duty, turns = shell._duty, iter(range(5))

    def acted() -> None:
        if next(turns, None) is None:
            stop.set()
        duty()
        time.sleep(waits_s)

    shell._duty = acted
    shell.run()
    return shell


def test_a_new_incarnation_is_begun_by_the_word_of_the_source_alone():
    source = Source(MemoryNetwork())

    def act() -> None:
        source.begins(4)  # a stranger's
        source.begins(1)

    shell = lived(source, act)
    assert (shell.node.incarnation, shell.node.next_measurement) == (1, 1)
    assert shell.shell.boundary.refused == 1
    warnings = str(shell.shell.boundary.warnings)
    assert "of incarnation 4, of which its source knows nothing" in warnings


def test_a_robot_asks_its_source_for_what_a_death_has_cost_its_own_log(tmp_path):
    source = Source(MemoryNetwork())
    bus = MemoryBus(source.network)
    with own_log(tmp_path / "r1.mcap", "t") as log:
        measured = msgspec.structs.replace(odometry(5, "r1"), incarnation=1)
        later = Outgoing(ch.ODOMETRY, "r1", measured)
        log([Sample(later.key, encoded(later.message), 0, 0, 0)])
        bus.tap = log
        shell = lived(source, lambda: source.begins(1), bus=bus)
    assert shell.node.next_measurement == 1
    assert (1, 0, 0) in source.asked, "the robot has used it, its log has lost it"
    assert not any(first > 0 for _, first, _ in source.asked), "it asks for these itself"


def test_an_end_before_forged_measurements_is_believed_by_the_word_of_the_source():
    class Ending(Source):
        def answer(self, request: bytes) -> list[bytes]:
            if not self.asked:  # the world ends while the forged ones are consumed
                self.bus.publish(Outgoing(ch.END, "", build.end(r1=1)))
            return super().answer(request)

    network = MemoryNetwork()
    source, viewer = Ending(network), MemoryBus(network)
    viewer.subscribe(ch.ROBOT_DONE)

    def act() -> None:
        source.begins(1)
        for number in (1, 2):
            forged = msgspec.structs.replace(odometry(number, "r1"), incarnation=1)
            source.bus.publish(Outgoing(ch.ODOMETRY, "r1", forged))

    shell = lived(source, act)
    assert shell.node.next_measurement == 3
    assert source.asked == [(0, 0, 0), (1, 0, 1)]
    (said,) = viewer.receive()
    assert decoded(said.payload, m.Done).measurements == 1


class Published(Source):
    def answer(self, request: bytes) -> list[bytes]:
        super().answer(request)
        wanted = decoded(request, m.MeasurementsRequest)
        there = [self.start, msgspec.structs.replace(odometry(1, "r1"), incarnation=1)]
        return [encoded(x) for x in there if wanted.first <= x.number <= wanted.last]


def test_an_end_that_is_not_the_sources_is_refused_and_the_stream_goes_on():
    network = MemoryNetwork()
    source, viewer = Published(network), MemoryBus(network)
    source.bus.declare_alive("world")
    viewer.subscribe(ch.ROBOT_DONE)

    def act() -> None:
        source.begins(1)
        measured = msgspec.structs.replace(odometry(1, "r1"), incarnation=1)
        source.bus.publish(Outgoing(ch.ODOMETRY, "r1", measured))
        for incarnation, count in ((1, 1), (1, 2), (1, 9), (7, 3)):
            end = build.end(incarnation=incarnation, r1=count)
            source.bus.publish(Outgoing(ch.END, "", end))

    shell = lived(source, act)
    assert shell.shell.boundary.refused == 3
    (said,) = viewer.receive()
    assert decoded(said.payload, m.Done).measurements == 2


@pytest.mark.parametrize("state", ["ended", "open"])
def test_where_a_world_ends_a_stream_no_drivers_word_goes_further(state):
    network = MemoryNetwork()
    source, viewer = Published(network), MemoryBus(network)
    viewer.subscribe(ch.ROBOT_DONE)

    def act() -> None:
        source.begins(1)
        head = m.StreamHead(stamp_ns=0, robot="r1", incarnation=1, measurements=5000, state=state)
        source.bus.publish(Outgoing(ch.HEAD, "r1", head))
        source.bus.publish(Outgoing(ch.END, "", build.end(r1=2)))

    lived(source, act, waits_s=0.3)
    (said,) = viewer.receive()
    assert decoded(said.payload, m.Done).measurements == 2, "measurement 1 was asked for"


def test_a_stream_begins_where_its_source_says():
    source = Source(MemoryNetwork())

    def act() -> None:
        forged = msgspec.structs.replace(source.start, stamp_ns=2**61)
        source.bus.publish(Outgoing(ch.START, "r1", forged))
        measured = msgspec.structs.replace(odometry(1, "r1"), incarnation=1)
        source.bus.publish(Outgoing(ch.ODOMETRY, "r1", measured))

    shell = lived(source, act)
    assert (shell.node.next_measurement, shell.shell.boundary.refused) == (2, 0)


def test_submaps_of_an_incarnation_that_the_source_does_not_know_are_not_taken_over():
    network = MemoryNetwork()
    source, centre = Source(network), MemoryBus(network)
    forged = msgspec.structs.replace(source.start, incarnation=7)
    submap = msgspec.structs.replace(submaps_of(stream("r1", 12))[0], incarnation=7)
    centre.answer(ch.SUBMAPS, "", lambda _: [encoded(forged), encoded(submap)])
    shell = lived(source, lambda: source.begins(1))
    assert (shell.node.incarnation, shell.node.next_measurement) == (1, 1)


@pytest.mark.parametrize("number", [0, 1])
def test_only_its_initial_pose_begins_an_incarnation_and_only_once(number):
    source = Source(MemoryNetwork())

    def act() -> None:
        source.begins(1)
        forged = msgspec.structs.replace(odometry(0, "r1"), incarnation=7)
        again = msgspec.structs.replace(source.start, number=1)
        channel, message = ((ch.ODOMETRY, forged), (ch.START, again))[number]
        source.bus.publish(Outgoing(channel, "r1", message))

    shell = lived(source, act)
    assert (shell.node.incarnation, shell.node.next_measurement) == (1, 1)
    assert "the initial pose is measurement 0" in shell.shell.boundary.last_refused
