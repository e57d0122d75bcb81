from collections.abc import Sequence

import msgspec
import numpy as np

from teamslam.sim.publisher.node import WorldNode
from teamslam.sim.scenarios.scenario import Scenario, with_options
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.simulator import simulate
from teamslam.sim.world.streams import WorldStreams
from teamslam.team import translate
from teamslam.team.config import MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats
from teamslam.team.wire.bus import Outgoing, Sample, opened
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import announce_configuration
from tests import build
from tests.scenarios import with_world
from tests.support import fused_map

STEPS = 20


def scenario(seed: int = 1, robots: int = 1) -> Scenario:
    motion = MotionModel(
        kind="turn-then-drive", forward=MotionNoise(per_s=0.05), turn=MotionNoise(per_s=0.02)
    )
    sensor = Sensor(range_sigma=0.1, bearing_sigma=0.02)
    world = SimulatedWorld(
        steps=STEPS,
        size_m=20.0,
        landmarks=((5, 6), (15, 5), (10, 11), (4, 15), (16, 16), (11, 3), (18, 10), (2, 10)),
        paths=(((3, 3), (17, 4), (16, 14)), ((17, 17), (5, 14), (4, 4))),
        visible_from_m=1.5,
        visible_to_m=12.0,
    )
    names = tuple(RobotConfig(f"r{i}", motion, sensor) for i in range(1, robots + 1))
    return with_options(Scenario(name="small", team="small", world=world, robots=names), seed=seed)


def without_starts(of: Scenario) -> Scenario:
    """The scenario with no known initial pose, so that the map's frame is arbitrary."""
    return with_world(of, unknown_starts=("*",))


def streams(of: Scenario) -> WorldStreams:
    return simulate(of.world, of.robots, of.seed)


def samples(out: Sequence[Outgoing]) -> list[Sample]:
    return [Sample(o.key, encoded(o.message), o.message.stamp_ns, 0, i) for i, o in enumerate(out)]


def world_log(of: Scenario) -> list[Sample]:
    node = WorldNode(streams(of), frozenset(), announce_configuration("world", 0, 0, of))
    out = node.begin()
    while not node.ended:
        out += node.publish(0.0)
    return samples(out)


def final_map(
    ids: Sequence[int], means: np.ndarray, covariance: np.ndarray, *, joint: bool = True
) -> Outgoing:
    content = translate.covariance_bytes(covariance, joint=joint)
    message = fused_map(
        stamp_ns=STEPS * 10**9,
        final=True,
        joint=joint,
        ids=ids,
        means=means,
        covariance=content,
        chi2=30.0,
        dof=20,
    )
    return Outgoing(ch.FINAL_MAP, "", message)


def trajectory(robot: str, stamps: Sequence[int], poses: np.ndarray, sigma: float) -> Outgoing:
    covariances = np.tile(sigma**2 * np.eye(3), (len(stamps), 1, 1))
    message = translate.trajectory_message((robot, 1), bytes(8), stamps, poses, covariances)
    return Outgoing(ch.TRAJECTORY, robot, message)


def online(channel: ch.Channel, poses: np.ndarray, of: Scenario) -> list[Outgoing]:
    ends = streams(of).streams[0].intervals.end_ns.tolist()
    unit = from_floats(np.eye(3))
    return [
        Outgoing(channel, "r1", build.pose_estimate(stamp_ns=t, pose=p, covariance=unit))
        for t, p in zip(ends, poses, strict=True)
    ]


def joined_log(of: Scenario, deviation: float) -> list[Sample]:
    world = streams(of)
    assert world.landmarks is not None
    out = []
    for stream in world.streams:
        poses = stream.truth[5::5] + deviation * np.array([0.5, -0.5, 0.1])
        out.append(trajectory(stream.robot, stream.truth_ns[5::5].tolist(), poses, 0.1))
    count = len(world.landmark_ids)
    means = world.landmarks + deviation * np.array([1.0, -1.0])
    out.append(final_map(world.landmark_ids.tolist(), means, 0.01 * np.eye(2 * count)))
    return world_log(of) + samples(out)


def counted_twice(log: Sequence[Sample]) -> list[Sample]:
    doubled = []
    for sample in log:
        _, _, message = opened(sample)
        if isinstance(message, m.Measurement):
            copies = 2 if isinstance(message, m.Observations) else 1
            for k in range(copies):
                again = msgspec.structs.replace(message, number=2 * message.number + k)
                doubled.append(msgspec.structs.replace(sample, payload=encoded(again)))
        else:
            doubled.append(sample)
    return doubled
