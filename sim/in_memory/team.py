"""A whole team in one process: the same nodes, deterministic."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Protocol, runtime_checkable

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode, make_centre
from teamslam.sim.in_memory.links import Conditions, Link
from teamslam.sim.publisher.node import WorldNode, expected_nodes
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.scenarios.source import tells_map
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.containment import Boundary
from teamslam.team.robot.node import RobotNode, robot_node
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample, opened
from teamslam.team.wire.digest import announce_configuration

ROUND_S = 1.0
"""Team time [s] of one round, which keeps robots within a window of each other's messages, as in
real time.
"""

SHARED = 16
"""Number of recent samples whose decoded messages are cached."""


@runtime_checkable
class World(Protocol):
    """A publisher of measurements: a scenario's world, or a log's."""

    @property
    def listens(self) -> tuple[ch.Channel, ...]:
        """Subscribed channels."""

    @property
    def now_ns(self) -> int:
        """Team time: the stamp up to which it has published."""

    def begin(self) -> list[Outgoing]:
        """First messages."""

    def publish(self, clock_s: float) -> list[Outgoing]:
        """Next measurements; none while it waits or after its end."""

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Handle one message."""


@dataclass
class _Seat:
    """A node, its bus, and the link that delivers the others' messages to it."""

    node: World | RobotNode | CentralNode
    bus: MemoryBus
    link: Link
    boundary: Boundary

    def send(self, out: list[Outgoing]) -> None:
        for outgoing in out:
            self.bus.publish(outgoing)

    def take(self, now_ns: int) -> bool:
        samples = self.link.arrived(self.bus.receive(0.0), now_ns)
        for sample in samples:
            message = self.boundary.let_in(sample, partial(_open_sample, sample))
            if isinstance(message, list):
                self.send(message)
            else:
                self.send(self.boundary.hand(self.node, message, sample))
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
    """Run the team to its final map; yield a recorder's samples, in order."""
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
    """Run the scenario's robots and centre in a world until no message is in flight.

    conditions: of links and centre; None: messages arrive at once.
    """
    conditions = Conditions() if conditions is None else conditions
    network = MemoryNetwork()
    recorder = MemoryBus(network)
    for channel in ch.CHANNELS:
        if channel.recorded:
            recorder.subscribe(channel, "**")
    recorder.watch_alive()
    names = [config.id for config in scenario.robots]
    source = _Seat(world, MemoryBus(network), Link(), Boundary("world"))
    for channel in world.listens:
        source.bus.subscribe(channel)
    source.bus.watch_alive()
    centre = _centre(network, scenario, conditions, central)
    robots = [
        _robot(network, robot(config, scenario.exchange), conditions) for config in scenario.robots
    ]
    _enter(source, "world")
    _enter(centre, "central")
    for name, seat in zip(names, robots, strict=True):
        _enter(seat, ch.robot_node(name))
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
            centre = _centre(network, scenario, conditions, central)
            _enter(centre, "central")
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


def _enter(seat: _Seat, token: str) -> None:
    seat.send(seat.node.begin())
    seat.bus.declare_alive(token)


def _centre(
    network: MemoryNetwork,
    scenario: Scenario,
    conditions: Conditions,
    central: Callable[[CentralConfig, list[str]], CentralNode],
) -> _Seat:
    names = [config.id for config in scenario.robots]
    node = central(scenario.central, names)
    bus = MemoryBus(network)
    for channel in node.listens:
        bus.subscribe(channel)
    bus.watch_alive()
    return _Seat(node, bus, conditions.to_centre(names), Boundary("central"))


def _robot(network: MemoryNetwork, node: RobotNode, conditions: Conditions) -> _Seat:
    bus = MemoryBus(network)
    for channel in node.listens:
        bus.subscribe(channel, node.robot)
    for channel in node.overhears:
        bus.subscribe(channel)
    bus.watch_alive("central")
    boundary = Boundary(ch.robot_node(node.robot))
    return _Seat(node, bus, conditions.to_robot(node.robot), boundary)


def final_map(samples: list[Sample]) -> m.FusedMap:
    """The team's final map among the samples of a run."""
    for sample in reversed(samples):
        if sample.key == ch.FINAL_MAP.key():
            _, _, message = opened(sample)
            assert isinstance(message, m.FusedMap)
            return message
    raise LookupError("the run ended without a final map")
