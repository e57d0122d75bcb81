"""A whole team in one process: the same nodes, deterministic."""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Protocol, runtime_checkable

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode, make_centre
from teamslam.sim.publisher.node import WorldNode, expected_nodes
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.scenarios.source import tells_map
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.containment import Boundary
from teamslam.team.estimation.hybrid_slam.window import generator
from teamslam.team.robot.node import RobotNode, robot_node
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample, opened
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import announce_configuration

RESEND_NS = 1_000_000_000  # a lost submap is sent again after this time
PATIENCE_NS = 3_000_000_000  # time after which the centre considers a robot lost
_FROM_ROBOTS = (ch.SUBMAP, ch.SIGHTING_FACTOR, ch.OWN_MAP, ch.ROBOT_PROGRESS, ch.ROBOT_DONE)
_FROM_CENTRE = (ch.FUSED_MAP, ch.PRIOR, ch.FINAL_MAP, ch.CENTRAL_PROGRESS)


class Link:
    """Delivery to a node at arrival times, liveliness first."""

    def __init__(self, arrival_ns: Callable[[Sample, int], int] | None = None) -> None:
        self._arrival_ns = arrival_ns
        self._in_flight: list[tuple[int, bool, int, Sample]] = []
        self._sent = 0

    def say(self, at_ns: int, message: m.Liveliness) -> None:
        """Deliver a liveliness token at this time."""
        sample = Sample(ch.ALIVE.key(message.node), encoded(message), 0, 0, 0)
        self._hold(at_ns, sample, sent=False)

    def arrived(self, samples: Sequence[Sample], now_ns: int) -> list[Sample]:
        """Messages that have arrived by now."""
        if self._arrival_ns is None:
            return list(samples)
        for sample in samples:
            self._hold(self._arrival_ns(sample, now_ns), sample, sent=True)
        there = []
        while self._in_flight and self._in_flight[0][0] <= now_ns:
            there.append(heapq.heappop(self._in_flight)[-1])
        return there

    def _hold(self, at_ns: int, sample: Sample, *, sent: bool) -> None:
        heapq.heappush(self._in_flight, (at_ns, sent, self._sent, sample))
        self._sent += 1

    @property
    def next_ns(self) -> int | None:
        """Arrival of the next message in flight."""
        return self._in_flight[0][0] if self._in_flight else None


@dataclass(frozen=True)
class Partition:
    """Robots that do not reach the centre from begin_ns until end_ns."""

    robots: frozenset[str]
    begin_ns: int
    end_ns: int


@dataclass(frozen=True)
class Conditions:
    """Conditions of a team's links.

    loss: probability per transmission of a submap. delay_ns: of submaps to the centre. down_ns:
    interval without a centre; the next one starts empty.
    """

    delay_ns: int = 0
    loss: float = 0.0
    seed: int = 0
    partitions: tuple[Partition, ...] = ()
    down_ns: tuple[int, int] | None = None

    def centre_is_down(self, now_ns: int) -> bool:
        """Whether there is no centre at this time."""
        return self.down_ns is not None and self.down_ns[0] <= now_ns < self.down_ns[1]

    @property
    def centre_back_ns(self) -> int:
        """Time at which there is a centre again."""
        return 0 if self.down_ns is None else self.down_ns[1]

    def to_centre(self, robots: Sequence[str]) -> Link:
        """The robots' link to the centre."""
        if not (self.delay_ns or self.loss or self.partitions):
            return Link()
        link = Link(self._arrival_at_centre)
        for robot, cut in self._cuts(robots):
            node = ch.robot_node(robot)
            if cut.end_ns - cut.begin_ns > PATIENCE_NS:
                link.say(
                    cut.begin_ns + PATIENCE_NS, m.Liveliness(stamp_ns=0, node=node, alive=False)
                )
                link.say(cut.end_ns, m.Liveliness(stamp_ns=0, node=node, alive=True))
        return link

    def to_robot(self, robot: str) -> Link:
        """The centre's link to a robot."""
        cuts = [cut for _, cut in self._cuts([robot])]
        if not cuts:
            return Link()
        link = Link(lambda sample, now_ns: _behind(cuts, now_ns, sample, _FROM_CENTRE))
        for cut in cuts:
            link.say(cut.begin_ns, m.Liveliness(stamp_ns=0, node="central", alive=False))
            link.say(cut.end_ns, m.Liveliness(stamp_ns=0, node="central", alive=True))
        return link

    def _cuts(self, robots: Sequence[str]) -> list[tuple[str, Partition]]:
        return [(r, cut) for r in robots for cut in self.partitions if r in cut.robots]

    def _arrival_at_centre(self, sample: Sample, now_ns: int) -> int:
        _, robot, message = opened(sample)
        if isinstance(message, m.Submap):
            now_ns += self.delay_ns + RESEND_NS * self._losses(message)
        cuts = [cut for _, cut in self._cuts([robot])]
        return _behind(cuts, now_ns, sample, _FROM_ROBOTS)

    def _losses(self, submap: m.Submap) -> int:
        if self.loss == 0.0:
            return 0
        draws = generator(self.seed, f"{submap.robot} loses", submap.incarnation, submap.sequence)
        return int(draws.geometric(1.0 - self.loss)) - 1


