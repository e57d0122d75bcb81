"""Whole teams under `launch` whose processes are killed, or stopped for a while, at random.

    python -m tests.trials.kills --acceptance --runs 20
    python -m tests.trials.kills --runs 20 --kills 3 --load 4
    python -m tests.trials.kills --runs 10 --stop 20 --what central,router
    python -m tests.trials.kills --runs 6 --kills 1 --stop inf --end-silent 12
    python -m tests.trials.kills --runs 10 --keys --verify
    python -m tests.trials.kills --runs 10 --without-centre --what robot,router,world

--acceptance: with keys, each run with three kills and one stop of 12 s, of any process, beside two
busy loops. Each run is a short world. A process stopped for ever stays so until `launch
--end-silent` ends it. The final map (--without-centre every robot's) is compared byte by byte with
that of an undisturbed team in memory, the log with the streams' last counts; --verify recomputes
each log. --json FILE stores each run; only missing runs are made. Ends with 1 unless every run
ended with 0, with this map, left no process, and no hole in its log that `teamslam log check`
misses. Processes that ended by themselves with an error, as for silence, are counted too.
"""

import argparse
import hashlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.roster import nodes_of
from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import opened
from teamslam.team.wire.channels import FINAL_MAP
from teamslam.team.wire.codec import WireError

PROGRAM = (sys.executable, "-P", "-m", "teamslam")
PROC = Path("/proc")
STOP_S = 12.0  # how long [s] a process is stopped, in the acceptance
GAVE_UP = re.compile(r"(\S+) \(pid \d+\) ended with exit status \d+")
"""A process that ended by itself with an error, in the words of `launch`."""


@dataclass
class Run:
    """The part that all trials with processes judge.

    lacks: what the log lacks. check: the complaint of `teamslam log check`.
    """

    number: int
    wall_s: float = 0.0
    equal: bool = False
    check: str = ""
    lacks: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether the run equals an undisturbed one."""
        return self.equal and not (self.lacks and not self.check)

    def words(self, *more: str) -> str:
        """Describe the run in a line; more: what only this trial has."""
        words = [
            f"{self.number:3} {'good' if self.good else 'BAD '} {self.wall_s:5.1f} s",
            "map equal" if self.equal else "MAP DIFFERS",
            *(each for each in more if each),
            *([f"log lacks {', '.join(self.lacks)}"] if self.lacks else []),
            *([f"check: {self.check.splitlines()[0][:120]}"] if self.check else []),
        ]
        return "; ".join(words)


@dataclass
class Kills(Run):
    hit: list[tuple[float, str]] = field(default_factory=list)
    exit: int | None = None
    left: int = 0
    gave_up: list[str] = field(default_factory=list)
    verified: bool | None = None
    restarts: dict[str, int] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether the run equals an undisturbed one."""
        ended = self.exit == 0 and not self.left and not self.gave_up
        return super().good and ended and self.verified is not False

    def __str__(self) -> str:
        what = ", ".join(f"{who} at {at:.1f}" for at, who in self.hit)
        return self.words(
            f"exit {'–' if self.exit is None else self.exit}",
            f"hit {what or 'nobody'}",
            f"{self.left} LEFT" if self.left else "",
            f"GAVE UP: {', '.join(self.gave_up)}" if self.gave_up else "",
            "NOT VERIFIED" if self.verified is False else "",
            f"failures: {self.failures[0][:160]!r}" if self.failures else "",
        )


def children(launch: int, folder: Path) -> dict[int, list[str]]:
    found = {}
    for entry in PROC.iterdir():
        if entry.name.isdigit() and int(entry.name) != launch:
            with suppress(OSError):
                if (entry / "cwd").readlink() == folder:
                    line = (entry / "cmdline").read_bytes().decode().rstrip("\0").split("\0")
                    if "teamslam" in line:
                        found[int(entry.name)] = line[line.index("teamslam") + 1 :]
    return found


