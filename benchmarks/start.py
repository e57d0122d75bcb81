"""Measure the cost of a launch's processes, and of processes that are started by hand.

    python -m benchmarks.start [--scenario waypoints] [--robots N] [--json FILE]

A team is launched without views. command_first_s: from the start of `launch` to the first
measurement on the bus, the least of three. cpu_s, pss_mb, peak_rss_mb: as in a launch's JSON.
alone: resident memory, that without pages of files, and CPU of a router, recorder and robot started
by hand, ready and idle. in_bare_starts: in CPU of a start of Python with NumPy, which holds on any
machine.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import mean
from typing import Any

from benchmarks.baseline import conclude, parser_of
from teamslam.sim.launch.launch import Plan, launch
from teamslam.sim.launch.processes import PROGRAM
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.team.recording.reader import open_log
from teamslam.team.wire.channels import SENSORS


def launch_team(scenario: Scenario, folder: Path) -> dict[str, Any]:
    folder.mkdir()
    plan = Plan(
        scenario=scenario,
        folder=folder,
        log=folder / "log.mcap",
        speed=float("inf"),
        listen="tcp/127.0.0.1:0",
        views=False,
    )
    outcome = launch(plan, lambda watch: None)
    assert outcome.failures == [], outcome.failures
    robots = [used for name, used in outcome.used.items() if name.startswith("robot-")]
    return {
        "cpu_s": sum(used.cpu_s for used in outcome.used.values()),
        "robot_cpu_s": mean(used.cpu_s for used in robots),
        "robot_pss_mb": mean(used.pss_mb or 0.0 for used in robots),
        "peak_rss_mb": {name: used.peak_rss_mb for name, used in outcome.used.items()},
    }


def first_ns(log: Path) -> int:
    return min(sample.wall_ns for sample in open_log(log).samples(SENSORS))


def command_first_s(words: list[str], folder: Path) -> float:
    began_ns = time.time_ns()
    command = [*PROGRAM, "launch", *words, "--no-views", "--no-report", "--output", str(folder)]
    subprocess.run(command, check=True, capture_output=True)
    return 1e-9 * (first_ns(folder / "log.mcap") - began_ns)


def measure_idle(folder: Path) -> dict[str, dict[str, float]]:
    """Measure the resources of a router, a recorder and a robot, ready and idle."""
    folder.mkdir()
    log = str(folder / "log.mcap")
    words = {
        "router": ["router", "--listen", "tcp/127.0.0.1:0"],
        "recorder": ["record", "waypoints", "--output", log],
        "robot": ["robot", "waypoints", "r1"],
    }
    running: dict[str, subprocess.Popen[str]] = {}
    connect: list[str] = []
    try:
        for name, own in words.items():
            running[name] = subprocess.Popen(
                [*PROGRAM, *own, *connect],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            line = await_line(running[name], "listening at" if name == "router" else "connected")
            connect = connect or ["--connect", line.split()[-1]]
        return {name: measure_at_rest(process.pid) for name, process in running.items()}
    finally:
        for process in running.values():
            process.terminate()
            process.communicate()


def await_line(process: "subprocess.Popen[str]", words: str) -> str:
    assert process.stdout is not None
    return next(line for line in process.stdout if words in line)


def measure_at_rest(pid: int) -> dict[str, float]:
    """Measure memory and CPU of a process at rest: below a tenth of a core for a second."""
    ticks = [-100]
    while ticks[-1] - ticks[0] > 10 or len(ticks) < 2:
        time.sleep(1.0)
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks = [ticks[-1], int(fields[11]) + int(fields[12])]
    rows = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kb = {name: int(size) for name, size, *_ in (row.replace(":", "").split() for row in rows)}
    cpu_s = ticks[-1] / os.sysconf("SC_CLK_TCK")
    return {"rss_mb": kb["Rss"] / 1024, "anonymous_mb": kb["Anonymous"] / 1024, "cpu_s": cpu_s}


def bare_cpu_s() -> float:
    """Measure the least CPU of three starts of Python with NumPy."""
    took = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", "import numpy"], check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(took)


def measure_start(scenario: Scenario, words: list[str]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        team = launch_team(scenario, Path(folder) / "team")
        first_s = min(command_first_s(words, Path(folder) / f"command-{k}") for k in range(3))
        by_hand = measure_idle(Path(folder) / "alone")
    bare = bare_cpu_s()
    return {
        "robots": len(scenario.robots),
        "team": team,
        "command_first_s": first_s,
        "alone": by_hand,
        **{f"{name}_alone_mb": used["rss_mb"] for name, used in by_hand.items()},
        "robot_alone_in_bare_starts": by_hand["robot"]["cpu_s"] / bare,
    }


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--scenario", default="waypoints")
    parser.add_argument("--robots", type=int)
    told = parser.parse_args()
    words = [told.scenario, *([] if told.robots is None else ["--robots", str(told.robots)])]
    figures = measure_start(with_options(load(told.scenario), robots=told.robots), words)
    return conclude(figures, "start", told.json)


if __name__ == "__main__":
    sys.exit(main())
