"""Late joiners under load: does each get every message of delivery `all`, once and in order?

    python -m tests.trials.late_joins [--joins 1000] [--publishers 3] [--busy 4] [--seed 2]

Publishers send on their keys while one more process of the team joins; what it receives is compared
with what was sent. Busy loops load the machine meanwhile. Prints how many keys would have stayed
partial without a question to the publishers' caches; exit status 1 if any was partial in the end.
"""

import argparse
import logging
import multiprocessing
import random
import sys
import threading
import time
from collections.abc import Sequence

from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build

MESSAGES = 24
"""That each publisher sends, some before the join and some after it."""
WITHIN_S = 20.0


def spin() -> None:
    """Load one core until the process is ended."""
    while True:
        pass


class Questions(logging.Handler):
    """Count the keys that the bus requests."""

    def __init__(self) -> None:
        super().__init__()
        self.keys: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Note the key of a question."""
        if "asked for" in record.msg and record.args:
            self.keys.add(str(record.args[0]))


def joined(endpoint: str, team: str, publishers: int, rng: random.Random) -> dict[str, list[int]]:
    """One late join; the counters that came of each key, in their order."""
    robots = [f"r{n}" for n in range(publishers)]
    buses = {robot: ZenohBus(team, endpoint) for robot in robots}
    before = rng.randrange(MESSAGES)

    def say(count: int) -> None:
        for robot in robots:
            text = "x" * 1_500
            message = build.withdrawal(stamp_ns=count, robot=robot, reason=text)
            buses[robot].publish(Outgoing(ch.WITHDRAWAL, robot, message))

    def go_on() -> None:
        for count in range(before, MESSAGES):
            say(count)
            time.sleep(rng.choice([0.0, 0.001, 0.005, 0.02]))

    for count in range(before):
        say(count)
    sending = threading.Thread(target=go_on)
    sending.start()
    time.sleep(rng.random() * 0.1)
    found: dict[str, list[int]] = {ch.WITHDRAWAL.key(robot): [] for robot in robots}
    with ZenohBus(team, endpoint) as late:
        late.subscribe(ch.WITHDRAWAL)
        end = time.monotonic() + WITHIN_S
        while time.monotonic() < end and any(len(c) < MESSAGES for c in found.values()):
            for sample in late.receive(0.05):
                found[sample.key].append(sample.counter)
        sending.join()
    for bus in buses.values():
        bus.close()
    return found


def storm(joins: int, publishers: int, seed: int) -> tuple[int, int, float]:
    """Keys that stayed partial, keys that were asked for, the longest time of a join [s]."""
    rng = random.Random(seed)
    questions = Questions()
    log = logging.getLogger("teamslam.team.wire.zenoh.recovery")
    log.addHandler(questions)
    log.setLevel(logging.INFO)
    partial = asked = 0
    longest = 0.0
    try:
        with router() as endpoint:
            for number in range(joins):
                questions.keys.clear()
                began = time.monotonic()
                found = joined(endpoint, f"t{number}", publishers, rng)
                longest = max(longest, time.monotonic() - began)
                partial += sum(counters != list(range(MESSAGES)) for counters in found.values())
                asked += len(questions.keys)
    finally:
        log.removeHandler(questions)
    return partial, asked, longest


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the storm, print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--joins", type=int, default=1_000)
    parser.add_argument("--publishers", type=int, default=3)
    parser.add_argument("--busy", type=int, default=4, help="busy loops beside it")
    parser.add_argument("--seed", type=int, default=2)
    given = parser.parse_args(arguments)
    spawn = multiprocessing.get_context("spawn")
    load = [spawn.Process(target=spin, daemon=True) for _ in range(given.busy)]
    for each in load:
        each.start()
    try:
        partial, asked, longest = storm(given.joins, given.publishers, given.seed)
    finally:
        for each in load:
            each.terminate()
    keys = given.joins * given.publishers
    print(f"{given.joins} joins, {keys} keys: {asked} asked for, {partial} partial in the end")
    print(f"the longest join took {longest:.1f} s")
    return 1 if partial else 0


if __name__ == "__main__":
    sys.exit(main())
