"""Observers that stop reading (SIGSTOP) while they stay connected: what they cost the team.

    python -m tests.trials.slow_subscriber --runs 2 --observers 3 [--keys] [--scenario random-10]

Each run is a `launch`; when the centre has published its first map, the observers, each a session
that subscribes to everything of the team, with --keys by the viewer's certificate, are stopped. The
longest pause is that between two messages of others in the log, by their publishers' clocks. Ends
with 1 unless every run ended with 0, with one and the same map, and without a pause of more than
--most seconds.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

from sim.scenarios.scenario import load
from team.keys.authority import make_keys
from team.keys.roster import nodes_of
from team.recording.reader import open_log
from tests.trials.kills import PROGRAM, await_text

OBSERVER = """
import sys, time
from pathlib import Path
from team.keys.credentials import credentials_of
from team.wire.zenoh.session import client
endpoint, keys = sys.argv[1], sys.argv[2]
session = client(endpoint, 30.0, credentials_of(Path(keys), "viewer") if keys else None)
seen = []
from zenoh.handlers import Callback
callback = Callback(lambda sample: seen.append(sample), indirect=False)
session.declare_subscriber(sys.argv[3] + "**", callback)
print("observing", flush=True)
time.sleep(3600)
"""


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def longest_pause(log: Path, since_ns: int) -> tuple[float, float]:
    """The longest time [s] without any message in the log, and when it began [s after `since`]."""
    walls = sorted(sample.wall_ns for sample in open_log(log).samples())
    walls = [wall for wall in walls if wall >= since_ns]
    gaps = [(later - sooner, sooner) for sooner, later in pairwise(walls)]
    longest, at = max(gaps, default=(0, since_ns))
    return 1e-9 * longest, 1e-9 * (at - since_ns)


def one(number: int, options: argparse.Namespace, keys: Path | None) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place).resolve()
        endpoint = f"{'tls' if keys else 'tcp'}/127.0.0.1:{free_port()}"
        began = time.monotonic()
        with (folder / "said").open("wb") as said:
            launch = subprocess.Popen(
                [*PROGRAM, "launch", options.scenario, "--speed", options.speed, "--no-report",
                 "--output", "run", "--json", "result.json", "--listen", endpoint,
                 *(["--keys", str(keys)] if keys else [])],
                cwd=folder, stdout=said, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            )  # fmt: skip
        observers: list[subprocess.Popen[bytes]] = []
        stopped_ns = time.time_ns()
        try:
            await_text(folder / "run" / "central.log", "connected")
            team = load(options.scenario).team
            for k in range(options.observers):
                with (folder / f"observer{k}").open("wb") as told:
                    observers.append(
                        subprocess.Popen(
                            [
                                sys.executable,
                                "-c",
                                OBSERVER,
                                endpoint,
                                str(keys or ""),
                                f"team/{team}/",
                            ],
                            stdout=told,
                            stderr=told,
                        )
                    )
            for k in range(options.observers):
                await_text(folder / f"observer{k}", "observing")
            time.sleep(options.after)
            stopped_ns = time.time_ns()
            for observer in observers:
                observer.send_signal(signal.SIGSTOP)
            with suppress(subprocess.TimeoutExpired):
                launch.wait(options.timeout)
        finally:
            ended = launch.poll() is not None
            if not ended:
                launch.send_signal(signal.SIGINT)
                with suppress(subprocess.TimeoutExpired):
                    launch.wait(30.0)
                launch.kill()
            for observer in observers:
                observer.kill()
                observer.wait()
        result: dict[str, object] = {}
        with suppress(OSError, ValueError):
            result = json.loads((folder / "result.json").read_text())
        pause_s, at_s = longest_pause(folder / "run" / "log.mcap", stopped_ns)
        if options.keep:
            subprocess.run(["cp", "-r", folder, f"{options.keep}-{number}"], check=False)
        return {
            "run": number, "keys": keys is not None, "exit": launch.returncode if ended else None,
            "wall_s": round(time.monotonic() - began, 1), "longest_pause_s": round(pause_s, 2),
            "at_s": round(at_s, 1), "map": str(result.get("final_map_sha256"))[:12],
            "restarts": result.get("restarts"), "failures": result.get("failures"),
        }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--observers", type=int, default=3)
    parser.add_argument("--keys", action="store_true")
    parser.add_argument("--scenario", default="random-10")
    parser.add_argument("--speed", default="max")
    parser.add_argument("--after", type=float, default=2.0, help="seconds until they stop")
    parser.add_argument("--most", type=float, default=2.0, help="seconds of a pause")
    parser.add_argument("--timeout", type=float, default=240.0)
    parser.add_argument("--keep", help="keep the folders of the runs by this name")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        keys = Path(place) / "keys" if options.keys else None
        if keys is not None:
            scenario = load(options.scenario)
            keys.mkdir()
            make_keys(keys, scenario.team, nodes_of([each.id for each in scenario.robots]))
        runs = []
        for number in range(options.runs):
            runs.append(one(number, options, keys))
            print(json.dumps(runs[-1]), f"load {os.getloadavg()[0]:.1f}", flush=True)
    good = [
        run for run in runs
        if run["exit"] == 0 and float(str(run["longest_pause_s"])) <= options.most
    ]  # fmt: skip
    maps = {run["map"] for run in runs}
    print(f"{len(good)} of {len(runs)} runs good, {len(maps)} map(s)")
    return 0 if len(good) == len(runs) and len(maps) == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