def complaint(folder: Path) -> str:
    """Complaint of `teamslam log check` about the log; empty: none."""
    checked = subprocess.run(
        [*PROGRAM, "log", "check", "run/log.mcap"],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return "" if checked.returncode == 0 else (checked.stdout + checked.stderr).strip()


def lacking(folder: Path) -> list[str]:
    """Measurements and submaps that the log lacks, by their streams' last counts."""
    counted: dict[tuple[str, str, int], set[int]] = {}
    said: dict[tuple[str, str, int], int] = {}
    try:
        for sample in open_log(folder / "run" / "log.mcap").samples():
            with suppress(WireError):
                message = opened(sample)[2]
                match message:
                    case m.Measurement():
                        stream = ("measurements", message.robot, message.incarnation)
                        counted.setdefault(stream, set()).add(message.number)
                    case m.Submap():
                        stream = ("submaps", message.robot, message.incarnation)
                        counted.setdefault(stream, set()).add(message.sequence)
                    case m.End():
                        said |= {
                            ("measurements", s.robot, s.incarnation): s.measurements
                            for s in message.streams
                        }
                    case m.Done():
                        said["submaps", message.robot, message.incarnation] = message.submaps
    except (LogError, OSError) as error:
        return [str(error)]
    gaps = {k: n - len(counted.get(k, set()) & set(range(n))) for k, n in said.items()}
    none = [] if said else ["the log has no end"]
    return none + [f"{n} {what} of {robot}" for (what, robot, _), n in gaps.items() if n]


def final_in(folder: Path) -> bytes | None:
    for path in sorted((folder / "run").glob("log*.mcap")):
        with suppress(LogError, OSError):
            for sample in open_log(path).samples((FINAL_MAP,)):
                return sample.payload
    return None


def shortened(folder: Path, steps: int) -> Path:
    scenario = folder / "short.toml"
    scenario.write_text(f'base = "thesis"\n[world]\nsteps = {steps}\n')
    return scenario


def expected_of(scenario: Scenario) -> bytes:
    samples = run_team(scenario, streams_of(scenario))
    (expected,) = [s.payload for s in samples if s.key == FINAL_MAP.key()]
    return expected


def await_text(path: Path, text: str, patience_s: float = 120.0) -> str:
    end = time.monotonic() + patience_s
    while not (path.exists() and text in path.read_text("utf-8", "replace")):
        if time.monotonic() > end:
            raise RuntimeError(f"{path}: not within {patience_s:g} s: {text}")
        time.sleep(0.05)
    return path.read_text("utf-8", "replace").partition(text)[2]


def one(number: int, scenario: Path, expected: bytes, options: argparse.Namespace) -> Kills:
    rng = random.Random(f"{options.seed} {number}")
    run = Kills(number)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        more = ["--keys", str(options.keys_made)] if options.keys else []
        more += ["--without-centre"] if options.without_centre else []
        more += ["--identities", options.identities] if options.identities else []
        if options.end_silent:
            more += ["--end-silent", str(options.end_silent)]
        began = time.monotonic()
        with (folder / "said").open("wb") as said:
            launch = subprocess.Popen(
                [*PROGRAM, "launch", scenario, "--speed", options.speed, "--no-report",
                 "--output", "run", "--json", "result.json", *more],
                cwd=folder, stdout=said, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            )  # fmt: skip
        await_start(folder, launch, "robot-r1" if options.without_centre else "central")
        awake: list[tuple[float, int]] = []
        now = time.monotonic()
        due = [(now + rng.uniform(0.0, options.span), options.stop) for _ in range(options.kills)]
        due += [(now + rng.uniform(0.0, options.span), STOP_S) for _ in range(options.stops)]
        due.sort()
        while launch.poll() is None and time.monotonic() - began < options.timeout:
            now = time.monotonic()
            while due and now >= due[0][0]:
                _, stop_s = due.pop(0)
                hit(launch.pid, folder, rng, options.what, stop_s, run, awake, at_s=now - began)
            for at, pid in [a for a in awake if now >= a[0]]:
                awake.remove((at, pid))
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)
            time.sleep(0.02)
        run.exit = launch.poll()
        if run.exit is None:
            launch.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                launch.wait(30.0)
        time.sleep(0.2)
        left = children(launch.pid, folder)
        run.left = len(left)
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if launch.poll() is None:
            launch.kill()
            launch.wait()
        run.wall_s = time.monotonic() - began
        run.gave_up = GAVE_UP.findall((folder / "said").read_text("utf-8", "replace"))
        result = {}
        with suppress(OSError, ValueError):
            result = json.loads((folder / "result.json").read_text())
            run.restarts, run.failures = result["restarts"], result["failures"]
        if options.without_centre:
            finals = {peer["final_map_sha256"] for peer in result.get("peers", {}).values()}
            run.equal = finals == {hashlib.sha256(expected).hexdigest()}
        else:
            run.equal = final_in(folder) == expected
        run.check, run.lacks = complaint(folder), lacking(folder)
        if options.verify:
            again = subprocess.run(
                [*PROGRAM, "rerun", "run/log.mcap", "--verify"],
                cwd=folder, capture_output=True, text=True, check=False,
            )  # fmt: skip
            run.verified = again.returncode == 0
            (folder / "verified").write_text(again.stdout + again.stderr)
        if not run.good and options.keep:
            keep = Path(options.keep) / f"run{number}"
            keep.parent.mkdir(parents=True, exist_ok=True)
            subprocess.run(["cp", "-r", folder, keep], check=False)
    return run


def await_start(folder: Path, launch: subprocess.Popen[bytes], node: str) -> None:
    end = time.monotonic() + 120.0
    said = folder / "run" / f"{node}.log"
    while time.monotonic() < end and launch.poll() is None:
        if said.exists() and "connected" in said.read_text():
            return
        time.sleep(0.05)


