import heapq
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from teamslam.central.peers.main import PeerCentre
from teamslam.central.peers.peer import CENTRE
from teamslam.central.peers.robot import PeerRobot
from teamslam.sim.in_memory.team import ROUND_S, World
from teamslam.sim.publisher.node import WorldNode, expected_nodes
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.scenarios.source import tells_map
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import RobotConfig
from teamslam.team.containment import Boundary
from teamslam.team.peers.members import Member
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Outgoing, Sample, read_reply
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import announce_configuration
from tests import build
from tests.air import Air

AFTER_S = 3600.0  # team time [s] after the streams' end at which incomplete peers give up
Make = Callable[[Scenario, RobotConfig], PeerRobot]


def peer_of(scenario: Scenario, config: RobotConfig) -> PeerRobot:
    names = [each.id for each in scenario.robots]
    return PeerRobot(config, scenario.central, names, scenario.exchange)


@dataclass
class _Seat:
    """listens: channels subscribed under its own name (a centre: any); overhears: under every
    name.
    """

    node: PeerRobot | PeerCentre
    boundary: Boundary
    reached: set[str] = field(default_factory=set)
    listens: frozenset[str] = frozenset()
    overhears: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        self.overhears = frozenset(each.name for each in self.node.overhears)
        listens = self.node.listens if isinstance(self.node, PeerRobot) else self.node.overhears
        self.listens = frozenset(each.name for each in listens)


