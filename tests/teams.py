"""Tiny teams of nodes, and a network that delivers in random order."""

import random
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from teamslam.central.config import CentralConfig
from teamslam.central.node import make_centre
from teamslam.sim.publisher.node import WorldNode, expected_nodes
from teamslam.sim.world.streams import Detections, Intervals, RobotStream, StartPose, WorldStreams
from teamslam.team.config import Exchange, FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.pairs import NEEDS_MAP
from teamslam.team.robot.node import RobotNode, robot_node
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import decoded, encoded
from tests import build

LANDMARKS = np.array([[5.0, 3.0], [9.0, -2.0], [14.0, 4.0], [20.0, -3.0], [3.0, -4.0]])
STEP_NS = 1_000_000_000
LOCALISERS = ("localisation", "dead-reckoning")  # the estimators without a map of their own


def config(name: str = "r1", **options: object) -> RobotConfig:
    motion = MotionModel(forward=MotionNoise(per_s=0.05), turn=MotionNoise(per_s=0.02))
    base = RobotConfig(
        name,
        motion,
        Sensor(range_sigma=0.1, bearing_sigma=0.02),
        FrontEnd(particles=8, window_s=3.0),
    )
    return msgspec.structs.replace(base, **options)


def stream(
    robot: str,
    steps: int,
    *,
    seed: int = 0,
    step_ns: int = STEP_NS,
    seen_every: int = 1,
    off_ns: int = 0,
    beyond: int = 0,
    drives: bool = True,
    known: bool = True,
    y: float = 0.0,
) -> RobotStream:
    """A robot that drives along the x axis and observes near landmarks.

    off_ns: time of observations before the end of their interval. beyond: number of observations
    after the last odometry.
    """
    rng = np.random.default_rng([seed, steps, *robot.encode()])
    ends = step_ns * np.arange(1, steps + 1)
    poses = np.column_stack([1.0 * np.arange(1, steps + 1), np.full(steps, y), np.zeros(steps)])
    none = np.zeros(0)
    count = steps if drives else 0
    intervals = Intervals(
        ends[:count],
        np.full(count, step_ns),
        1e9 / step_ns + 0.05 * rng.normal(size=count),
        0.02 * rng.normal(size=count),
    )
    at = [*range(seen_every - 1, steps, seen_every)]
    stamps = [int(ends[k]) - off_ns for k in at]
    at += [steps - 1] * beyond
    stamps += [int(ends[-1]) + (i + 1) * step_ns for i in range(beyond)]
    offsets, ids, ranges, bearings = [0], [], [], []
    for k in at:
        offset = LANDMARKS - poses[k, :2] + [1e-9 * off_ns, 0.0]
        distance = np.hypot(*offset.T)
        for i in np.flatnonzero(distance < 8.0):
            ids.append(i + 1)
            ranges.append(distance[i] + 0.1 * rng.normal())
            bearings.append(np.arctan2(offset[i, 1], offset[i, 0]) + 0.02 * rng.normal())
        offsets.append(len(ids))
    wrapped = np.pi - (np.pi - np.array(bearings)) % (2.0 * np.pi) if ids else none
    seen = Detections(
        np.array(stamps, dtype=np.int64),
        np.array(offsets, dtype=np.int64),
        np.array(ids, dtype=np.uint32),
        np.abs(np.array(ranges)),
        wrapped,
    )
    met_at = ends[2:3]
    met = Detections(
        met_at,
        np.arange(len(met_at) + 1, dtype=np.int64),
        np.zeros(len(met_at), np.uint32),
        np.full(len(met_at), 4.0),
        np.zeros(len(met_at)),
    )
    start = StartPose(np.array([0.0, y, 0.0]), None) if known else None
    return RobotStream(
        robot=robot,
        start_ns=0,
        start=start,
        intervals=intervals,
        landmark_detections=seen,
        teammate_detections=met,
        teammates=("r9",),
        truth_ns=ends,
        truth=poses,
    )


def world_of(*streams: RobotStream) -> WorldStreams:
    ids = np.arange(1, len(LANDMARKS) + 1, dtype=np.uint32)
    return WorldStreams(streams, ids, LANDMARKS, "a test")


def published(each: RobotStream) -> list[m.Measurement]:
    world = WorldNode(world_of(each), frozenset(), build.configuration(node="world", incarnation=0))
    out: list[Outgoing] = []
    while not world.ended:
        out += world.publish(0.0)
    return [o.message for o in out if isinstance(o.message, m.Measurement)]


def driven(
    node: RobotNode, measurements: Sequence[m.Message], *, end: bool = True
) -> list[Outgoing]:
    out = [o for measurement in measurements for o in node.handle(measurement)]
    if end:
        last = measurements[-1]
        count = {node.robot: last.number + 1}
        out += node.handle(build.end(last.stamp_ns, last.incarnation, **count))
    return out


def of(out: Sequence[Outgoing], channel: ch.Channel) -> list[m.Message]:
    return [o.message for o in out if o.channel is channel]


def submaps_of(each: RobotStream, **options: object) -> list[m.Submap]:
    return of(driven(robot_node(config(each.robot, **options)), published(each)), ch.SUBMAP)


