"""Measure the cost of keys and of the fault boundary, as ratios in one run.

    python -m benchmarks.security [--messages 20000] [--rounds 5] [--json FILE]

Links: router, publisher and receiver, each a process with Zenoh on loopback; alternately over open
TCP, and over TLS with access control. Throughput: observations of five landmarks at the receiver's
rate. Latency: round trip of one message at rest. Boundary: a node with `teamslam.team.containment`
and without it; CPU time, the least of alternating turns.

Only ratios have a baseline (benchmarks/security.json): both halves depend on the machine.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.baseline import conclude, parser_of
from teamslam.team.containment import Boundary
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import load_roster, nodes_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample, opened
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build

TEAM = "bench"
PINGS = 500
A_TURN = 500  # messages per turn with the boundary, or without
_HERE = [sys.executable, "-m", "benchmarks.security"]


def observations(i: int) -> m.Observations:
    seen = {"ids": range(5), "ranges": np.linspace(1.0, 9.0, 5), "bearings": [0.1] * 5}
    return build.observations(stamp_ns=i, number=i, **seen)


def enter_team(endpoint: str, folder: Path | None, node: str) -> ZenohBus:
    return ZenohBus(TEAM, endpoint, 20.0, folder and credentials_of(folder, node, TEAM))


def serve(folder: Path | None) -> None:
    own = folder and (credentials_of(folder, "router"), load_roster(folder))
    with router("tls/127.0.0.1:0" if folder else "tcp/127.0.0.1:0", own) as endpoint:
        print(endpoint, flush=True)
        sys.stdin.read()


def take(endpoint: str, folder: Path | None, count: int) -> None:
    """Receive in a process of its own: answer each progress, count observations."""
    with enter_team(endpoint, folder, "robot-r1") as bus:
        bus.subscribe(ch.OBSERVATIONS, "r1")
        bus.subscribe(ch.END)
        print("there", flush=True)
        arrived, began = 0, 0.0
        while arrived < count:
            for sample in bus.receive(0.05):
                if sample.key == ch.END.key():
                    done = build.progress(stamp_ns=sample.stamp_ns)
                    bus.publish(Outgoing(ch.ROBOT_PROGRESS, "r1", done))
                    continue
                began = began or time.monotonic()
                arrived += 1
        print(json.dumps((arrived - 1) / (time.monotonic() - began)), flush=True)


def link(folder: Path | None, count: int) -> tuple[float, float]:
    """Measure messages per second and the median round trip [s]."""
    more = [] if folder is None else ["--keys", str(folder)]
    hub = subprocess.Popen(
        [*_HERE, "--serve", *more], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert hub.stdout is not None
        endpoint = hub.stdout.readline().strip()
        receiver = subprocess.Popen(
            [*_HERE, "--take", endpoint, "--messages", str(count), *more],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert receiver.stdout is not None
        receiver.stdout.readline()
        with enter_team(endpoint, folder, "world") as bus:
            bus.subscribe(ch.ROBOT_PROGRESS, "r1")
            took = [ping(bus, i) for i in range(PINGS + 50)][50:]
            for i in range(count):
                bus.publish(Outgoing(ch.OBSERVATIONS, "r1", observations(i)))
            rate = float(receiver.communicate(timeout=120)[0])
    finally:
        hub.communicate("")
    return rate, median(took)


def ping(bus: ZenohBus, stamp_ns: int) -> float:
    """Measure one round trip; send again while the link comes up."""
    began = time.perf_counter()
    bus.publish(Outgoing(ch.END, "", m.End(stamp_ns=stamp_ns, streams=())))
    while True:
        back = bus.receive(1.0)
        if any(sample.stamp_ns == stamp_ns for sample in back):
            return time.perf_counter() - began
        if not back:
            bus.publish(Outgoing(ch.END, "", m.End(stamp_ns=stamp_ns, streams=())))


class Sink:
    """Node without effect."""

    taken = 0

    def handle(self, message: m.Message) -> list[Outgoing]:
        self.taken += 1
        return []


def measure_boundary(count: int) -> tuple[float, float]:
    """Measure the CPU seconds per message of a node, without and with the boundary, the least of
    turns.
    """
    samples = [
        Sample(ch.OBSERVATIONS.key("r1"), encoded(observations(i)), i, 0, i) for i in range(count)
    ]
    node, boundary = Sink(), Boundary("robot/r1")

    def plainly(sample: Sample) -> list[Outgoing]:
        return node.handle(opened(sample)[2])

    def within(sample: Sample) -> list[Outgoing]:
        return boundary.take(node, sample)

    def turn(hand: Callable[[Sample], list[Outgoing]], some: list[Sample]) -> float:
        began = time.process_time()
        for sample in some:
            hand(sample)
        return (time.process_time() - began) / len(some)

    turns = [samples[at : at + A_TURN] for at in range(0, count, A_TURN)]
    took = [(turn(plainly, some), turn(within, some)) for some in turns]
    assert node.taken == 2 * count
    bare_s, within_s = np.min(took, axis=0)
    return float(bare_s), float(within_s)


def measure_security(count: int, rounds: int) -> dict[str, Any]:
    """Return medians over rounds of all halves, and ratios of these medians."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        keys = Path(folder)
        make_keys(keys, TEAM, nodes_of(["r1"]))
        for _ in range(rounds):
            free, locked = link(None, count), link(keys, count)
            rows.append((*free, *locked, *measure_boundary(count)))
    open_rate, open_s, keys_rate, keys_s, bare_s, within_s = (
        float(value) for value in np.median(np.array(rows), axis=0)
    )
    return {
        "open": {"messages_per_s": open_rate, "round_trip_us": 1e6 * open_s},
        "keys": {"messages_per_s": keys_rate, "round_trip_us": 1e6 * keys_s},
        "handling_us": {"bare": 1e6 * bare_s, "contained": 1e6 * within_s},
        "throughput_with_keys": keys_rate / open_rate,
        "round_trip_with_keys": keys_s / open_s,
        "handling_contained": within_s / bare_s,
    }


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--messages", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--take", help=argparse.SUPPRESS)
    parser.add_argument("--keys", type=Path, help=argparse.SUPPRESS)
    told = parser.parse_args()
    if told.serve:
        serve(told.keys)
        return 0
    if told.take:
        take(told.take, told.keys, told.messages)
        return 0
    figures = measure_security(told.messages, told.rounds)
    print(f"load {os.getloadavg()[0]:.1f}", file=sys.stderr)
    return conclude(figures, "security", told.json)


if __name__ == "__main__":
    sys.exit(main())
