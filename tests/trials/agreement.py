"""Storms on a team without a centre: does every peer end with the central run's map, to the bit?

    python -m tests.trials.agreement [CASE…] [--utias FOLDER] [--json FILE]

Each case runs in memory with a centre, then as peers in three ways: with a centre as one more
peer, without, and with one that is down in the second half. 20 % of the messages are lost, 10 %
come twice, up to 2 s late; partitions are random, and each of 30 deaths may tear the end of a
disk; the second robot joins at half time, the last one meets only the first. CASE is a scenario,
`eight`, or `utias-6`, with `@100` for the first 100 steps or seconds, and with `/withdrawn` for an
order against the second robot at half time, which only the first receives.
"""

import argparse
import hashlib
import json
import random
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from teamslam.central.node import CentralNode
from teamslam.central.peers.fold import FoldWhen
from teamslam.central.peers.peer import CENTRE
from teamslam.central.peers.robot import PeerRobot
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import RobotConfig
from teamslam.team.peers.members import CHANNELS, Member, about
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import encoded
from tests import build
from tests.air import Air
from tests.peer_team import PeerTeam, peer_world
from tests.scenarios import with_world

SECOND = 10**9
DEATHS = 30
ALWAYS = 3
"""In a team of so many robots the first one folds as the set grows; all others, and those of larger
teams, fold once, at the end. A centre folds always."""
PERIOD_S = 15
REASON = "by the storm"
WAYS = ("with", "without", "dies")


def scenario_of(case: str, utias: Path) -> Scenario:
    case, _, length = case.partition("@")
    if length:
        whole = scenario_of(case, utias)
        which = "steps" if hasattr(whole.world, "steps") else "duration_s"
        return with_world(whole, **{which: int(length)})
    if case.startswith("utias-"):
        path = utias / f"MRCLAM_Dataset{case.removeprefix('utias-')}.zip"
        return with_options(load("utias"), dataset=path)
    if case == "eight":
        return with_options(load("random-10"), robots=8, seed=8)
    return load(case)


@dataclass
class Storm:
    """Events of a run: deaths, a late joiner, a centre, an order; `reach` for the air."""

    scenario: Scenario
    way: str
    begin_ns: int
    end_ns: int
    seed: int
    withdrawn: bool = False
    disks: dict[str, list[Member]] = field(default_factory=dict)
    deaths: int = 0

    def __post_init__(self) -> None:
        self.names = [each.id for each in self.scenario.robots]
        self.rng = random.Random(self.seed)
        span = self.end_ns - self.begin_ns
        self.half_ns = self.begin_ns + span // 2
        self.late = "" if len(self.names) < 3 and self.withdrawn else self.names[1]
        times = [self.begin_ns + int(self.rng.random() * span) for _ in range(DEATHS)]
        self.due = sorted(times)

    def reach(self, one: str, other: str, now_ns: int) -> bool:
        pair = sorted((one, other))
        loner = self.names[-1]
        if len(self.names) > 2 and loner in pair and self.names[0] not in pair:
            return False
        if now_ns >= self.end_ns:
            return True
        period = now_ns // (PERIOD_S * SECOND)
        named = f"{self.seed} {pair} {period}".encode()
        return hashlib.blake2b(named, digest_size=1).digest()[0] < 100

    def begin(self, team: PeerTeam) -> None:
        if self.late:
            del team.seats[self.late]

    def step(self, team: PeerTeam) -> None:
        now_ns = team.now_ns
        if self.late and self.late not in team.seats and now_ns >= self.half_ns:
            team.restart(self._config(self.late))
        if self.withdrawn and now_ns >= self.half_ns and not self.disks.get("order"):
            self.disks["order"] = [order_of(self.names[1])]
            self._order(team)
        self._centre(team, now_ns)
        while self.due and self.due[0] <= now_ns:
            self.due.pop(0)
            there = [n for n in team.seats if n != CENTRE]
            name = self.rng.choice(there)
            kept = team.leave(name)
            own = [each for each in kept if about(each.message) == name]
            rest = [each for each in kept if about(each.message) != name]
            team.restart(self._config(name), own + rest[: len(rest) - self.rng.randrange(5)])
            self.deaths += 1
            if name == self.names[0]:
                self._order(team)

    def _order(self, team: PeerTeam) -> None:
        """Deliver the order to the first robot, and again after a death, which may have torn it."""
        for order in self.disks.get("order", ()):
            team.hear(self.names[0], Sample(order.key, order.payload, 0, 0, 0))

    def _centre(self, team: PeerTeam, now_ns: int) -> None:
        if self.way == "without":
            return
        down = self.way == "dies" and self.half_ns <= now_ns < self.end_ns
        if CENTRE not in team.seats and not down:
            team.seat_centre(self.disks.get(CENTRE, ()))
        elif CENTRE in team.seats and down:
            self.disks[CENTRE] = team.leave(CENTRE)

    def _config(self, name: str) -> RobotConfig:
        config = self.scenario.config_of(name)
        assert config is not None
        return config


