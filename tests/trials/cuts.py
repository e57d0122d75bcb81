"""Whole teams whose links are cut at random: each process in a network namespace of its own.

    python -m tests.trials.cuts --runs 10 --cuts 5 [--longest 12] [--json FILE]

Needs root and `ip` (Linux). A cut takes one process's link down, for less or more than a
connection's lease. The final map of each short run is compared with that of the same team in
memory, byte by byte, its log with the streams' last counts. Ends with 1 unless every process ended
with 0, with this map, and without a hole that `teamslam log check` misses.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from teamslam.sim.scenarios.scenario import load
from tests.namespaces import NET, ip, network
from tests.trials.kills import (
    PROGRAM,
    Run,
    await_text,
    complaint,
    expected_of,
    final_in,
    lacking,
    play_missing,
    shortened,
)

PORT = 7447
ROUTER = f"tcp/{NET}.1:{PORT}"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
Commands = Mapping[str, Sequence[str]]


@dataclass
class Cuts(Run):
    cuts: list[tuple[float, str, float]] = field(default_factory=list)
    exits: dict[str, int] = field(default_factory=dict)

    @property
    def good(self) -> bool:
        """Whether the run equals an undisturbed one."""
        return super().good and not any(self.exits.values())

    def __str__(self) -> str:
        cuts = ", ".join(f"{node} at {at:.1f} for {for_s:g}" for at, node, for_s in self.cuts)
        wrong = {node: status for node, status in self.exits.items() if status}
        return self.words(f"cut {cuts or 'nobody'}", f"exits {wrong}" if wrong else "")


class Team:
    """Processes of a run, each in its namespace; command and link by node.

    A driver starts when its robot is connected.
    """

    def __init__(self, folder: Path, told: Commands, names: Mapping[str, str]) -> None:
        self.folder, self.names = folder, names
        router = [*PROGRAM, "router", "--listen", ROUTER, "--insecure"]
        self.told = {"router": router, **told}
        self.started: dict[str, subprocess.Popen[bytes]] = {}

    def begin(self) -> None:
        self.start("router")
        await_text(self.folder / "run" / "router.log", "listening at")
        drivers = [node for node in self.told if node.startswith("driver-")]
        for node in self.told:
            if node != "router" and node not in drivers:
                self.start(node)
        for robot in (node for node, words in self.told.items() if "robot" in words):
            log = self.folder / "run" / f"{robot}.log"
            while "connected" not in log.read_text("utf-8", "replace"):
                if not self.is_alive(robot):
                    self.start(robot)  # the first connection has a limited patience
                time.sleep(0.2)
        for node in drivers:
            self.start(node)

    def start(self, node: str) -> None:
        with (self.folder / "run" / f"{node}.log").open("ab") as said:
            self.started[node] = subprocess.Popen(
                ["ip", "netns", "exec", self.names[link_of(node)], *self.told[node]],
                cwd=self.folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                env={**os.environ, **ONE_THREAD},
            )  # fmt: skip

    def is_alive(self, node: str) -> bool:
        return self.started[node].poll() is None

    def stop(self) -> dict[str, int]:
        found = {node: process.poll() for node, process in self.started.items()}
        for node, process in self.started.items():
            if process.poll() is None:
                process.send_signal(signal.SIGTERM if node == "router" else signal.SIGKILL)
            process.wait(20.0)
        found.pop("router", None)
        return {node: 99 if status is None else status for node, status in found.items()}


def link_of(node: str) -> str:
    return node.replace("driver", "d")


def disturb(run: Cuts, team: Team, options: argparse.Namespace) -> None:
    rng = random.Random(f"{options.seed} {run.number}")
    moments = sorted(rng.uniform(0.0, options.span) for _ in range(options.cuts))
    nodes = [node for node in team.started if node != "router"]
    hub = team.names["router"]
    mends: list[tuple[float, str]] = []
    began = time.monotonic()
    while (at := time.monotonic() - began) < options.timeout:
        if moments and at >= moments[0]:
            moments.pop(0)
            whole = [node for node in nodes if node not in {cut for _, cut in mends}]
            if whole:
                node, for_s = rng.choice(whole), rng.choice([0.3, 1.0, 3.0, options.longest])
                ip("-n", hub, "link", "set", link_of(node), "down")
                mends.append((at + for_s, node))
                run.cuts.append((round(at, 1), node, for_s))
        for until, node in [mend for mend in mends if at >= mend[0]]:
            mends.remove((until, node))
            ip("-n", hub, "link", "set", link_of(node), "up")
        if not any(map(team.is_alive, nodes)):
            return
        time.sleep(0.02)


def play(
    number: int, folder: Path, told: Commands, expected: bytes, options: argparse.Namespace
) -> Cuts:
    run = Cuts(number)
    (folder / "run").mkdir()
    with network([link_of(node) for node in told]) as names:
        team = Team(folder, told, names)
        try:
            team.begin()
            began = time.monotonic()
            disturb(run, team, options)
            run.wall_s = time.monotonic() - began
        finally:
            run.exits = team.stop()
    run.equal = final_in(folder) == expected
    run.check, run.lacks = complaint(folder), lacking(folder)
    if not run.good and options.keep:
        shutil.copytree(folder, Path(options.keep) / f"run{number}", dirs_exist_ok=True)
    return run


def play_all(one: Callable[[int, Path], Cuts], options: argparse.Namespace) -> int:
    def play(number: int) -> Cuts:
        with tempfile.TemporaryDirectory() as place:
            return one(number, Path(place).resolve())

    runs = play_missing(Cuts, options, play)
    good = sum(run.good for run in runs)
    print(
        f"{good} of {len(runs)} runs good, {sum(len(r.cuts) for r in runs)} links cut; map equal "
        f"in {sum(r.equal for r in runs)}, log whole in {sum(not r.lacks for r in runs)}; "
        f"load {os.getloadavg()[0]:.1f}"
    )
    return 0 if good == len(runs) else 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--cuts", type=int, default=5, help="in each run")
    parser.add_argument("--longest", type=float, default=12.0, help="seconds of the longest cut")
    parser.add_argument("--seed", default="1")
    parser.add_argument("--timeout", type=float, default=600.0)
    parser.add_argument("--keep", help="keep the folders of runs that went wrong here")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--span", type=float, default=12.0, help="seconds in which cuts begin")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--speed", default="4")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        what = str(shortened(Path(place), options.steps))
        resolved = load(what)
        expected = expected_of(resolved)
        there = ["--connect", ROUTER]
        told = {
            "recorder": [*PROGRAM, "record", what, "--output", "run/log.mcap", *there],
            "central": [*PROGRAM, "central", what, *there],
            "world": [*PROGRAM, "world", what, "--speed", options.speed, *there],
            **{each.id: [*PROGRAM, "robot", what, each.id, *there] for each in resolved.robots},
        }
        return play_all(lambda number, at: play(number, at, told, expected, options), options)


if __name__ == "__main__":
    sys.exit(main())
