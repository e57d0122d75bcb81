"""Measure CPU, memory and verification of a team in memory over its size.

    python -m benchmarks.in_memory [--robots 50,400] [--steps 24] [--json FILE]

`random-50` at constant density, each size in its own process. cpu_ms: of one robot, with the
world's simulation. verify_ms: to compute all of it again. equal: share of equal messages. growth_*:
largest size over smallest. Exit status 1 if one is worse than in_memory.json allows.
"""

import multiprocessing
import resource
import sys
import tempfile
import time
from math import sqrt
from pathlib import Path

import msgspec

from benchmarks.baseline import conclude, parser_of
from teamslam.central.desk.verification.verification import verify
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import SimulatedWorld
from teamslam.team.recording.provenance import provenance
from teamslam.team.recording.reader import open_log
from teamslam.team.recording.recorder import Recorder

BASE = 50
LANDMARKS = 18
MEASURED = "50,400"


def scaled(robots: int, steps: int) -> Scenario:
    """Scale `random-50` to so many robots at the same density."""
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


def run(robots: int, steps: int) -> dict[str, float]:
    scenario = scaled(robots, steps)
    began = time.process_time()
    streams = streams_of(scenario)
    simulated = time.process_time()
    samples = list(run_team(scenario, streams))
    ended = time.process_time()
    peak_rss_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        with Recorder(path, "in memory", provenance()) as recorder:
            recorder.write(samples)
        began_again = time.process_time()
        channels = verify(open_log(path)).channels
        verified = time.process_time()
    return {
        "robots": robots,
        "world_s": simulated - began,
        "run_s": ended - simulated,
        "cpu_ms": 1e3 * (ended - began) / robots,
        "verify_ms": 1e3 * (verified - began_again) / robots,
        "peak_rss_mb": peak_rss_mb,
        "submaps": sum(each.sequence + 1 for each in final_map(samples).members),
        "bytes": sum(len(sample.payload) for sample in samples),
        "messages": sum(channel.messages for channel in channels),
        "equal": sum(channel.equal for channel in channels),
    }


def figures(rows: list[dict[str, float]]) -> dict[str, float]:
    small, large = rows[0], rows[-1]
    return {
        "growth_cpu": large["cpu_ms"] / small["cpu_ms"],
        "growth_verify": large["verify_ms"] / small["verify_ms"],
        "growth_memory": large["peak_rss_mb"] / small["peak_rss_mb"],
        "equal": sum(row["equal"] for row in rows) / sum(row["messages"] for row in rows),
    }


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--robots", default=MEASURED)
    parser.add_argument("--steps", type=int, default=24)
    told = parser.parse_args()
    rows = []
    for robots in map(int, told.robots.split(",")):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(run, (robots, told.steps))
        rows.append(row)
        print("  ".join(f"{name} {value:.5g}" for name, value in row.items()), flush=True)
    found = {"rows": rows, "figures": figures(rows)}
    wrong = [] if found["figures"]["equal"] == 1.0 else ["not all messages are equal"]
    name = "in_memory" if told.robots == MEASURED else None
    return conclude(found, name, told.json, *wrong)


if __name__ == "__main__":
    sys.exit(main())
