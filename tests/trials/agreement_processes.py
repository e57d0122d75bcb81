"""As `tests.trials.agreement`, over Zenoh with real processes under `launch`.

    python -m tests.trials.agreement_processes thesis --way dies
    python -m tests.trials.agreement_processes thesis --storm --deaths 30
    python -m tests.trials.agreement_processes utias-6 --way with --utias ../shared/utias

A way: with a centre as one more peer, without, or with one that is killed half way and, started
again by launch, comes back. --storm: a radio that loses 20 %, with 2 s of delay and partitions.
--deaths: robots killed while the team measures. --empty: the second robot is killed half way and
its disk is emptied: it joins as one that knows nothing. --withdraw: the second robot is withdrawn
half way, by an operator. A row of JSON; ends with 1 unless launch ended with 0 and every peer has
the central run's bytes.
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, dumps
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import decoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests.trials.agreement import WAYS, central_map, order_of, scenario_of
from tests.trials.kills import PROGRAM, await_text, children


@dataclass
class Watch:
    """How far the team is, by its own words; its processes."""

    folder: Path
    launch: int
    bus: ZenohBus
    done: float = 0.0
    figures: dict[str, float] = field(default_factory=dict)

    def look(self) -> float:
        """The share of the measurements that the world has published."""
        for sample in self.bus.receive(0.1):
            if sample.key == ch.STATUS.key("world"):
                self.figures = decoded(sample.payload, m.Status).figures
                self.done = self.figures.get("measurements", 0.0) / self.figures.get("of", 1e9)
        return self.done

    def pid(self, *words: str) -> int | None:
        """The process whose command begins and ends so, as `robot … r1`."""
        for pid, line in children(self.launch, self.folder).items():
            if line and line[0] == words[0] and all(word in line for word in words):
                return pid
        return None


def kill(pid: int | None) -> bool:
    """Kill a process that was started here."""
    if pid is None:
        return False
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
        return True
    return False


def stormy(scenario: Scenario, span_s: float, seed: int) -> dict[str, Any]:
    """The radio of a storm: the last robot meets the first only, the others now and then."""
    rng = random.Random(seed)
    names = [each.id for each in scenario.robots]
    windows = []
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            if len(names) > 2 and other == names[-1] and one != names[0]:
                continue
            windows += [
                {"robots": [one, other], "from_s": float(at), "to_s": float(at + 15)}
                for at in range(0, int(span_s), 15)
                if rng.random() < 0.4
            ]
    return {"loss": 0.2, "delay_s": 2.0, "windows": windows}


def measured(options: argparse.Namespace, case: str, folder: Path) -> dict[str, Any]:
    """One run."""
    scenario = scenario_of(case, options.utias.resolve())
    streams = streams_of(scenario)
    samples = list(run_team(scenario, streams))
    order = order_of(scenario.robots[1].id) if options.withdraw else None
    expected = hashlib.sha256(central_map(scenario, samples, order)).hexdigest()
    fields = json.loads(dumps(scenario))
    if options.storm:
        stamps = [each.stamps_ns for each in streams.streams]
        span_s = (max(int(s[-1]) for s in stamps) - min(int(s[0]) for s in stamps)) * 1e-9
        fields["radio"] = stormy(scenario, span_s, options.seed)
        fields["peers"] = True
    path = folder / "scenario.json"
    path.write_text(json.dumps(fields))
    way = "--without-centre" if options.way == "without" else "--peers"
    words = [*PROGRAM, "launch", str(path), way, "--no-report", "--no-views",
             "--speed", options.speed, "--output", str(folder / "run"),
             "--json", str(folder / "result.json")]  # fmt: skip
    began = time.monotonic()
    with (folder / "launch.txt").open("wb") as out:
        child = subprocess.Popen(words, stdout=out, stderr=out, cwd=folder)
    endpoint = await_text(folder / "run" / "router.log", "listening at ").split()[0]
    rng = random.Random(options.seed)
    due = sorted(rng.random() for _ in range(options.deaths))
    names = [each.id for each in scenario.robots]
    centre, emptied = options.way == "dies", options.empty
    withdraws, deaths = options.withdraw, 0
    run = (folder / "run").resolve()
    with ZenohBus(scenario.team, endpoint) as bus:
        bus.subscribe(ch.STATUS)
        watch = Watch(folder, child.pid, bus)
        while child.poll() is None:
            done = watch.look()
            if done >= 0.5 and centre:
                centre = not kill(watch.pid("central"))
            if done >= 0.5 and emptied:
                (run / f"{names[1]}.set").unlink(missing_ok=True)
                emptied = not kill(watch.pid("robot", names[1]))
            if done >= 0.5 and withdraws:
                withdraws = False
                place = ["--team", scenario.team, "--connect", endpoint]
                subprocess.run([*PROGRAM, "withdraw", names[1], *place], check=False, cwd=folder)
            if due and done >= due[0]:
                due.pop(0)
                deaths += kill(watch.pid("robot", rng.choice(names)))
    result = json.loads((folder / "result.json").read_text())
    finals = {name: peer["final_map_sha256"] for name, peer in result["peers"].items()}
    said = open_log(folder / "run" / "log.mcap").samples((ch.FINAL_MAP,))
    central = [hashlib.sha256(sample.payload).hexdigest() for sample in said]
    awaited = [n for n in names if n != names[1] or not options.withdraw]
    return {
        "case": case,
        "way": options.way,
        "exit": child.returncode,
        "equal": all(finals.get(name) == expected for name in awaited),
        "finals": {name: sha and sha[:12] for name, sha in finals.items()},
        "expected": expected[:12],
        "central": [each[:12] for each in central],
        "deaths": deaths,
        "restarts": result["restarts"],
        "failures": result["failures"],
        "wall_s": round(time.monotonic() - began, 1),
        "cpu_s": {name: round(p["cpu_s"], 1) for name, p in result["processes"].items()},
        "peers": result["peers"],
    }


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", default=["thesis"])
    parser.add_argument("--way", choices=WAYS, default="without")
    parser.add_argument("--storm", action="store_true")
    parser.add_argument("--deaths", type=int, default=0)
    parser.add_argument("--empty", action="store_true")
    parser.add_argument("--withdraw", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", default="max")
    parser.add_argument("--utias", type=Path, default=Path("../shared/utias"))
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    good = True
    for case in options.cases:
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made) if options.keep is None else options.keep / f"{case}-{options.way}"
            folder.mkdir(parents=True, exist_ok=True)
            row = measured(options, case, folder.resolve())
        good = good and row["equal"] and row["exit"] == 0
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