def hit(
    launch: int, folder: Path, rng: random.Random, what: list[str], stop_s: float, run: Kills,
    awake: list[tuple[float, int]], at_s: float,
) -> None:  # fmt: skip
    stopped = {pid for _, pid in awake}
    lines = children(launch, folder).items()
    there = {p: li for p, li in lines if li[0] in what and p not in stopped}
    kinds = sorted({line[0] for line in there.values()})
    if not kinds:
        return
    kind = rng.choice(kinds)
    pid = rng.choice(sorted(pid for pid, line in there.items() if line[0] == kind))
    with suppress(ProcessLookupError):
        if stop_s:
            os.kill(pid, signal.SIGSTOP)
            awake.append((time.monotonic() + stop_s, pid))  # at infinity: never
        else:
            os.kill(pid, signal.SIGKILL)
        robots = [word for word in there[pid] if word in ("r1", "r2", "r3")]
        named = "-".join([kind, *robots])
        run.hit.append((round(at_s, 2), f"{named} for {stop_s:g} s" if stop_s else named))


R = TypeVar("R", bound=Run)


def play_missing(kind: type[R], options: argparse.Namespace, play: Callable[[int], R]) -> list[R]:
    """Return the stored runs of `options.json` and the missing ones, each stored and shown."""
    path, runs = options.json, list[R]()
    if path is not None and path.exists():
        names = kind.__dataclass_fields__
        runs = [kind(**{name: row[name] for name in names}) for row in json.loads(path.read_text())]
    for number in sorted(set(range(options.runs)) - {run.number for run in runs}):
        runs.append(play(number))
        print(runs[-1], flush=True)
        if path is not None:
            path.write_text(json.dumps([asdict(run) | {"good": run.good} for run in runs]))
    return runs


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--kills", type=int, default=3, help="in each run")
    parser.add_argument("--span", type=float, default=10.0, help="seconds in which they fall")
    parser.add_argument("--stop", type=float, default=0.0, help="stop for so long, do not kill")
    parser.add_argument("--stops", type=int, default=0, help=f"stop so many for {STOP_S:g} s, too")
    parser.add_argument("--acceptance", action="store_true", help="the trial that has to be passed")
    parser.add_argument("--end-silent", type=float, help="launch ends who is silent so long [s]")
    parser.add_argument("--keys", action="store_true", help="behind certificates")
    parser.add_argument("--verify", action="store_true", help="compute each log again")
    parser.add_argument("--without-centre", action="store_true", help="every robot is a peer")
    parser.add_argument("--identities", choices=["hidden"], help="landmarks have no names")
    parser.add_argument("--what", default="robot,central,router,record,world,viewer")
    parser.add_argument("--load", type=int, default=0, help="busy loops beside the team")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--speed", default="6")
    parser.add_argument("--seed", default="1")
    parser.add_argument("--timeout", type=float, default=240.0)
    parser.add_argument("--keep", help="keep the folders of runs that went wrong here")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    options.what = options.what.split(",")
    if options.acceptance:
        options.keys, options.kills, options.stops = True, 3, 1
        options.load = max(options.load, 2)
    with tempfile.TemporaryDirectory() as name:
        scenario = shortened(Path(name), options.steps)
        resolved = with_options(load(scenario), identities=options.identities)
        options.keys_made = Path(name) / "keys"
        if options.keys:
            make_keys(options.keys_made, resolved.team, nodes_of([r.id for r in resolved.robots]))
        expected = expected_of(resolved)
        busy = [
            subprocess.Popen([sys.executable, "-c", "while True: pass"])
            for _ in range(options.load)
        ]
        try:
            runs = play_missing(Kills, options, lambda n: one(n, scenario, expected, options))
        finally:
            for process in busy:
                process.kill()
                process.wait()
    good = sum(run.good for run in runs)
    hits = sum(len(run.hit) for run in runs)
    stopped = sum(" for " in named for run in runs for _, named in run.hit)
    print(
        f"{good} of {len(runs)} runs good, {hits - stopped} processes killed, {stopped} stopped, "
        f"{sum(len(run.gave_up) for run in runs)} ended by themselves with an error; "
        f"map equal in {sum(r.equal for r in runs)}, exit 0 in {sum(r.exit == 0 for r in runs)}, "
        f"no process left in {sum(not r.left for r in runs)}, "
        f"log whole in {sum(not r.lacks for r in runs)}, with an unnamed hole in "
        f"{sum(bool(r.lacks) and not r.check for r in runs)}, "
        f"verified {sum(r.verified is True for r in runs)}; load {os.getloadavg()[0]:.0f}"
    )
    return 0 if good == len(runs) else 1


if __name__ == "__main__":
    sys.exit(main())
