"""Robots that keep their own logs, without recorder and centre: what each log proves.

`python -m tests.trials.own_logs [--scenario waypoints] [--reach 12] [--deaths 2] [--keep FOLDER]`:
router, world and robots with a set on disk and a log of their own, started by hand; robots reach
each other within --reach metres, and some are killed on the way and started again. Then every log
is computed again alone (`teamslam rerun --verify`), all are merged, the merged log is computed
again, and its ledger is checked. Ends with 1 unless all of this holds, and every final map has the
bytes of a run with a centre to which nothing happens.
"""

import argparse
import hashlib
import json
import random
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from teamslam.sim.scenarios.scenario import load
from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import decoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests.trials.agreement_processes import Watch
from tests.trials.kills import PROGRAM, await_text, expected_of


def judged(folder: Path, *words: str) -> tuple[bool, str]:
    """Whether a command of ours ends with 0, and its last line."""
    done = subprocess.run(
        [*PROGRAM, *words], cwd=folder, capture_output=True, text=True, check=False
    )
    said = (done.stdout + done.stderr).strip().splitlines()
    return done.returncode == 0, said[-1] if said else ""


def conclusion_in(log: Path, robot: str) -> str | None:
    """The final map's SHA-256 by a robot's last word in its log."""
    found = None
    with suppress(LogError):
        for sample in open_log(log).samples((ch.CONCLUDED,)):
            said = decoded(sample.payload, m.Concluded)
            if said.robot == robot:
                found = said.sha256.hex()
    return found


def team_of(folder: Path, options: argparse.Namespace) -> tuple[list[str], int, dict[str, int]]:
    """Run the team; its robots, how many of them were killed, and exit states by process."""
    path = folder / "field.toml"
    path.write_text(
        f'base = "{options.scenario}"\ncentre = false\n'
        f"[world]\nsteps = {options.steps}\n[radio]\ncomm_range_m = {options.reach}\n"
    )
    scenario = load(path)
    robots = [each.id for each in scenario.robots]
    started: dict[str, subprocess.Popen[bytes]] = {}

    def start(name: str, *words: str) -> None:
        with (folder / f"{name}.txt").open("ab") as out:
            started[name] = subprocess.Popen(
                [*PROGRAM, *words], cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=out
            )

    start("router", "router", "--listen", "tcp/127.0.0.1:0")
    endpoint = await_text(folder / "router.txt", "listening at ").split()[0]
    there = ["--connect", endpoint]

    def robot(name: str) -> None:
        own = ["--peers", "--set", f"{name}.set", "--log", f"{name}.mcap"]
        start(name, "robot", "field.toml", name, *own, *there)

    try:
        for name in robots:
            robot(name)
        start("world", "world", "field.toml", "--no-recorder", "--speed", options.speed, *there)
        rng = random.Random(options.seed)
        due = sorted(rng.random() for _ in range(options.deaths))
        deaths, end = 0, time.monotonic() + options.timeout
        with ZenohBus(scenario.team, endpoint) as bus:
            bus.subscribe(ch.STATUS)
            watch = Watch(folder, started["world"].pid, bus)
            while any(started[name].poll() is None for name in robots):
                if time.monotonic() > end:
                    break
                if due and watch.look() >= due[0]:
                    due.pop(0)
                    name = rng.choice(robots)
                    started[name].kill()
                    started[name].wait()
                    robot(name)
                    deaths += 1
                time.sleep(0.05)
    finally:
        exits = {name: each.poll() for name, each in started.items() if name != "router"}
        for each in started.values():
            each.kill() if each.poll() is None else None
            each.wait()
    return robots, deaths, {name: 99 if code is None else code for name, code in exits.items()}


def measured(folder: Path, options: argparse.Namespace) -> dict[str, object]:
    """One run and what its logs prove."""
    robots, deaths, exits = team_of(folder, options)
    expected = hashlib.sha256(expected_of(load(folder / "field.toml"))).hexdigest()
    logs = [f"{name}.mcap" for name in robots]
    proofs = {log: judged(folder, "rerun", log, "--verify") for log in logs}
    proofs["merge"] = judged(folder, "log", "merge", *logs, "--output", "team.mcap")
    proofs["merged"] = judged(folder, "rerun", "team.mcap", "--verify")
    proofs["ledger"] = judged(folder, "verify-ledger", "team.mcap")
    return {
        "robots": robots,
        "deaths": deaths,
        "exits": exits,
        "equal": {
            name: conclusion_in(folder / f"{name}.mcap", name) == expected for name in robots
        },
        "proofs": proofs,
    }


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenario", default="waypoints")
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--reach", type=float, default=12.0)
    parser.add_argument("--deaths", type=int, default=2)
    parser.add_argument("--speed", default="8")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--timeout", type=float, default=250.0)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = (options.keep or Path(made)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        row = measured(folder, options)
    print(json.dumps(row, indent=1))
    good = all(row["equal"].values()) and not any(row["exits"].values())
    return 0 if good and all(holds for holds, _ in row["proofs"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
