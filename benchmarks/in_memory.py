"""A team in memory over its size: the CPU of a run, its memory, and whether its log verifies.

    python -m benchmarks.in_memory [--robots 50,100,200,400] [--steps 24] [--verify] [--json FILE]

Robots and landmarks of `random-50` in a place that grows with their number, so that a robot sees
as much in a team of a thousand as in one of fifty. Each size is run in a process of its own.
cpu_ms: of one robot, the world's simulation included. verify_ms: to compute all of it again.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
import time
from math import sqrt
from pathlib import Path

import msgspec

from central.desk.verification.verification import verify
from sim.in_memory.team import final_map, run_team
from sim.launch.warm_up import run_small_team
from sim.scenarios.scenario import Scenario, load, with_options
from sim.scenarios.source import streams_of
from sim.world.config import SimulatedWorld
from team.recording.provenance import provenance
from team.recording.reader import open_log
from team.recording.recorder import Recorder

BASE = 50
LANDMARKS = 18


def scaled(robots: int, steps: int) -> Scenario:
    """`random-50` with so many robots, as dense."""
    scenario = with_options(load("random-50"), robots=robots)
    world = scenario.world
    assert isinstance(world, SimulatedWorld)
    return msgspec.structs.replace(
        scenario,
        world=msgspec.structs.replace(
            world,
            steps=steps,
            size_m=world.size_m * sqrt(robots / BASE),
            landmark_count=LANDMARKS * robots // BASE,
        ),
    )


def run(robots: int, steps: int, *, again: bool) -> dict[str, float]:
    """One run, in this process."""
    run_small_team("hybrid", "join")
    scenario = scaled(robots, steps)
    began = time.process_time()
    streams = streams_of(scenario)
    simulated = time.process_time()
    samples = list(run_team(scenario, streams))
    ended = time.process_time()
    members = final_map(samples).members
    found = {
        "robots": robots,
        "world_s": simulated - began,
        "run_s": ended - simulated,
        "cpu_ms": 1e3 * (ended - began) / robots,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "submaps": sum(each.sequence + 1 for each in members),
        "bytes": sum(len(sample.payload) for sample in samples),
    }
    if again:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.mcap"
            with Recorder(path, "in memory", provenance()) as recorder:
                recorder.write(samples)
            began = time.process_time()
            result = verify(open_log(path))
            found["verify_ms"] = 1e3 * (time.process_time() - began) / robots
            found["messages"] = sum(channel.messages for channel in result.channels)
            found["equal"] = sum(channel.equal for channel in result.channels)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", default="50,100,200,400")
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--verify", action="store_true")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    rows = []
    for robots in map(int, told.robots.split(",")):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(run, (robots, told.steps), {"again": told.verify})
        rows.append(row)
        print("  ".join(f"{name} {value:.5g}" for name, value in row.items()), flush=True)
    if told.json is not None:
        told.json.write_text(json.dumps(rows, indent=2) + "\n")
    return int(any(row.get("equal") != row.get("messages") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