def order_of(robot: str) -> Member:
    order = build.withdrawal(robot=robot, reason=REASON)
    return Member(ch.ORDER.key(robot), encoded(order), order)


def central_map(scenario: Scenario, samples: list[Sample], order: Member | None) -> bytes:
    if order is None:
        return encoded(final_map(samples))
    node = CentralNode(scenario.central, [each.id for each in scenario.robots])
    ends = [sample for sample in samples if sample.key == ch.END.key()]
    inputs = [sample for sample in samples if sample.key != ch.END.key()]
    for sample in [Sample(order.key, order.payload, 0, 0, 0), *inputs, *ends]:
        found = ch.channel_of(sample.key)
        if found is not None and (found[0] in CHANNELS or found[0] is ch.END):
            node.handle(opened(sample)[2])
    assert node.final is not None
    return encoded(node.final)


def span_of(streams: WorldStreams) -> tuple[int, int]:
    stamps = [each.stamps_ns for each in streams.streams if len(each.stamps_ns)]
    return min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)


def outcome(case: str, way: str, scenario: Scenario, expected: bytes, *, withdrawn: bool,
            submaps: set[bytes]) -> dict[str, object]:  # fmt: skip
    streams = streams_of(scenario)
    begin_ns, end_ns = span_of(streams)
    storm = Storm(scenario, way, begin_ns, end_ns, 1, withdrawn)
    air = Air(reach=storm.reach, loss=0.2, duplicates=0.1, delay_ns=(0, 2 * SECOND), seed=1)
    always = scenario.robots[0].id if len(scenario.robots) <= ALWAYS else ""

    def make(of: Scenario, config: RobotConfig) -> PeerRobot:
        names = [each.id for each in of.robots]
        when: FoldWhen = "always" if config.id == always else "end"
        return PeerRobot(config, of.central, names, of.exchange, when)

    team = PeerTeam(scenario, air, make)
    storm.begin(team)
    began = time.process_time()
    late = {storm.late} if storm.late else set()
    said = set()
    for sample in team.run(peer_world(scenario, streams, late), storm.step):
        found = ch.channel_of(sample.key)
        if found is not None and found[0] is ch.SUBMAP:
            said.add(sample.payload)
    finals = {
        name: None if seat.node.final is None else encoded(seat.node.final) == expected
        for name, seat in team.seats.items()
    }
    over = team.seats[storm.names[-1]].node.peer.carried
    return {
        "case": case + ("/withdrawn" if withdrawn else ""),
        "centre": way,
        "equal": all(finals.values()),
        "finals": finals,
        "submaps": len(submaps),
        "submaps_equal": said == submaps,
        "deaths": storm.deaths,
        "agreed_s": (team.now_ns - end_ns) / SECOND,
        "brought_to_last": dict(sorted(over.items())),
        "cpu_s": time.process_time() - began,
    }  # fmt: skip


def storms(case: str, ways: list[str], utias: Path) -> Iterator[dict[str, object]]:
    name, _, kind = case.partition("/")
    scenario = scenario_of(name, utias)
    samples = list(run_team(scenario, streams_of(scenario)))
    submaps = {s.payload for s in samples if (ch.channel_of(s.key) or ("",))[0] is ch.SUBMAP}
    withdrawn = kind == "withdrawn"
    order = order_of(scenario.robots[1].id) if withdrawn else None
    expected = central_map(scenario, samples, order)
    del samples
    for way in ways:
        yield outcome(name, way, scenario, expected, withdrawn=withdrawn, submaps=submaps)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", default=["thesis", "random-10", "eight"])
    parser.add_argument("--ways", nargs="*", default=list(WAYS))
    parser.add_argument("--utias", type=Path, default=Path("../shared/utias"))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = []
    if options.json is not None and options.json.exists():
        found = json.loads(options.json.read_text())
    for case in options.cases:
        there = {each["centre"] for each in found if each["case"] == case}
        ways = [way for way in options.ways if way not in there]
        for each in storms(case, ways, options.utias) if ways else ():
            found.append(each)
            sys.stdout.write(json.dumps(each) + "\n")
            sys.stdout.flush()
            if options.json is not None:
                options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0 if all(each["equal"] and each["submaps_equal"] for each in found) else 1


if __name__ == "__main__":
    sys.exit(main())