class PeerTeam:
    """Peers in a world, with a radio between them.

    seats: robots and centre by name. complete_ns: team time of each robot's final map.
    """

    def __init__(self, scenario: Scenario, air: Air, make: Make = peer_of) -> None:
        self.scenario = scenario
        self.air = air
        self._make = make
        self.seats: dict[str, _Seat] = {}
        for config in scenario.robots:
            self.seat(config)
        self.complete_ns: dict[str, int] = {}
        self.now_ns = 0
        self._heap: list[tuple[int, int, str, str, Sample]] = []
        self._sent = 0
        self._log: list[Sample] = []
        self._counters: dict[str, int] = {}
        self._latest: dict[str, tuple[ch.Channel, Sample]] = {}

    def seat(self, config: RobotConfig) -> None:
        node = self._make(self.scenario, config)
        self.seats[config.id] = _Seat(node, Boundary(node.name))

    def seat_centre(self, restored: Iterable[Member] = ()) -> None:
        names = [each.id for each in self.scenario.robots]
        seat = _Seat(PeerCentre(self.scenario.central, names), Boundary(CENTRE))
        seat.node.keep(restored)
        self.seats[CENTRE] = seat
        self._enter(CENTRE, seat)
        self._catch_up(CENTRE, seat)

    def leave(self, name: str) -> list[Member]:
        seat = self.seats.pop(name)
        for other in self.seats.values():
            other.reached.discard(name)
        return list(seat.node.peer.replica.members())

    def run(
        self, world: World, steps: Callable[["PeerTeam"], None] | None = None
    ) -> Iterator[Sample]:
        """Run until all peers agree and no message is in flight; yield the messages.

        steps: called every round; may remove and add peers.
        """
        self._world, self._world_boundary = world, Boundary("world")
        self._source(world.begin())
        for robot, seat in self.seats.items():
            self._enter(robot, seat)
        ended_ns: int | None = None
        self.now_ns = world.now_ns
        while True:
            published = world.publish(0.0)
            self._source(published)
            self.now_ns = max(self.now_ns, world.now_ns)
            if not published:
                self.now_ns += round(ROUND_S * 1e9)
            if steps is not None:
                steps(self)
            self._see()
            self._arrive()
            for robot, seat in self.seats.items():
                self._say(robot, seat.node.tick(self.now_ns * 1e-9))
            yield from self._taken()
            if getattr(world, "ended", not published):
                ended_ns = self.now_ns if ended_ns is None else ended_ns
                if self._agree or self.now_ns - ended_ns > AFTER_S * 1e9:
                    break
        yield from self._taken()

    def _enter(self, robot: str, seat: _Seat) -> None:
        self._say(robot, seat.node.begin())
        token = build.liveliness(node=seat.node.name)
        self._to_world(Outgoing(ch.ALIVE, seat.node.name, token))

    def restart(self, config: RobotConfig, restored: Iterable[Member] = ()) -> None:
        world = self._world
        assert isinstance(world, WorldNode)
        self.seat(config)
        seat = self.seats[config.id]
        assert isinstance(seat.node, PeerRobot)
        seat.node.restore(restored)
        self._enter(config.id, seat)
        incarnation = max(1, seat.node.node.incarnation)
        while True:
            first = seat.node.node.next_measurement
            request = build.measurements_request(
                robot=config.id, incarnation=incarnation, first=first
            )
            for reply in world.measurements(encoded(request)):
                sample = read_reply(ch.MEASUREMENTS, config.id, reply, 0)
                self._say(config.id, seat.boundary.take(seat.node, sample))
            if seat.node.node.next_measurement == first:
                break
        self._catch_up(config.id, seat)

    def hear(self, name: str, sample: Sample) -> None:
        seat = self.seats[name]
        self._say(name, seat.boundary.take(seat.node, sample))

    def _source(self, outgoing: Sequence[Outgoing]) -> None:
        for each in outgoing:
            sample = self._sample(each)
            self._log.append(sample)
            found = ch.channel_of(sample.key)
            assert found is not None
            if found[0].delivery == "latest" and found[0].template.startswith("world/"):
                self._latest[sample.key] = found[0], sample
            for robot, seat in list(self.seats.items()):
                mine = found[0].name in seat.listens and (
                    robot == CENTRE or found[1] in ("", robot)
                )
                if mine:
                    self._say(robot, seat.boundary.take(seat.node, sample))

    def _catch_up(self, robot: str, seat: _Seat) -> None:
        for channel, sample in self._latest.values():
            if channel.name in seat.listens:
                self._say(robot, seat.boundary.take(seat.node, sample))

    def _to_world(self, out: Outgoing) -> None:
        sample = self._sample(out)
        self._world_boundary.take(self._world, sample)

    def _say(self, robot: str, outgoing: Sequence[Outgoing]) -> None:
        for out in outgoing:
            if out.channel is ch.MEMBERS:
                request = Sample(out.key, encoded(out.message), out.message.stamp_ns, 0, -1)
                to = ch.robot_of(out.name) or out.name
                if to in self.seats:
                    self._send(robot, to, request)
                continue
            sample = self._sample(out)
            self._log.append(sample)
            if out.channel in self._world.listens:
                self._world_boundary.take(self._world, sample)
            if out.channel is ch.CONCLUDED:
                self.complete_ns[robot] = self.now_ns
            for other, its in self.seats.items():
                if other != robot and out.channel.name in its.overhears:
                    self._send(robot, other, sample)

    def _send(self, sender: str, to: str, sample: Sample) -> None:
        size = len(sample.payload)
        for at_ns in self.air.arrivals(sender, to, size, self.now_ns):
            self._sent += 1
            heapq.heappush(self._heap, (at_ns, self._sent, sender, to, sample))

    def _arrive(self) -> None:
        while self._heap and self._heap[0][0] <= self.now_ns:
            _, _, sender, to, sample = heapq.heappop(self._heap)
            seat = self.seats.get(to)
            if seat is None:
                continue
            if sample.key == ch.MEMBERS.key(seat.node.name):
                for reply in seat.node.answer(sample.payload):
                    key = ch.CARRIED.key(seat.node.name)
                    self._send(to, sender, Sample(key, reply, sample.stamp_ns, 0, -1))
                continue
            self._say(to, seat.boundary.take(seat.node, sample))

    def _see(self) -> None:
        for robot, seat in self.seats.items():
            for other in self.seats:
                if other == robot:
                    continue
                there = self.air.reach(robot, other, self.now_ns)
                if there != (other in seat.reached):
                    (seat.reached.add if there else seat.reached.discard)(other)
                    node = self.seats[other].node.name
                    token = build.liveliness(node=node, alive=there)
                    sample = Sample(ch.ALIVE.key(node), encoded(token), 0, 0, 0)
                    self._say(robot, seat.boundary.take(seat.node, sample))

    @property
    def _agree(self) -> bool:
        finals = [seat.node.final for seat in self.seats.values()]
        if len(self.seats) < len(self.scenario.robots):
            return False
        sets = {seat.node.peer.replica.digest for seat in self.seats.values()}
        return not self._heap and len(sets) == 1 and all(f is not None for f in finals)

    def _sample(self, out: Outgoing) -> Sample:
        counter = self._counters.get(out.key, 0)
        self._counters[out.key] = counter + 1
        return Sample(out.key, encoded(out.message), out.message.stamp_ns, 0, counter)

    def _taken(self) -> list[Sample]:
        taken, self._log = self._log, []
        return taken


def peer_world(scenario: Scenario, streams: WorldStreams, late: Collection[str] = ()) -> WorldNode:
    names = [each.id for each in scenario.robots if each.id not in late]
    announced = announce_configuration("world", 0, 0, scenario)
    return WorldNode(
        streams,
        expected_nodes(names, recorder=False, centre=False),
        announced,
        tells_map=tells_map(scenario, streams),
        batch_s=ROUND_S,
    )
