"""One robot of a keyed team behind a bad radio link: loss, delay and cuts longer than a lease.

    sudo python -m tests.trials.lossy_radio --runs 1 --loss 15,25,30 --delay 60,120,150

Needs root and `ip` (Linux). A run is good if all processes ended with 0 and the final map equals
that of the same team in memory, or if all are alive at the time limit. Ends with 1 unless all are.
"""

import argparse
import ctypes
import fcntl
import os
import random
import select
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from teamslam.sim.scenarios.scenario import load
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.roster import nodes_of
from tests.namespaces import ip
from tests.trials.cuts import PORT, Team
from tests.trials.kills import PROGRAM, expected_of, final_in, shortened

HOME, AWAY = "10.213.78.1", "10.213.78.2"
MOST_PACKETS = 2_000  # number of packets under way; further ones are lost, as in a full buffer
CLONE_NEWNET = 0x4000_0000
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x4004_54CA, 0x0001, 0x1000
FAR = "r1"


@dataclass
class Run:
    """Outcome of one run. exits: status of each process; None: alive at the time limit."""

    loss: int
    delay: int
    cuts: list[float] = field(default_factory=list)
    exits: dict[str, int | None] = field(default_factory=dict)
    wall_s: float = 0.0
    equal: bool | None = None
    waits: int = 0
    progress: str = ""

    @property
    def goes_on(self) -> bool:
        """Whether the robot was still working, with all that it needs alive."""
        return any(status is None for status in self.exits.values())

    @property
    def good(self) -> bool:
        """Whether none died, and the map is the undisturbed one or still pending."""
        died = any(self.exits.values())
        return not died and (self.goes_on or self.equal is True)

    def __str__(self) -> str:
        died = {node: status for node, status in self.exits.items() if status}
        alive = [node for node, status in self.exits.items() if status is None]
        map_ = "map equal" if self.equal else "MAP DIFFERS" if self.equal is False else "no map yet"
        return (
            f"{'good' if self.good else 'BAD '} loss {self.loss} %, {self.delay} ms; "
            f"{len(self.cuts)} cuts; {self.wall_s:.0f} s; {map_}; died {died or 'nobody'}; "
            f"alive {', '.join(alive) or 'nobody'}; {self.waits} lines of waiting; {self.progress}"
        )


class Radio:
    """A link between two namespaces with loss, delay and cuts.

    Two TUN devices, and a thread that carries packets between them.
    """

    def __init__(self, names: tuple[str, str], loss: int, delay_ms: int, seed: str) -> None:
        self._ends = [tun_in(name) for name in names]
        self._loss = 0.01 * loss
        self._delay_s = 1e-3 * delay_ms
        self._random = random.Random(seed)
        self._over = threading.Event()
        self.cut = False
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        for end in self._ends:
            os.close(end)

    def _carry(self) -> None:
        under_way: deque[tuple[float, int, bytes]] = deque()  # one delay for all: in their order
        while not self._over.is_set():
            wait = 0.05 if not under_way else max(0.0, under_way[0][0] - time.monotonic())
            for end in select.select(self._ends, [], [], min(wait, 0.05))[0]:
                packet = os.read(end, 65_536)
                if self.cut or self._random.random() < self._loss or len(under_way) >= MOST_PACKETS:
                    continue
                other = self._ends[1 - self._ends.index(end)]
                under_way.append((time.monotonic() + self._delay_s, other, packet))
            while under_way and under_way[0][0] <= time.monotonic():
                _, other, packet = under_way.popleft()
                with suppress(OSError):
                    os.write(other, packet)


def tun_in(namespace: str) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    found = []

    def enter_and_open() -> None:  # a namespace is a thread's own
        with Path(f"/var/run/netns/{namespace}").open("rb") as there:
            if libc.setns(there.fileno(), CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), namespace)
        end = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH14x", b"radio", IFF_TUN | IFF_NO_PI))
        found.append(end)

    thread = threading.Thread(target=enter_and_open)
    thread.start()
    thread.join()
    return found[0]


@contextmanager
def radio(loss: int, delay_ms: int, seed: str) -> Iterator[tuple[str, str, Radio]]:
    home, away = (f"teamslam-{os.getpid()}-{side}" for side in ("home", "away"))
    made: list[str] = []
    link = None
    try:
        for name in (home, away):
            ip("netns", "add", name)
            made.append(name)
            ip("-n", name, "link", "set", "lo", "up")
        link = Radio((home, away), loss, delay_ms, seed)
        for name, address in ((home, HOME), (away, AWAY)):
            ip(*f"-n {name} addr add {address}/24 dev radio".split())
            ip("-n", name, "link", "set", "radio", "up")
        yield home, away, link
    finally:
        if link is not None:
            link.close()
        for name in made:
            ip("netns", "del", name)