class Submaps(Mapping[str, list[m.Submap]]):
    def __init__(self, streams: Sequence[RobotStream]) -> None:
        self._streams = {each.robot: each for each in streams}
        self._submaps: dict[str, list[m.Submap]] = {}

    def __getitem__(self, robot: str) -> list[m.Submap]:
        if robot not in self._submaps:
            self._submaps[robot] = submaps_of(self._streams[robot])
        return self._submaps[robot]

    def __iter__(self) -> Iterator[str]:
        return iter(self._streams)

    def __len__(self) -> int:
        return len(self._streams)

    def every(self) -> list[m.Submap]:
        return [submap for submaps in self.values() for submap in submaps]


@dataclass
class Team:
    """World, robots and centre, with one queue per receiver and key.

    Each key keeps its order, as in Zenoh; `rng` chooses among keys and receivers.
    """

    streams: WorldStreams
    configs: Sequence[RobotConfig]
    rng: random.Random
    central: CentralConfig = field(default_factory=CentralConfig)
    queues: dict[tuple[str, str], deque[m.Message]] = field(default_factory=dict)
    exchange: Exchange = "continuous"
    sent: dict[str, list[m.Message]] = field(default_factory=lambda: defaultdict(list))

    def __post_init__(self) -> None:
        names = [c.id for c in self.configs]
        rule = msgspec.structs.replace(self.central, fusion=self.configs[0].fusion)
        announced = build.configuration(node="world", incarnation=0)
        self.world = WorldNode(
            self.streams,
            expected_nodes(names, recorder=False),
            announced,
            tells_map=self.configs[0].estimator in NEEDS_MAP,
        )
        self.centre = make_centre(rule, names)
        self.robots = {c.id: robot_node(c, self.exchange) for c in self.configs}
        self.nodes = {"world": self.world, "central": self.centre}
        self.nodes |= {ch.robot_node(name): node for name, node in self.robots.items()}
        for name in list(self.nodes):
            self.token(name, alive=True)
            self.send(name, self.nodes[name].begin())

    def token(self, node: str, *, alive: bool) -> None:
        for to in self.nodes:
            if to != node and (to in ("world", "central") or node == "central"):
                key = ch.ALIVE.key(node)
                self.queues.setdefault((to, key), deque()).append(
                    build.liveliness(node=node, alive=alive)
                )

    def send(self, source: str, out: Sequence[Outgoing]) -> None:
        for o in out:
            self.sent[o.key].append(o.message)
            for to, node in self.nodes.items():
                mine = not to.startswith("robot/") or o.name in ("", node.robot)
                overheard = to.startswith("robot/") and o.channel in node.overhears
                if to != source and ((o.channel in node.listens and mine) or overheard):
                    self.queues.setdefault((to, o.key), deque()).append(o.message)

    def kill(self, robot: str, *, patience: bool = False) -> None:
        """End the robot's process; messages it sent still arrive.

        patience: the centre's shell delays the news.
        """
        node = ch.robot_node(robot)
        del self.nodes[node]
        self.queues = {k: q for k, q in self.queues.items() if k[0] != node}
        self.token(node, alive=False)
        if patience:
            self.queues[("central", ch.ALIVE.key(node))].pop()

    def resume(self, robot: RobotConfig) -> None:
        name, node = ch.robot_node(robot.id), robot_node(robot, self.exchange)
        self.nodes[name] = self.robots[robot.id] = node
        request = encoded(build.submaps_request(robot=robot.id))
        kept = [decoded(reply) for reply in self.centre.answer_submaps(request)]
        if kept:
            node.take_over(kept)
        self.queues[(name, "central/alive")] = deque([build.liveliness(node="central")])
        latest = [
            self.sent[c.key()][-1:] for c in (ch.KNOWN_MAP, ch.END, ch.FUSED_MAP, ch.FINAL_MAP)
        ]
        self.queues[(name, "latest")] = deque(x for kept in latest for x in kept)
        self.token(name, alive=True)
        self.send(name, node.begin())

    def step(self) -> bool:
        ready = [key for key, queue in self.queues.items() if queue]
        if not ready or self.rng.random() < 0.2:
            out = self.world.publish(0.0)
            self.send("world", out)
            if out or ready:
                return True
            return self.mend()
        to, key = self.rng.choice(ready)
        message = self.queues[(to, key)].popleft()
        self.send(to, self.nodes[to].handle(message))
        return True

    def mend(self) -> bool:
        found = False
        for name, node in [(k, v) for k, v in self.nodes.items() if k.startswith("robot/")]:
            wanted = node.request()
            waiting = node.inbox.ahead or any(node.inbox.later.values())
            if wanted is None and not node.finished and not waiting:
                wanted = build.measurements_request(
                    robot=node.robot, incarnation=node.incarnation, first=node.next_measurement
                )
            if wanted is None:
                continue
            for reply in self.world.measurements(encoded(wanted)):
                found = True
                self.send(name, node.handle(decoded(reply)))
        return found

    def run(self, limit: int = 100_000) -> None:
        for _ in range(limit):
            if not self.step():
                return
        raise AssertionError("the team does not come to rest")

    @property
    def final(self) -> m.FusedMap:
        (final,) = self.sent[ch.FINAL_MAP.key()]
        return final
