"""The effort until all robots have all data again, after two halves of a team have been apart.

    python -m tests.trials.healing [--teams 2 5] [--topologies all line]

The peers of `benchmarks.peers`, each with a submap every 10 s, are apart from 100 s to 200 s. From
then on, by steps of 0.05 s: the seconds until all have everything that existed then, and per robot
the bytes sent, received and missing.
"""

import argparse
import sys
from collections.abc import Callable
from itertools import product
from typing import Any

from benchmarks.peers import CUT_S, SECOND_NS, TEAMS, TOPOLOGIES, WINDOW_S, Team, submap
from teamslam.team.wire.codec import encoded
from tests.air import Air

FINE_NS = 50_000_000
WITHIN_S = 600


def healed(topology: str, robots: int) -> dict[str, float]:
    """The effort after two halves were apart, until all robots have all data of that time.

    seconds: of the last robot; said_kb, heard_kb: mean per robot, of which news_kb were missing.
    """
    team = Team(topology, robots)
    whole, half = team.air.reach, robots / 2
    cut_ns = [at * SECOND_NS for at in CUT_S]

    def reach(one: str, other: str, now_ns: int) -> bool:
        apart = cut_ns[0] <= now_ns < cut_ns[1]
        across = (int(one[1:]) <= half) != (int(other[1:]) <= half)
        return whole(one, other, now_ns) and not (apart and across)

    team.air = Air(reach=reach)
    team.begin()
    counts = dict.fromkeys(team.names, 0)
    now_ns, step_ns = 0, SECOND_NS // 2
    aims: dict[str, int] = {}
    before = 0, 0
    while now_ns < cut_ns[1] + WITHIN_S * SECOND_NS:
        for i, name in enumerate(team.names):
            due = (now_ns / SECOND_NS - WINDOW_S * (i + 0.5) / robots) // WINDOW_S
            if due > counts[name]:
                team.close(name, counts[name], now_ns)
                counts[name] += 1
        if now_ns == cut_ns[1]:
            aims, step_ns = dict(counts), FINE_NS
            before = sum(team.said.values()), sum(team.heard.values())
            lacked = sum(aims.values()) * robots - sum(team.held(aims).values())
        team.talk(now_ns, step_ns)
        now_ns += step_ns
        if aims and sum(team.held(aims).values()) == sum(aims.values()) * robots:
            break
    else:
        return {"seconds": -1.0}
    size = len(encoded(submap("r1", 0)))
    after = sum(team.said.values()) - before[0], sum(team.heard.values()) - before[1]
    return {
        "seconds": (now_ns - cut_ns[1]) / SECOND_NS,
        "said_kb": after[0] / robots / 1000.0,
        "heard_kb": after[1] / robots / 1000.0,
        "news_kb": lacked * size / robots / 1000.0,
    }


def main(show: Callable[[str], Any] = sys.stdout.write) -> int:
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--teams", type=int, nargs="*", default=list(TEAMS))
    wholes = [each for each in TOPOLOGIES if each != "partition"]
    options.add_argument("--topologies", nargs="*", default=wholes, choices=wholes)
    chosen = options.parse_args()
    show("| topology | robots | seconds | said [kB] | heard [kB] | lacked [kB] |\n")
    show("|---|---|---|---|---|---|\n")
    good = True
    for topology, robots in product(chosen.topologies, chosen.teams):
        figures = healed(topology, robots)
        good = good and figures["seconds"] >= 0.0
        numbers = " | ".join(f"{value:.2f}" for value in figures.values())
        show(f"| {topology} | {robots} | {numbers} |\n")
        sys.stdout.flush()
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