def one(
    loss: int, delay: int, scenario: Path, robots: list[str], expected: bytes, keys, options
) -> Run:
    run = Run(loss, delay)
    place_of = f"{'tcp' if options.open else 'tls'}/{HOME}:{PORT}"
    door = [] if options.open else ["--keys", str(keys)]
    there = ["--connect", place_of, *door]
    what = str(scenario)
    told = {
        "router": ["router", "--listen", place_of, *(door or ["--insecure"])],
        "recorder": ["record", what, "--output", "run/log.mcap", *there],
        "central": ["central", what, *there],
        "world": ["world", what, "--speed", options.speed, *there],
        **{robot: ["robot", what, robot, *there] for robot in robots},
    }
    with (
        tempfile.TemporaryDirectory() as place,
        radio(loss, delay, f"{loss} {delay}") as (home, away, link),
    ):
        folder = Path(place).resolve()
        (folder / "run").mkdir()
        names = {node: away if node == FAR else home for node in told}
        team = Team(folder, {node: [*PROGRAM, *words] for node, words in told.items()}, names)
        try:
            team.begin()
            began = time.monotonic()
            disturb(run, link, team, options)
            run.wall_s = time.monotonic() - began
            run.exits = {node: process.poll() for node, process in team.started.items()}
        finally:
            team.stop()
        if run.exits.pop("router") is not None:
            run.exits["router"] = 99
        final = final_in(folder)
        run.equal = None if final is None else final == expected
        logs = {
            path.stem: path.read_text("utf-8", "replace") for path in (folder / "run").glob("*.log")
        }
        run.waits = sum(text.count("waiting for the router") for text in logs.values())
        run.progress = f"{FAR}: {(logs[FAR].splitlines() or ['nothing'])[-1][:160]}"
        if options.keep:
            subprocess.run(["cp", "-r", folder, f"{options.keep}-{loss}"], check=False)
    return run


def disturb(run: Run, link: Radio, team: Team, options) -> None:
    began = time.monotonic()
    due = [options.first + k * (options.cut + options.between) for k in range(options.cuts)]
    mend_s = None
    while (at := time.monotonic() - began) < options.timeout:
        if mend_s is not None and at >= mend_s:
            link.cut = False
            mend_s = None
        elif mend_s is None and due and at >= due[0]:
            due.pop(0)
            link.cut = True
            run.cuts.append(round(at, 1))
            mend_s = at + options.cut
        if not any(team.is_alive(node) for node in team.started if node != "router"):
            return
        time.sleep(0.05)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1, help="at each loss")
    parser.add_argument("--loss", default="15,25,30", help="per cent, comma-separated")
    parser.add_argument("--delay", default="60,120,150", help="milliseconds, one for each loss")
    parser.add_argument("--cuts", type=int, default=3)
    parser.add_argument("--cut", type=float, default=8.0, help="seconds of a cut")
    parser.add_argument("--first", type=float, default=4.0, help="seconds until the first cut")
    parser.add_argument("--between", type=float, default=8.0, help="seconds between two cuts")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--speed", default="2")
    parser.add_argument("--timeout", type=float, default=240.0)
    parser.add_argument("--open", action="store_true", help="without keys")
    parser.add_argument("--keep", help="keep the folders of the runs by this name")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        scenario = shortened(Path(place), options.steps)
        resolved = load(scenario)
        robots = [robot.id for robot in resolved.robots]
        keys = Path(place) / "keys"
        keys.mkdir()
        make_keys(keys, resolved.team, nodes_of(robots), hosts=[HOME])
        expected = expected_of(resolved)
        parts = (map(int, each.split(",")) for each in (options.loss, options.delay))
        links = list(zip(*parts, strict=True))
        runs = []
        for loss, delay in links * options.runs:
            runs.append(one(loss, delay, scenario, robots, expected, keys, options))
            print(f"{runs[-1]}; load {os.getloadavg()[0]:.1f}", flush=True)
    good = sum(run.good for run in runs)
    died = sum(any(run.exits.values()) for run in runs)
    print(
        f"{good} of {len(runs)} runs good, map equal in {sum(run.equal is True for run in runs)}, "
        f"still going on in {sum(run.goes_on for run in runs)}, a process died in {died}"
    )
    return 0 if good == len(runs) else 1


if __name__ == "__main__":
    sys.exit(main())
