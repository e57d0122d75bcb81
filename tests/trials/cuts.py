"""Whole teams whose links are cut at random: each process in a network namespace of its own.

    python -m tests.trials.cuts --runs 10 --cuts 5 [--longest 12] [--json FILE]

Needs root and `ip` (Linux). The router, the world, the recorder, the centre and the robots hang on
one bridge; a cut takes one process's link down for a while, for less or for more than the lease of
a connection. Each run is a short world; its final map is compared byte by byte with that of the
same team in memory, and its log's content with the streams' own last counts. --json FILE keeps what
each run was, as it ends; called again with this file, only runs that are not in it are made. Ends
with 1 unless every process of every run ended with 0, with this map, and without a hole that
`teamslam log check` does not name.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from teamslam.sim.scenarios.scenario import load
from tests.namespaces import NET, ip, network
from tests.trials.kills import PROGRAM, await_text, expected_of, final_in, lacking, shortened

PORT = 7447
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass
class Run:
    """The result of one run; cuts: at [s after the start], whose link, for how long [s]."""

    number: int
    cuts: list[tuple[float, str, float]] = field(default_factory=list)
    exits: dict[str, int | None] = field(default_factory=dict)
    wall_s: float = 0.0
    equal: bool = False
    check: str = ""
    lacks: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """As if nothing had happened."""
        unnamed = bool(self.lacks) and not self.check
        return self.equal and not unnamed and not any(self.exits.values())


def commands(scenario: Path, robots: Sequence[str], speed: str) -> dict[str, list[str]]:
    there = ["--connect", f"tcp/{NET}.1:{PORT}"]
    what = str(scenario)
    found = {
        "recorder": ["record", what, "--output", "run/log.mcap", *there],
        "central": ["central", what, *there],
        "world": ["world", what, "--speed", speed, *there],
    }
    return found | {robot: ["robot", what, robot, *there] for robot in robots}


def one(number: int, scenario: Path, robots: Sequence[str], expected: bytes, options) -> Run:
    rng = random.Random(f"{options.seed} {number}")
    run = Run(number)
    told = commands(scenario, robots, options.speed)
    with tempfile.TemporaryDirectory() as place, network(list(told)) as names:
        folder = Path(place).resolve()
        (folder / "run").mkdir()
        started: dict[str, subprocess.Popen[bytes]] = {}

        def start(node: str, arguments: Sequence[str]) -> None:
            with (folder / "run" / f"{node}.log").open("wb") as said:
                started[node] = subprocess.Popen(
                    ["ip", "netns", "exec", names[node], *PROGRAM, *arguments],
                    cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                    env={**os.environ, **ONE_THREAD},
                )  # fmt: skip

        try:
            start("router", ["router", "--listen", f"tcp/{NET}.1:{PORT}", "--insecure"])
            await_text(folder / "run" / "router.log", "listening at")
            for node, arguments in told.items():
                start(node, arguments)
            for robot in robots:
                await_text(folder / "run" / f"{robot}.log", "connected")
            began = time.monotonic()
            cut_and_wait(run, names["router"], rng, list(told), started, options)
            run.wall_s = time.monotonic() - began
        finally:
            for node, process in started.items():
                run.exits[node] = process.poll()
                if process.poll() is None:
                    process.send_signal(signal.SIGTERM if node == "router" else signal.SIGKILL)
                process.wait(20.0)
            run.exits.pop("router", None)
        run.exits = {n: 99 if status is None else status for n, status in run.exits.items()}
        run.equal = final_in(folder) == expected
        run.lacks = lacking(folder)
        checked = subprocess.run(
            [*PROGRAM, "log", "check", "run/log.mcap"],
            cwd=folder, capture_output=True, text=True, check=False,
        )  # fmt: skip
        run.check = "" if checked.returncode == 0 else (checked.stdout + checked.stderr).strip()
        if not run.good and options.keep:
            shutil.copytree(folder, Path(options.keep) / f"run{number}", dirs_exist_ok=True)
    return run


def cut_and_wait(run: Run, hub: str, rng: random.Random, nodes, started, options) -> None:
    """Cut links at random moments, mend each, and return when all have ended or time is over."""
    began = time.monotonic()
    due = sorted(rng.uniform(0.0, options.span) for _ in range(options.cuts))
    mends: list[tuple[float, str]] = []
    while time.monotonic() - began < options.timeout:
        at = time.monotonic() - began
        whole = [node for node in nodes if node not in {cut for _, cut in mends}]
        if due and at >= due[0] and whole:
            due.pop(0)
            node = rng.choice(whole)
            for_s = rng.choice([0.3, 1.0, 3.0, options.longest])
            ip("-n", hub, "link", "set", node, "down")
            mends.append((at + for_s, node))
            run.cuts.append((round(at, 1), node, for_s))
        for until, node in [mend for mend in mends if at >= mend[0]]:
            mends.remove((until, node))
            ip("-n", hub, "link", "set", node, "up")
        if not any(started[node].poll() is None for node in nodes):
            return
        time.sleep(0.02)


def row(run: Run) -> str:
    cuts = ", ".join(f"{node} at {at:.1f} for {for_s:g}" for at, node, for_s in run.cuts)
    wrong = {node: status for node, status in run.exits.items() if status}
    words = [
        f"{run.number:3} {'good' if run.good else 'BAD '} {run.wall_s:5.1f} s",
        "map equal" if run.equal else "MAP DIFFERS",
        f"cut {cuts or 'nobody'}",
        *([f"exits {wrong}"] if wrong else []),
        *([f"log lacks {', '.join(run.lacks)}"] if run.lacks else []),
        *([f"check: {run.check.splitlines()[0][:120]}"] if run.check else []),
    ]
    return "; ".join(words)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--cuts", type=int, default=5, help="in each run")
    parser.add_argument("--longest", type=float, default=12.0, help="seconds of the longest cut")
    parser.add_argument("--span", type=float, default=12.0, help="seconds in which they begin")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--speed", default="4")
    parser.add_argument("--seed", default="1")
    parser.add_argument("--timeout", type=float, default=300.0)
    parser.add_argument("--keep", help="keep the folders of runs that went wrong here")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        scenario = shortened(Path(place), options.steps)
        resolved = load(scenario)
        expected = expected_of(resolved)
        robots = [robot.id for robot in resolved.robots]
        runs = []
        if options.json and options.json.exists():
            runs = [Run(**row) for row in json.loads(options.json.read_text())]
        for number in sorted(set(range(options.runs)) - {run.number for run in runs}):
            runs.append(one(number, scenario, robots, expected, options))
            print(row(runs[-1]), flush=True)
            if options.json:
                options.json.write_text(json.dumps([asdict(run) for run in runs]))
    good, cuts = sum(run.good for run in runs), sum(len(run.cuts) for run in runs)
    print(
        f"{good} of {len(runs)} runs good, {cuts} links cut; map equal in "
        f"{sum(r.equal for r in runs)}, log whole in {sum(not r.lacks for r in runs)}; "
        f"load {os.getloadavg()[0]:.1f}"
    )
    return 0 if good == len(runs) else 1


if __name__ == "__main__":
    sys.exit(main())
