"""Extreme messages of every type, on every channel, to every node: nothing raises.

TEAMSLAM_STORM=N draws N of each type for each channel; `make check-core CORE_TESTS=tests/hostile`
checks the core's indices.
"""

import os
import resource
import time
from collections.abc import Callable
from functools import cache
from random import Random
from zlib import crc32

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.desk.view.node import ViewerNode
from teamslam.central.node import CentralNode
from teamslam.central.peers.main import PeerCentre
from teamslam.central.peers.robot import PeerRobot
from teamslam.team.config import FrontEnd, RobotConfig
from teamslam.team.containment import Boundary
from teamslam.team.recording.check import check_log
from teamslam.team.recording.reader import open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.recording.shell import RecordLoop
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample, opened
from teamslam.team.wire.codec import WireError, decoded, encoded
from tests import build
from tests.hostile.drawing import CHANNELS, ROBOTS, S, extreme_samples as samples, mutated

COUNT = int(os.environ.get("TEAMSLAM_STORM", "6"))
MOST_MIB = 150  # growth of the process over all messages of one type
MOST_S = 10.0  # CPU time of all messages of one type at one node
Node = RobotNode | CentralNode | PeerCentre | PeerRobot
ROBOT = RobotConfig("r1", front_end=FrontEnd(particles=10, window_s=10.0))
NODES: dict[str, Callable[[], Node]] = {
    "robot": lambda: RobotNode(ROBOT),
    "centre": lambda: CentralNode(CentralConfig(), ROBOTS),
    "peer robot": lambda: PeerRobot(ROBOT, CentralConfig(), ROBOTS),
    "peer centre": lambda: PeerCentre(CentralConfig(), ROBOTS),
}
CARRIED = sorted((kind for kind in CHANNELS if CHANNELS[kind]), key=m.tag_of)


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


@cache
def drawn(kind: type[m.Message], count: int) -> list[Sample]:
    """Extreme messages of a class in a session of a robot that has begun; a tenth are mutated."""
    rng = np.random.default_rng(crc32(m.tag_of(kind).encode()))  # a new class changes no other's
    flips = Random(7)
    found: list[Sample] = []
    for k, (channel, name, payload) in enumerate(samples(rng, kind, count)):
        data = mutated(flips, payload) if k % 10 == 9 else payload
        found.append(Sample(channel.key(name), data, k, k, k))
    return found


def beginning() -> list[Sample]:
    out = []
    for robot in ROBOTS:
        start = build.initial_pose(robot=robot)
        out.append(Outgoing(ch.START, robot, start))
        for k in range(1, 12):
            motion = build.odometry(stamp_ns=k * S, robot=robot, number=k)  # fmt: skip
            out.append(Outgoing(ch.ODOMETRY, robot, motion))
    return [Sample(each.key, encoded(each.message), each.message.stamp_ns, 0, 0) for each in out]


def test_every_type_on_a_channel_is_drawn_and_most_of_it_passes_the_door():
    passed = {}
    for kind in CARRIED:
        sound = 0
        for sample in drawn(kind, COUNT):
            try:
                sound += isinstance(opened(sample)[2], kind)
            except WireError:
                continue
        passed[m.tag_of(kind)] = sound / len(drawn(kind, COUNT))
    assert min(passed.values()) > 0.2, passed


@pytest.mark.parametrize("kind", CARRIED, ids=m.tag_of)
@pytest.mark.parametrize("name", NODES)
def test_no_extreme_message_raises_in_a_node(name, kind):
    def hand_over() -> tuple[float, float]:
        """CPU time [s] and growth of the peak memory [MiB]."""
        node, boundary = NODES[name](), Boundary(name)
        answers = node.begin()
        before, began = peak_mib(), time.process_time()
        for sample in [*beginning(), *drawn(kind, COUNT)]:
            answers += boundary.take(node, sample)
        took = time.process_time() - began, peak_mib() - before
        assert boundary.faults == 0, boundary.last
        for each in [*answers, Outgoing(ch.STATUS, name, node.status())]:
            decoded(encoded(each.message), type(each.message))
        return took

    took_s, grown_mib = hand_over()
    assert took_s < MOST_S
    assert grown_mib < MOST_MIB


def test_no_extreme_message_raises_in_the_viewer():
    viewer = ViewerNode()
    for kind in CARRIED:
        for sample in drawn(kind, COUNT):
            try:
                channel, _, message = opened(sample)
            except WireError:
                continue
            viewer.handle(channel, message)


def test_every_extreme_message_is_recorded_and_the_log_can_be_checked(tmp_path):
    path = tmp_path / "log.mcap"
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(MemoryBus(MemoryNetwork()), recorder, ())
        for kind in CARRIED:
            loop.take(drawn(kind, COUNT))
        loop.status(last=True)
    assert sum(1 for _ in open_log(path).samples()) > 0
    before, began = peak_mib(), time.process_time()
    assert check_log(open_log(path))
    assert time.process_time() - began < MOST_S
    assert peak_mib() - before < MOST_MIB
