"""A stranger among peers: can what it sends fill a robot, or keep it from its final map?

    python -m tests.trials.hostile_peers [--steps 200] [--speed 10] [--rate 2000] [--json FILE]

`thesis` under `launch --without-centre`, as real processes, without keys. A stranger says in the
names of the robots and of others: summaries that claim submaps without end, and answers the
requests with members of megabytes, with signatures of megabytes, and with those of strangers; it
asks for everything, again and again, appears under names that no robot has, and sends what the door
refuses. What only keys can keep it from is not among this: members that are valid, and the ends of
streams. Ends with 1 unless every robot has the map of a team to which nothing happens, no robot has
grown by more than `--most` megabytes beyond one in a team without a stranger, and no file of a set
or log of a robot by more than one. A node that is flooded until the end may not leave by itself
within a minute: then launch, whose status is printed, ends it.
"""

import argparse
import hashlib
import json
import logging
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from teamslam.sim.scenarios.scenario import load
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import BusError, Sample
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests import build
from tests.trials.kills import PROGRAM, await_text, children, expected_of, shortened

ROBOTS = ("r1", "r2")
LARGE = 3 * 2**20


def claims(rng: random.Random, node: str, serial: int) -> m.SetSummary:
    """A summary that has everything of everyone."""
    holdings = tuple(
        build.holding(
            robot=robot,
            incarnation=life,
            sequences=(0, rng.randrange(10**3, 10**9)),
            digest=rng.randbytes(8),
        )
        for robot in ROBOTS
        for life in range(1, 40)
    )
    return build.set_summary(
        node=node,
        serial=serial,
        digest=rng.randbytes(8),
        holdings=holdings,
        statements=(m.Statements(robot="r1", count=9, digest=rng.randbytes(8)),),
    )


def given(rng: random.Random, node: str) -> bytes:
    """An answer: a large payload, a large signature, a robot that is not in the team."""
    start = build.initial_pose(robot="x9")
    done = build.concluded()
    return encoded(
        build.members(
            node=node,
            keys=("robot/r1/submap", ch.CONCLUDED.key("r1"), ch.START.key("x9")),
            payloads=(rng.randbytes(LARGE), encoded(done), encoded(start)),
            signatures=(b"", rng.randbytes(LARGE), b""),
        )
    )


def answer(sent: Counter[str], answers: list[bytes], request: bytes) -> list[bytes]:
    """The stranger's answer to a request."""
    sent["answers"] += 1
    return answers


def storm(bus: ZenohBus, over: threading.Event, rate: float) -> Counter[str]:
    """Say it all until all robots have left; how much of each kind."""
    rng = random.Random(1)
    sent: Counter[str] = Counter()
    for robot in ROBOTS:
        node = ch.robot_node(robot)
        bus.answer(ch.MEMBERS, node, partial(answer, sent, [given(rng, node)]))
    began = time.monotonic()
    while not over.is_set():
        total = sent.total()
        robot = ROBOTS[total % 2]
        node = ch.robot_node(robot)
        with suppress(BusError):
            match total % 20:
                case 0:
                    payload = encoded(claims(rng, node, total))
                    bus.publish_raw(Sample(ch.SET_SUMMARY.key(node), payload, 0, 0, total))
                    sent["summaries"] += 1
                case 1:
                    want = build.requested(robot=robot, last=10**6)
                    asked = build.members_request(stamp_ns=total, node=node, requested=(want,))
                    bus.request(ch.MEMBERS, node, asked)
                    sent["requests"] += 1
                case 2 if sent["tokens"] < 300:
                    bus.declare_alive(f"robot/x{total}")
                    sent["tokens"] += 1
                case 3:
                    unknown = f"robot/x{total}"
                    payload = encoded(claims(rng, unknown, 0))
                    bus.publish_raw(Sample(ch.SET_SUMMARY.key(unknown), payload, 0, 0, 0))
                    sent["strangers"] += 1
                case _:
                    junk = rng.randbytes(200)
                    bus.publish_raw(Sample(ch.SUBMAP.key(robot), junk, 0, 0, total))
                    sent["junk"] += 1
            bus.receive(0.0)
        ahead = total / rate - (time.monotonic() - began)
        if ahead > 0.005:
            time.sleep(ahead)
    return sent


def grown(launch: int, folder: Path, most: dict[str, int]) -> bool:
    """Note the largest memory [MB] of each robot so far; whether any is there."""
    there = False
    for pid, line in children(launch, folder).items():
        if line and line[0] == "robot":
            with suppress(OSError, IndexError, ValueError):
                text = Path(f"/proc/{pid}/status").read_text()
                kilobytes = int(text.partition("VmRSS:")[2].split()[0])
                name = next(word for word in line if word in ROBOTS)
                most[name] = max(most.get(name, 0), kilobytes // 1000)
                there = True
    return there


def measured(options: argparse.Namespace, *, hostile: bool) -> dict[str, Any]:
    """One run."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place).resolve()
        scenario = shortened(folder, options.steps)
        resolved = load(scenario)
        with (folder / "said").open("wb") as said:
            launch = subprocess.Popen(
                [*PROGRAM, "launch", scenario, "--without-centre", "--speed", options.speed,
                 "--no-report", "--no-views", "--output", "run", "--json", "result.json"],
                cwd=folder, stdout=said, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            )  # fmt: skip
        endpoint = await_text(folder / "run" / "router.log", "listening at ").split()[0]
        most: dict[str, int] = {}
        over = threading.Event()

        def watch() -> None:
            while launch.poll() is None:
                if not grown(launch.pid, folder, most) and most:
                    over.set()
                time.sleep(0.2)
            over.set()

        watcher = threading.Thread(target=watch)
        watcher.start()
        sent: Counter[str] = Counter()
        if hostile:
            for robot in ROBOTS:
                await_text(folder / "run" / f"robot-{robot}.log", "connected")
            with ZenohBus(resolved.team, endpoint) as bus:
                sent = storm(bus, over, options.rate)
        status = launch.wait(options.patience)
        watcher.join()
        result = json.loads((folder / "result.json").read_text())
        expected = hashlib.sha256(expected_of(resolved)).hexdigest()
        peers = result["peers"].items()
        return {
            "hostile": hostile,
            "sent": dict(sent),
            "exit": status,
            "equal": all(peer["final_map_sha256"] == expected for _, peer in peers),
            "restarts": result["restarts"],
            "failures": result["failures"],
            "robot_mb": most,
            "set_kb": {r: (folder / "run" / f"{r}.set").stat().st_size // 1000 for r in ROBOTS},
            "log_kb": {
                r: (folder / "run" / f"robot-{r}.log").stat().st_size // 1000 for r in ROBOTS
            },
        }


def main() -> int:
    """Run with and without the stranger, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--speed", default="10")
    parser.add_argument("--rate", type=float, default=2000.0, help="messages a second, at most")
    parser.add_argument("--most", type=int, default=256, help="megabytes a robot may grow by")
    parser.add_argument("--patience", type=float, default=300.0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    logging.disable()  # what the stranger hears is its own affair
    rows = [measured(options, hostile=hostile) for hostile in (False, True)]
    for row in rows:
        print(json.dumps(row), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    quiet, loud = rows
    growth = [loud["robot_mb"][r] - quiet["robot_mb"][r] for r in ROBOTS]
    files = [loud[f][r] - quiet[f][r] for r in ROBOTS for f in ("set_kb", "log_kb")]
    good = all(row["equal"] for row in rows) and quiet["exit"] == 0
    return 0 if good and max(growth) <= options.most and max(files) <= 1000 else 1


if __name__ == "__main__":
    sys.exit(main())