def _behind(
    cuts: Sequence[Partition], now_ns: int, sample: Sample, channels: Sequence[ch.Channel]
) -> int:
    found = ch.channel_of(sample.key)
    if found is None or found[0] not in channels:
        return now_ns
    for cut in sorted(cuts, key=lambda c: c.begin_ns):
        if cut.begin_ns <= now_ns < cut.end_ns:
            now_ns = cut.end_ns
    return now_ns


ROUND_S = 1.0
"""Team time [s] of one round, which keeps robots within a window of each other's messages, as in
real time.
"""

SHARED = 16  # number of recent samples whose decoded messages are cached


@runtime_checkable
class World(Protocol):
    """Publisher of measurements."""

    @property
    def listens(self) -> tuple[ch.Channel, ...]:
        """Subscribed channels."""

    @property
    def now_ns(self) -> int:
        """Stamp up to which it has published."""

    def begin(self) -> list[Outgoing]:
        """First messages."""

    def publish(self, clock_s: float) -> list[Outgoing]:
        """Next measurements, if any."""

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Handle one message."""


class _Seat:
    """A node with its bus; name: of its liveliness token."""

    def __init__(
        self, network: MemoryNetwork, node: World | RobotNode | CentralNode, name: str, link: Link
    ) -> None:
        self.node, self.link, self.bus = node, link, MemoryBus(network)
        self._name, self._boundary = name, Boundary(name)
        robot = node if isinstance(node, RobotNode) else None
        for channel in node.listens:
            self.bus.subscribe(channel, robot.robot if robot else "*")
        for channel in robot.overhears if robot else ():
            self.bus.subscribe(channel)
        self.bus.watch_alive("central" if robot else "*")

    def enter(self) -> None:
        self.send(self.node.begin())
        self.bus.declare_alive(self._name)

    def send(self, out: list[Outgoing]) -> None:
        for outgoing in out:
            self.bus.publish(outgoing)

    def take(self, now_ns: int) -> bool:
        samples = self.link.arrived(self.bus.receive(0.0), now_ns)
        for sample in samples:
            message = self._boundary.let_in(sample, partial(_open_sample, sample))
            if isinstance(message, list):
                self.send(message)
            else:
                self.send(self._boundary.hand(self.node, message, sample))
        return bool(samples)


@lru_cache(maxsize=SHARED)
def _open_sample(sample: Sample) -> m.Message:
    return opened(sample)[2]


def run_team(
    scenario: Scenario,
    streams: WorldStreams,
    robot: Callable[[RobotConfig, Exchange], RobotNode] = robot_node,
    central: Callable[[CentralConfig, list[str]], CentralNode] = make_centre,
) -> Iterator[Sample]:
    """Run to the final map; yield a recorder's samples, in order."""
    expected = expected_nodes([config.id for config in scenario.robots], recorder=False)
    announced = announce_configuration("world", 0, 0, scenario)
    world = WorldNode(
        streams, expected, announced, tells_map=tells_map(scenario, streams), batch_s=ROUND_S
    )
    yield from run_nodes(scenario, world, None, robot, central)


def run_nodes(
    scenario: Scenario,
    world: World,
    conditions: Conditions | None = None,
    robot: Callable[[RobotConfig, Exchange], RobotNode] = robot_node,
    central: Callable[[CentralConfig, list[str]], CentralNode] = make_centre,
) -> Iterator[Sample]:
    """Run robots and centre in a world until no message is in flight."""
    conditions = Conditions() if conditions is None else conditions
    network = MemoryNetwork()
    recorder = MemoryBus(network)
    for channel in ch.CHANNELS:
        if channel.recorded:
            recorder.subscribe(channel)
    recorder.watch_alive()
    names = [config.id for config in scenario.robots]

    def new_centre() -> _Seat:
        node = central(scenario.central, names)
        return _Seat(network, node, "central", conditions.to_centre(names))

    source = _Seat(network, world, "world", Link())
    centre = new_centre()
    robots = [
        _Seat(
            network, robot(config, scenario.exchange), ch.robot_node(config.id),
            conditions.to_robot(config.id),
        )
        for config in scenario.robots
    ]  # fmt: skip
    for seat in (source, centre, *robots):
        seat.enter()
    now_ns = world.now_ns
    up = True
    while True:
        published = world.publish(0.0)
        source.send(published)
        now_ns = max(now_ns, world.now_ns)
        if up and conditions.centre_is_down(now_ns):
            centre.bus.close()
            up = False
        elif not up and not conditions.centre_is_down(now_ns):
            centre = new_centre()
            centre.enter()
            up = True
        seats = [source, *([centre] if up else []), *robots]
        busy = sum(seat.take(now_ns) for seat in seats)
        yield from recorder.receive()
        if busy or published:
            continue
        coming = [seat.link.next_ns for seat in seats if seat.link.next_ns is not None]
        coming += [] if up else [conditions.centre_back_ns]
        if not coming:
            return
        now_ns = min(coming)  # the world has ended or waits: advance to the next arrival


def final_map(samples: list[Sample]) -> m.FusedMap:
    """Final map among a run's samples."""
    for sample in reversed(samples):
        if sample.key == ch.FINAL_MAP.key():
            _, _, message = opened(sample)
            assert isinstance(message, m.FusedMap)
            return message
    raise LookupError("the run ended without a final map")
