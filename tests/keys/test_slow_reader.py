import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import pairwise

import pytest
import zenoh
from zenoh.handlers import Callback

from teamslam.team.keys.credentials import Credentials, credentials_of
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from teamslam.team.wire.zenoh.session import client
from tests.keys.certificates import TEAM
from tests.support import ROOT, Link, wait_until

READERS = 3
ROBOTS = ("r1", "r2")
PAYLOAD = bytes(60_000)
MOST_S = 2.5
"""Half of the time after which the router closes a link that is silent, so half of what the stopped
readers cost if the others wait for them: 5 s and more."""
ROUTER = """
import sys, threading
from pathlib import Path
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import load_roster
from teamslam.team.wire.zenoh.router import router
own = Path(sys.argv[1]) if sys.argv[1] else None
listen = "tls/127.0.0.1:0" if own else "tcp/127.0.0.1:0"
with router(listen, (credentials_of(own, "router"), load_roster(own)) if own else None) as endpoint:
    print(endpoint, flush=True)
    threading.Event().wait()
"""
READER = """
import sys, threading
from pathlib import Path
from zenoh.handlers import Callback
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.wire.zenoh.session import client
own = credentials_of(Path(sys.argv[1]), "viewer") if sys.argv[1] else None
with client(sys.argv[2], 60.0, own) as session:
    callback = Callback(lambda sample: None, indirect=False)
    session.declare_subscriber(sys.argv[3], callback)
    print("reads", flush=True)
    threading.Event().wait()
"""


@contextmanager
def running(program: str, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def note_arrival(times: list[float], _: zenoh.Sample) -> None:
    times.append(time.monotonic())


@pytest.mark.parametrize("with_keys", [True, False], ids=["keys", "no keys"])
def test_stopped_readers_do_not_stop_the_others(keys, with_keys):
    folder = str(keys.own) if with_keys else ""

    def own(node: str) -> Credentials | None:
        return credentials_of(keys.own, node, TEAM) if with_keys else None

    arrivals: dict[str, list[float]] = {robot: [] for robot in ROBOTS}
    over = threading.Event()

    def publish(robot: str, endpoint: str) -> None:
        with ZenohBus(TEAM, endpoint, 60.0, own(f"robot-{robot}")) as bus:
            number = 0
            while not over.wait(0.02):
                bus.publish_raw(Sample(f"robot/{robot}/submap", PAYLOAD, 0, 0, number))
                number += 1

    with ExitStack() as stack:
        _, endpoint = stack.enter_context(running(ROUTER, folder))
        readers = [
            stack.enter_context(running(READER, folder, endpoint, f"team/{TEAM}/**"))
            for _ in range(READERS)
        ]
        assert {line for _, line in readers} == {"reads"}
        centre = stack.enter_context(client(endpoint, 60.0, own("central")))
        for robot, times in arrivals.items():
            note = Callback(partial(note_arrival, times), indirect=False)
            centre.declare_subscriber(f"team/{TEAM}/robot/{robot}/submap", note)
        publishers = [threading.Thread(target=publish, args=(each, endpoint)) for each in ROBOTS]
        for thread in publishers:
            thread.start()
        stack.callback(lambda: [over.set(), *(thread.join() for thread in publishers)])
        wait_until(lambda: all(len(times) > 20 for times in arrivals.values()), what="submaps")
        stopped_s = time.monotonic()
        for process, _ in readers:
            os.kill(process.pid, signal.SIGSTOP)
        wait_until(
            lambda: all(times[-1] > stopped_s + 8.0 for times in arrivals.values()),
            what="submaps 8 s after the readers have stopped",
        )
    for times in arrivals.values():
        assert max(later - sooner for sooner, later in pairwise(times)) < MOST_S


def test_a_reader_that_reads_again_fetches_what_was_dropped():
    count = 300  # more than the queue and the sockets' buffers hold
    with (
        router() as endpoint,
        Link(endpoint) as link,
        ZenohBus(TEAM, link.endpoint, 60.0) as reader,
        ZenohBus(TEAM, endpoint, 60.0) as source,
    ):

        def publish(number: int) -> None:
            source.publish_raw(Sample("robot/r1/submap", PAYLOAD, 0, 0, number))

        reader.subscribe(ch.SUBMAP)
        publish(0)
        wait_until(lambda: bool(reader.receive(0.05)), what="the first submap")
        link.stall()
        for number in range(1, count):
            publish(number)
        link.mend()
        arrived: list[int] = []

        def receive() -> bool:
            arrived.extend(sample.counter for sample in reader.receive(0.05))
            return len(arrived) >= count - 1

        wait_until(receive, what="the submaps of meanwhile")
        assert arrived == list(range(1, count))
