"""Measure the recorder's completeness and cost under load.

    python -m benchmarks.recorder [--robots 10] [--hz 100] [--seconds 60] [--json FILE]

A router, `teamslam record`, and publishers of odometry and observations in real time. Exit status 1
if a message was lost or a figure is worse than benchmarks/recorder.json allows.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baseline import conclude, parser_of
from teamslam.sim.scenarios.scenario import dumps, load, with_options
from teamslam.team.recording.check import check_log
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests import build

PUBLISHERS = 2
LANDMARKS = 5  # landmarks per observation
_COMMAND = [sys.executable, "-m", "teamslam"]


def publish(endpoint: str, team: str, robots: Sequence[str], hz: float, seconds: float) -> None:
    """Publish each robot's measurements on time, in a process of its own; print counts by key."""
    rng = np.random.default_rng(0)
    period_ns = round(1e9 / hz)
    counts: dict[str, int] = {}
    late_s = 0.0
    with ZenohBus(team, endpoint) as bus:
        for robot in robots:
            bus.declare_alive(ch.robot_node(robot))
        time.sleep(1.0)
        began = time.monotonic()
        for k in range(round(hz * seconds)):
            wait = began + k / hz - time.monotonic()
            late_s = max(late_s, -wait)
            if wait > 0.0:
                time.sleep(wait)
            for robot in robots:
                values = rng.uniform(1.0, 10.0, LANDMARKS)
                head = {"stamp_ns": k * period_ns, "robot": robot}
                seen = {"ids": range(LANDMARKS), "ranges": values, "bearings": values / 10.0}
                for channel, message in (
                    (ch.ODOMETRY, build.odometry(**head, number=2 * k, duration_ns=period_ns)),
                    (ch.OBSERVATIONS, build.observations(**head, number=2 * k + 1, **seen)),
                ):
                    bus.publish(Outgoing(channel, robot, message))
                    key = channel.key(robot)
                    counts[key] = counts.get(key, 0) + 1
        took_s = time.monotonic() - began
    print(json.dumps({"counts": counts, "took_s": took_s, "late_s": late_s}))


def cpu_s(pid: int) -> float:
    """Read the CPU time of a process (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def peak_mib(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    (line,) = [line for line in lines if line.startswith("VmHWM")]
    return int(line.split()[1]) / 1024.0


def measure_recorder(robots: int, hz: float, seconds: float, folder: Path) -> dict[str, Any]:
    scenario = with_options(load("thesis"), robots=robots)
    told = folder / "scenario.json"
    told.write_text(dumps(scenario))
    log = folder / "log.mcap"
    names = [robot.id for robot in scenario.robots]
    router = subprocess.Popen(
        [*_COMMAND, "router", "--listen", "tcp/127.0.0.1:0"], stdout=subprocess.PIPE, text=True
    )
    children = [router]
    try:
        assert router.stdout is not None
        line = next(line for line in router.stdout if line.startswith("listening at "))
        endpoint = line.removeprefix("listening at ").strip()
        recorder = subprocess.Popen(
            [*_COMMAND, "record", str(told), "--connect", endpoint, "--output", str(log)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        children.append(recorder)
        with ZenohBus(scenario.team, endpoint) as bus:
            _wait_for_recorder(bus)
            bus.declare_alive("central")
            began_cpu, began = cpu_s(recorder.pid), time.monotonic()
            publishers = [
                subprocess.Popen(
                    [sys.executable, "-m", "benchmarks.recorder",
                     "--publish", endpoint, scenario.team, *names[k::PUBLISHERS],
                     "--hz", str(hz), "--seconds", str(seconds)],
                    stdout=subprocess.PIPE, text=True,
                )
                for k in range(PUBLISHERS)
            ]  # fmt: skip
            children += publishers
            while any(each.poll() is None for each in publishers):
                used_cpu, memory = cpu_s(recorder.pid), peak_mib(recorder.pid)
                elapsed = time.monotonic() - began
                time.sleep(0.2)
            said = [json.loads(each.communicate()[0].splitlines()[-1]) for each in publishers]
            # The message after which a recorder without a team ends.
            bus.publish(Outgoing(ch.FINAL_MAP, "", build.fused_map(final=True, ids=[], means=[])))
        recorder.wait(timeout=60)
    finally:
        for child in children:
            if child.poll() is None:
                child.terminate()
                child.wait(timeout=20)
    return _figures(log, said, (used_cpu - began_cpu) / elapsed, memory)


def _figures(log: Path, said: list[dict[str, Any]], cpu: float, memory: float) -> dict[str, Any]:
    published = {key: n for each in said for key, n in each["counts"].items()}
    opened = open_log(log)
    counts = opened.counts()
    lost = {
        key: [n, counts[key].messages if key in counts else 0]
        for key, n in published.items()
        if key not in counts or counts[key].messages != n
    }
    took_s = max(each["took_s"] for each in said)
    total, size = sum(published.values()), sum(c.bytes for c in counts.values())
    measurements = set(published)
    return {
        "published": total,
        "recorded": sum(counts[key].messages for key in measurements if key in counts),
        "lost": lost,
        "findings": [str(f) for f in check_log(opened)],
        "messages_per_s": total / took_s,
        "publishers_late_s": max(each["late_s"] for each in said),
        "payload_bytes": size,
        "file_bytes": log.stat().st_size,
        "recorder_cpu": cpu,
        "recorder_peak_mib": memory,
        "cpu_us_per_message": cpu * 1e6 * took_s / total,
    }


def _wait_for_recorder(bus: ZenohBus) -> None:
    bus.subscribe(ch.STATUS)
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        if any(s.key == ch.STATUS.key("recorder") for s in bus.receive(0.2)):
            return
    raise TimeoutError("the recorder did not come up within 60 s")


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--hz", type=float, default=100.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--publish", nargs="+", help=argparse.SUPPRESS)
    told = parser.parse_args()
    if told.publish:
        endpoint, team, *robots = told.publish
        publish(endpoint, team, robots, told.hz, told.seconds)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        figures = measure_recorder(told.robots, told.hz, told.seconds, Path(folder))
    lost = (f"{k}: {v}" for k, v in figures["lost"].items())
    return conclude(figures, "recorder", told.json, *figures["findings"], *lost)


if __name__ == "__main__":
    sys.exit(main())
