"""Two robots' drivers at real-time pace: processes killed, links cut, and the final map.

    python -m tests.trials.drivers [--runs 1] [--seconds 60] [--kills 5] [--cuts 5] [--json FILE]

Needs root and `ip` (Linux). Each process (router, recorder, centre, each robot's, each robot's
driver, which is examples/robot.py on the tables of examples/own_data.py) has a network namespace of
its own; those of a robot and of its driver are killed at random and started again as they were, and
links are cut, for less or for more than the lease of a connection. The final map must be, byte for
byte, that of the same tables run as a data set, in memory. Ends with 1 unless every run's is, every
process ended with 0, and the log lacks nothing that `teamslam log check` does not name.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.team.recording.check import holes
from teamslam.team.recording.reader import open_log
from tests.namespaces import NET, ip, network
from tests.trials.cuts import ONE_THREAD, PORT
from tests.trials.kills import PROGRAM, await_text, expected_of, final_in

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ROBOTS = ("r1", "r2")
STEP_S = 0.1
CUTS_S = (0.3, 1.0, 3.0, 12.0)
TEAM = """
base = "recorded"
name = "lab"
robot_count = 2

[world]
kind = "live"
"""


@dataclass
class Run:
    """The result of one run; at [s after the start of the drivers], who, for how long [s]."""

    number: int
    kills: list[tuple[float, str]] = field(default_factory=list)
    cuts: list[tuple[float, str, float]] = field(default_factory=list)
    exits: dict[str, int | None] = field(default_factory=dict)
    wall_s: float = 0.0
    equal: bool = False
    holes: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """As if nothing had happened; of who was killed the last words may be missing."""
        return self.equal and not self.holes and not any(self.exits.values())


def tables(folder: Path, seconds: float) -> None:
    """Both robots' tables up to a time."""
    subprocess.run([sys.executable, EXAMPLES / "own_data.py", folder / "data"], check=True)
    for table in folder.glob("data/*/o*.csv"):
        header, *rows = table.read_text().splitlines()
        kept = [row for row in rows if float(row.partition(",")[0]) <= seconds]
        table.write_text("\n".join([header, *kept]) + "\n")
    (folder / "lab.toml").write_text(TEAM)


def commands(folder: Path, pace: float) -> dict[str, list[str]]:
    """The processes in each namespace."""
    router = f"tcp/{NET}.1:{PORT}"
    there, lab = ["--connect", router], str(folder / "lab.toml")
    found = {
        "recorder": [*PROGRAM, "record", lab, "--output", "run/log.mcap", *there],
        "central": [*PROGRAM, "central", lab, *there],
    }
    for robot in ROBOTS:
        example = [sys.executable, str(EXAMPLES / "robot.py"), robot, str(folder / "data" / robot)]
        found[robot] = [*PROGRAM, "robot", lab, robot, *there]
        found[f"driver-{robot}"] = [*example, "lab", router, str(pace)]
    return found


class Processes:
    """The processes of a run, each in its namespace."""

    def __init__(self, folder: Path, names: dict[str, str], told: dict[str, list[str]]) -> None:
        self._folder, self._names, self._told = folder, names, told
        self.started: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, node: str) -> None:
        """Start it, or start it again."""
        with (self._folder / "run" / f"{node}.log").open("ab") as said:
            self.started[node] = subprocess.Popen(
                ["ip", "netns", "exec", self._names[node], *self._told[node]],
                cwd=self._folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                env={**os.environ, **ONE_THREAD},
            )  # fmt: skip

    def kill(self, node: str) -> None:
        """`ip netns exec` has become the process itself."""
        self.started[node].send_signal(signal.SIGKILL)
        self.started[node].wait()

    def stop(self) -> dict[str, int | None]:
        """End what is left; how each had ended by itself."""
        found = {node: process.poll() for node, process in self.started.items()}
        for node, process in self.started.items():
            if process.poll() is None:
                process.send_signal(signal.SIGTERM if node == "router" else signal.SIGKILL)
            process.wait(20.0)
        found.pop("router", None)
        return {node: 99 if status is None else status for node, status in found.items()}


