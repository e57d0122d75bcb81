"""A whole team in one process, on the bus in memory: the same nodes, synchronous, deterministic."""

from collections.abc import Iterator

from central.node import CentralNode
from sim.scenario import Scenario
from sim.streams import WorldStreams
from sim.world_node import WorldNode, expected_nodes
from team import translate
from team.robot.node import RobotNode
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample, opened


class _Seat:
    """A node, its bus, and the end of its conversation."""

    def __init__(self, network: MemoryNetwork, node: WorldNode | RobotNode | CentralNode) -> None:
        self.bus = MemoryBus(network)
        self.node = node

    def send(self, out: list[Outgoing]) -> None:
        for outgoing in out:
            self.bus.publish(outgoing)

    def take(self) -> bool:
        samples = self.bus.receive(0.0)
        for sample in samples:
            _, _, message = opened(sample)
            self.send(self.node.handle(message, sample.stamp_ns))
        return bool(samples)


def run_team(scenario: Scenario, streams: WorldStreams) -> Iterator[Sample]:
    """Run the team to its final map; everything that a recorder would take, in its order."""
    network = MemoryNetwork()
    recorder = MemoryBus(network)
    for channel in ch.CHANNELS:
        if channel.recorded:
            recorder.subscribe(channel, "**")
    recorder.watch_alive()
    robots = {r.id: RobotNode(r) for r in scenario.robots}
    central = _Seat(network, CentralNode(scenario.central, list(robots)))
    for channel in CentralNode.listens:
        central.bus.subscribe(channel)
    central.bus.watch_alive()
    configured = translate.configured("world", 0, 0, scenario)
    world = _Seat(
        network, WorldNode(streams, expected_nodes(list(robots), recorder=False), configured)
    )
    for channel in WorldNode.listens:
        world.bus.subscribe(channel)
    world.bus.watch_alive()
    seats = [world, central]
    for name, node in robots.items():
        seat = _Seat(network, node)
        for channel in RobotNode.listens:
            seat.bus.subscribe(channel, name)
        seat.bus.watch_alive("central")
        seats.append(seat)
    for seat, token in zip(
        seats, ["world", "central", *(ch.robot_node(n) for n in robots)], strict=True
    ):
        seat.send(seat.node.begin())
        seat.bus.declare_alive(token)
    assert isinstance(world.node, WorldNode)
    while True:
        published = world.node.publish(0.0)
        world.send(published)
        busy = sum(seat.take() for seat in seats)
        yield from recorder.receive()
        if not busy and not published:
            return


def final_map(samples: list[Sample]) -> m.FusedMap:
    """The team's final map among what a run sent."""
    for sample in reversed(samples):
        if sample.key == ch.FINAL_MAP.key():
            _, _, message = opened(sample)
            assert isinstance(message, m.FusedMap)
            return message
    raise LookupError("the run ended without a final map")
