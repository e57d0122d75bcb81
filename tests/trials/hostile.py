"""Hostile traffic: mutated payloads at the door, and valid hostile messages into running nodes.

    python -m tests.trials.hostile [--mutated 1000000] [--messages 100000] [--through 20000]
                                 [--keys] [--json FILE]

Door: any error but `WireError` has escaped. Nodes: a stranger publishes on all keys of a team of
processes. Without keys no process may die and no fault be set aside; orders and ends of the run
are left out (docs/decisions/09-keys-and-access-control.md states the effects on the map). With
--keys the stranger has the certificate of a robot outside the scenario and sends everything; the
final map must be that of the same team in memory. Ends with 1 if any of this does not hold.
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
from collections import Counter
from contextlib import suppress
from pathlib import Path

from teamslam.sim.scenarios.scenario import load
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import nodes_of
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import BusError, Sample, opened
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests.hostile.drawing import OF_THE_RUN, PAIR, mutated, payloads
from tests.trials.kills import PROGRAM, await_text, children, expected_of, final_in, shortened

PATIENCE_S = 600.0  # time [s] for a process to begin
SUBMAPS = 1_500  # hostile submaps of a storm: the centre folds each of them that it does not refuse


def door(count: int, seed: int) -> tuple[int, int, list[str]]:
    rng = random.Random(seed)
    refused = passed = 0
    escaped: list[str] = []
    source = payloads(rng)
    pool = [next(source) for _ in range(4_000)]
    for k in range(count):
        if k % 100_000 == 99_999:
            pool = [next(source) for _ in range(4_000)]
        channel, name, payload = rng.choice(pool)
        try:
            opened(Sample(channel.key(name), mutated(rng, payload), 0, 0, 0))
            passed += 1
        except WireError:
            refused += 1
        except Exception as error:
            escaped.append(f"{channel.name}: {type(error).__name__}: {error}")
    return refused, passed, escaped


def storm(bus: ZenohBus, options: argparse.Namespace, launch: subprocess.Popen[bytes]) -> Counter:
    rng = random.Random(options.seed)
    sent: Counter[str] = Counter()
    mutants = options.through
    per_s, began = options.rate, time.monotonic()
    for channel, name, payload in payloads(rng):
        total = sent.total()
        if total >= options.messages + options.through or launch.poll() is not None:
            break
        if not options.keys:
            if channel.message in OF_THE_RUN:
                continue
            if channel is ch.SUBMAP and sent["submap"] >= SUBMAPS:
                continue
        as_it_is = rng.random() * (options.messages + options.through) >= mutants
        data = payload if as_it_is else mutated(rng, payload)
        key = channel.key(name)
        try:
            bus.publish_raw(Sample(key, data, 0, time.time_ns(), sent[key]))
        except BusError as error:
            print(f"the stranger is cut off: {error}")
            break
        sent[channel.name if as_it_is else "mutated"] += 1
        ahead = total / per_s - (time.monotonic() - began)
        if ahead > 0.01:
            time.sleep(ahead)
    return sent


def nodes(options: argparse.Namespace) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place).resolve()
        scenario = shortened(folder, options.steps)
        resolved = load(scenario)
        door_of: list[str] = []
        credentials = None
        if options.keys:
            keys = folder / "keys"
            make_keys(keys, resolved.team, nodes_of([*PAIR, "r9"]))
            door_of = ["--keys", str(keys)]
            credentials = credentials_of(keys, "robot-r9", resolved.team)
        said = (folder / "said").open("wb")
        launch = subprocess.Popen(
            [*PROGRAM, "launch", scenario, "--speed", options.speed, "--no-report",
             "--output", "run", "--json", "result.json", *door_of],
            cwd=folder, stdout=said, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        endpoint = await_text(folder / "run" / "router.log", "listening at ", PATIENCE_S).split()[0]
        for robot in PAIR:
            await_text(folder / "run" / f"robot-{robot}.log", "connected", PATIENCE_S)
        began = time.monotonic()
        with ZenohBus(resolved.team, endpoint, 20.0, credentials) as bus:
            sent = storm(bus, options, launch)
            storm_s = time.monotonic() - began
            waits = False
            try:
                status = launch.wait(options.patience)
            except subprocess.TimeoutExpired:
                waits = True
                launch.send_signal(signal.SIGINT)
                status = launch.wait(60.0)
        said.close()
        if options.keep:
            subprocess.run(["cp", "-r", folder, options.keep], check=False)
        result = {}
        with suppress(OSError, ValueError):
            result = json.loads((folder / "result.json").read_text())
        text = (folder / "said").read_text("utf-8", "replace")
        left = children(launch.pid, folder)
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        final = final_in(folder)
        equal = None
        if options.keys:
            equal = final == expected_of(resolved)
    return {
        "sent": dict(sent), "total": sent.total(), "storm_s": round(storm_s, 1), "exit": status,
        "waits": waits, "restarts": result.get("restarts", {}), "equal": equal,
        "faults": [line for line in text.splitlines() if "set aside" in line],
        "deaths": [line for line in text.splitlines() if "is started again" in line],
        "tracebacks": text.count("Traceback (most recent call last)"),
        "final": final is not None, "left": len(left), "failures": result.get("failures", []),
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutated", type=int, default=1_000_000)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--through", type=int, default=20_000, help="mutated ones over the wire")
    parser.add_argument("--rate", type=float, default=3_000.0, help="messages a second, at most")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--speed", default="10")
    parser.add_argument("--patience", type=float, default=300.0, help="for the run's end [s]")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keys", action="store_true")
    parser.add_argument("--keep", help="copy the run's folder here")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    refused, passed, escaped = door(options.mutated, options.seed)
    print(f"door: {options.mutated} mutated, {refused} refused, {passed} passed, "
          f"{len(escaped)} escaped", flush=True)  # fmt: skip
    found: dict[str, object] = {"refused": refused, "passed": passed, "escaped": escaped[:20]}
    bad = bool(escaped)
    if options.messages:
        after = nodes(options)
        found |= after
        print(json.dumps(after, indent=1), flush=True)
        bad |= any(after[what] for what in ("deaths", "faults", "left", "waits", "tracebacks"))
        bad |= bool(options.keys) and (not after["equal"] or after["exit"] != 0)
    if options.json:
        options.json.write_text(json.dumps(found | {"load": os.getloadavg()[0]}, indent=1))
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