def disturb(run: Run, hub: str, team: Processes, options: argparse.Namespace) -> None:
    """Kill and cut at random moments; return when all have ended or time is over."""
    rng = random.Random(f"{options.seed} {run.number}")
    moments = [(rng.uniform(0.0, options.seconds), "kill") for _ in range(options.kills)]
    moments += [(rng.uniform(0.0, options.seconds), "cut") for _ in range(options.cuts)]
    moments.sort()
    mortal = [*ROBOTS, *(f"driver-{robot}" for robot in ROBOTS)]
    nodes = [node for node in team.started if node != "router"]
    mends: list[tuple[float, str]] = []
    began = time.monotonic()
    while (at := time.monotonic() - began) < options.timeout:
        if moments and at >= moments[0][0]:
            _, what = moments.pop(0)
            alive = [node for node in mortal if team.started[node].poll() is None]
            if what == "kill" and alive:
                node = rng.choice(alive)
                team.kill(node)
                team.start(node)
                run.kills.append((round(at, 1), node))
            whole = [node for node in nodes if node not in {cut for _, cut in mends}]
            if what == "cut" and whole:
                node, for_s = rng.choice(whole), rng.choice(CUTS_S)
                ip("-n", hub, "link", "set", link_of(node), "down")
                mends.append((at + for_s, node))
                run.cuts.append((round(at, 1), node, for_s))
        for until, node in [mend for mend in mends if at >= mend[0]]:
            mends.remove((until, node))
            ip("-n", hub, "link", "set", link_of(node), "up")
        if not any(team.started[node].poll() is None for node in nodes):
            return
        time.sleep(0.02)


def link_of(node: str) -> str:
    """The name of a process's link at the bridge: 15 letters at most."""
    return node.replace("driver", "d")


def one(number: int, expected: bytes, folder: Path, options: argparse.Namespace) -> Run:
    """A team from its first measurement to its final map."""
    run = Run(number)
    told = commands(folder, STEP_S)
    (folder / "run").mkdir()
    links = {link_of(node): node for node in told}
    with network(list(links)) as named:
        names = {links.get(link, link): name for link, name in named.items()}
        router = [*PROGRAM, "router", "--listen", f"tcp/{NET}.1:{PORT}", "--insecure"]
        team = Processes(folder, names, {**told, "router": router})
        try:
            team.start("router")
            await_text(folder / "run" / "router.log", "listening at")
            for node in told:
                if not node.startswith("driver"):
                    team.start(node)
            for robot in ROBOTS:
                await_text(folder / "run" / f"{robot}.log", "connected")
                team.start(f"driver-{robot}")
            began = time.monotonic()
            disturb(run, names["router"], team, options)
            run.wall_s = time.monotonic() - began
        finally:
            run.exits = team.stop()
    run.equal = final_in(folder) == expected
    killed = {f"source/{node[7:]}/tally" if "-" in node else f"robot/{node}/tally"
              for _, node in run.kills}  # fmt: skip
    log = open_log(folder / "run" / "log.mcap")
    run.holes = [str(hole) for hole in holes(log) if hole.where not in killed]
    return run


def row(run: Run) -> str:
    """One line of the table."""
    wrong = {node: status for node, status in run.exits.items() if status}
    words = [
        f"{run.number:3} {'good' if run.good else 'BAD '} {run.wall_s:6.1f} s",
        "map equal" if run.equal else "MAP DIFFERS",
        f"killed {', '.join(f'{node} at {at}' for at, node in run.kills) or 'nobody'}",
        f"cut {', '.join(f'{n} at {at} for {s:g}' for at, n, s in run.cuts) or 'nobody'}",
        *([f"exits {wrong}"] if wrong else []),
        *run.holes,
    ]
    return "; ".join(words)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0, help="of data, and of its drive")
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--cuts", type=int, default=5)
    parser.add_argument("--seed", default="1")
    parser.add_argument("--timeout", type=float, default=600.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="keep the first run's folder here")
    options = parser.parse_args()
    runs = []
    with tempfile.TemporaryDirectory() as place:
        for number in range(options.runs):
            folder = Path(place).resolve() / str(number)
            if options.keep and not number:
                folder = options.keep.resolve()
            folder.mkdir(parents=True)
            tables(folder, options.seconds)
            scenario = with_options(load(folder / "lab.toml"), dataset=folder / "data")
            runs.append(one(number, expected_of(scenario), folder, options))
            print(row(runs[-1]), flush=True)
    good = sum(run.good for run in runs)
    kills, cuts = (sum(len(getattr(run, what)) for run in runs) for what in ("kills", "cuts"))
    print(
        f"{good} of {len(runs)} runs good; {kills} processes killed, {cuts} links cut; map equal "
        f"in {sum(run.equal for run in runs)}; load {os.getloadavg()[0]:.1f}"
    )
    if options.json:
        options.json.write_text(json.dumps([asdict(run) | {"good": run.good} for run in runs]))
    return 0 if good == len(runs) else 1


if __name__ == "__main__":
    sys.exit(main())
