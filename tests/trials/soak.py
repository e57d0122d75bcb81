"""Memory, descriptors and threads of each process over a long run.

    python -m tests.trials.soak [--scenario random-3] [--minutes 60] [--speed 100] [--fusion join]
                              [--json FILE]

Launches the team as real processes on a simulated world that is long enough for the given wall
time at the given multiple of real time, and looks at each process every few seconds. The table has
what each grew by between a quarter of the run and its end, per hour of wall time; the centre's
growth under `join` is known (it keeps every submap). The run is ended when the time is over, and
how far the team came is printed: a machine that is too slow does not keep the pace.
Exit status 1 if a process died, or if one other than the centre has more descriptors or threads at
the end than at a quarter of the run.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from mcap.reader import make_reader
from rich.console import Console
from rich.table import Table

from teamslam.sim.scenarios.scenario import dumps, load, with_options

EVERY_S = 5.0
"""Wall time between two looks."""
SETTLED = 0.25
"""The share of the run after which growth counts."""


@dataclass
class Process:
    """One process of the team: wall time [s], resident memory [MB], descriptors, threads."""

    name: str
    looks: list[tuple[float, float, int, int]] = field(default_factory=list)

    def growth(self, until_s: float) -> tuple[float, int, int]:
        """Megabytes per hour of wall time, descriptors and threads since the run has settled."""
        late = [look for look in self.looks if look[0] >= SETTLED * until_s]
        if len(late) < 2:
            return 0.0, 0, 0
        hours = (late[-1][0] - late[0][0]) / 3600.0
        return (
            (late[-1][1] - late[0][1]) / hours,
            late[-1][2] - late[0][2],
            late[-1][3] - late[0][3],
        )


def children(parent: int) -> dict[int, str]:
    """The living children of a process with the subcommand that each runs, by process id."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            ppid = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            words = (entry / "cmdline").read_text().split("\0")
        except (OSError, IndexError):
            continue
        if ppid == parent and "teamslam" in words:
            told = words[words.index("teamslam") + 1 :]
            found[int(entry.name)] = f"robot {told[-2]}" if told[0] == "robot" else told[0]
    return found


def look(pid: int) -> tuple[float, int, int] | None:
    """Resident memory [MB], descriptors and threads; None if the process has gone."""
    place = Path(f"/proc/{pid}")
    try:
        resident = int((place / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        descriptors = len(list((place / "fd").iterdir()))
        return resident / 1e6, descriptors, len(list((place / "task").iterdir()))
    except OSError:
        return None


def watched(launch: subprocess.Popen[bytes], seconds: float) -> dict[int, Process]:
    """The processes of a launch, looked at until the time is over or the launch has ended."""
    found: dict[int, Process] = {}
    began = time.monotonic()
    while (now := time.monotonic() - began) < seconds and launch.poll() is None:
        for pid, name in {launch.pid: "launch", **children(launch.pid)}.items():
            seen = look(pid)
            if seen is not None:
                found.setdefault(pid, Process(name)).looks.append((now, *seen))
        time.sleep(EVERY_S)
    return found


def team_time(log: Path) -> float:
    """The team time [s] of a log's last message."""
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    return summary.statistics.message_end_time / 1e9


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenario", default="random-3")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--speed", type=float, default=100.0)
    parser.add_argument("--fusion")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    seconds = 60.0 * told.minutes
    scenario = load(told.scenario)
    if told.fusion:
        scenario = with_options(scenario, fusion=told.fusion)
    world = scenario.world
    steps = int(1.2 * seconds * told.speed) + 1000  # never the end before the time is over
    scenario = msgspec.structs.replace(scenario, world=msgspec.structs.replace(world, steps=steps))
    with tempfile.TemporaryDirectory() as place:
        file, run = Path(place) / "soak.json", Path(place) / "run"
        file.write_text(dumps(scenario))
        words = ["launch", str(file), "--speed", str(told.speed), "-o", str(run)]
        command = [sys.executable, "-P", "-m", "teamslam", *words]
        with (Path(place) / "output").open("wb") as output:
            launch = subprocess.Popen(command, stdout=output, stderr=output)  # our own program
            found = watched(launch, seconds)
            died = launch.poll() is not None
            launch.send_signal(signal.SIGTERM)  # SIGINT is ignored by what a shell's & has started
            try:
                launch.wait(60.0)
            except subprocess.TimeoutExpired:
                sys.stderr.write("launch had not ended 60 s after SIGTERM: killed\n")
                launch.kill()
                launch.wait()
        if died:
            sys.stderr.write((Path(place) / "output").read_text("utf-8", "replace")[-2000:])
        reached = team_time(run / "log.mcap")
        log = sum(each.stat().st_size for each in run.glob("*.mcap")) / 1e6
    print(f"team time {reached:.0f} s: {reached / seconds:.0f} times real time")
    return report(found, seconds, died, log, told)


def report(
    found: dict[int, Process], seconds: float, died: bool, log: float, told: argparse.Namespace
) -> int:
    """The table, the JSON if it is asked for, and the exit status."""
    table = Table("process", "MB at first", "MB at the end", "MB/h", "descriptors", "threads")
    rows, leaks = {}, False
    for process in sorted(found.values(), key=lambda p: p.name):
        growth, descriptors, threads = process.growth(seconds)
        first, last = process.looks[0], process.looks[-1]
        leaks |= process.name != "central" and (descriptors > 0 or threads > 0)
        table.add_row(
            process.name,
            f"{first[1]:.0f}",
            f"{last[1]:.0f}",
            f"{growth:+.1f}",
            f"{last[2]} ({descriptors:+d})",
            f"{last[3]} ({threads:+d})",
        )
        rows[process.name] = {
            "first_mb": first[1],
            "last_mb": last[1],
            "mb_per_hour": growth,
            "descriptors": last[2],
            "descriptors_grown": descriptors,
            "threads": last[3],
            "threads_grown": threads,
        }
    Console().print(table)
    print(f"{told.minutes:g} min at {told.speed:g} x, log {log:.0f} MB")
    if told.json:
        what = {"minutes": told.minutes, "speed": told.speed, "log_mb": log, "processes": rows}
        told.json.write_text(json.dumps(what, indent=1) + "\n")
    return int(died or leaks)


if __name__ == "__main__":
    sys.exit(main())
