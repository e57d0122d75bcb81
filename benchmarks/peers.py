"""Measure a spreading set by topology: bytes of each robot, and the time until all agree.

`python -m benchmarks.peers [--json FILE]`: peers without estimators, each of which
closes a submap of 1.2 kB every 10 s for 300 s of team time and exchanges messages every second. The
star is a centre's traffic per robot.
"""

import heapq
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baseline import parser_of
from teamslam.team.peers.members import Member, about
from teamslam.team.peers.node import PeerNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.air import Air, Reach, always

BASELINE = Path(__file__).with_suffix(".json")
DRIVE_S = 300
WINDOW_S = 10
LANDMARKS = 6
CUT_S = (100, 200)
WAY_NS = 50_000_000
TEAMS = (2, 5, 10, 50)
TOPOLOGIES = ("all", "line", "ring", "meetings", "partition")
SECOND_NS = 10**9
TOLERANCE = 0.05


def submap(robot: str, sequence: int) -> m.Submap:
    n = 3 + 2 * LANDMARKS
    end_ns = (sequence + 1) * WINDOW_S * SECOND_NS
    return build.submap(
        stamp_ns=end_ns, start_ns=end_ns - WINDOW_S * SECOND_NS, robot=robot, sequence=sequence,
        first_measurement=20 * sequence, last_measurement=20 * sequence + 19,
        ids=range(LANDMARKS), mean=np.zeros(n), covariance=np.eye(n)[np.triu_indices(n)],
    )  # fmt: skip


def reach_of(topology: str, robots: int) -> Reach:
    """Make the reach of a topology: all, along a line or a ring, in pairs for 5 s a minute, or two
    halves cut for 100 s.
    """

    def index(name: str) -> int:
        return int(name[1:]) - 1

    def line(one: str, other: str, now_ns: int) -> bool:
        return abs(index(one) - index(other)) == 1

    def ring(one: str, other: str, now_ns: int) -> bool:
        return abs(index(one) - index(other)) in (1, robots - 1)

    def meeting(one: str, other: str, now_ns: int) -> bool:
        if now_ns >= DRIVE_S * SECOND_NS:
            return line(one, other, now_ns)
        phase = (now_ns // SECOND_NS + 7 * min(index(one), index(other))) % 60
        return line(one, other, now_ns) and phase < 5

    def halves(one: str, other: str, now_ns: int) -> bool:
        apart = CUT_S[0] * SECOND_NS <= now_ns < CUT_S[1] * SECOND_NS
        return not apart or (index(one) < robots / 2) == (index(other) < robots / 2)

    found: dict[str, Reach] = {
        "all": always, "line": line, "ring": ring, "meetings": meeting, "partition": halves,
    }  # fmt: skip
    return found[topology]


class Team:
    """Peers and the radio between them; said: bytes of each."""

    def __init__(self, topology: str, robots: int) -> None:
        self.names = [f"r{i + 1}" for i in range(robots)]
        self.nodes = {n: PeerNode(ch.robot_node(n), self.names) for n in self.names}
        self.air = Air(reach=reach_of(topology, robots))
        self.said = dict.fromkeys(self.names, 0)
        self.heard = dict.fromkeys(self.names, 0)
        self._way: list[tuple[int, int, str, str, m.Message | Member]] = []
        self._count = 0

    def begin(self) -> None:
        for name in self.names:
            pose = build.initial_pose(robot=name)
            member = Member(ch.START.key(about(pose)), encoded(pose), pose)
            self.nodes[name].take(member, name)

    def send(
        self, sender: str, to: str, what: m.Message | Member, now_ns: int, size: int = 0
    ) -> None:
        size = size or (what.size if isinstance(what, Member) else len(encoded(what)))
        for at_ns in self.air.arrivals(sender, to, size, now_ns):
            self._count += 1
            self.heard[to] += size
            heapq.heappush(self._way, (at_ns + WAY_NS, self._count, sender, to, what))

    def spread(self, name: str, out: list[Outgoing], now_ns: int) -> None:
        """Send a node's messages: a request to one node, others to every node in reach."""
        for each in out:
            size = len(encoded(each.message))
            self.said[name] += size
            asked = ch.robot_of(each.name) if each.channel is ch.MEMBERS else None
            for other in self.names:
                if other != name and asked in (None, other):
                    self.send(name, other, each.message, now_ns, size)

    def second(self, now_s: int) -> None:
        now_ns = now_s * SECOND_NS
        if 0 < now_s <= DRIVE_S and now_s % WINDOW_S == 0:
            for name in self.names:
                self.close(name, now_s // WINDOW_S - 1, now_ns)
        self.talk(now_ns, SECOND_NS)

    def close(self, name: str, sequence: int, now_ns: int) -> None:
        message = submap(name, sequence)
        member = Member(ch.SUBMAP.key(name), encoded(message), message)
        self.nodes[name].take(member, name)
        self.said[name] += member.size
        for other in self.names:
            if other != name:
                self.send(name, other, member, now_ns)

    def talk(self, now_ns: int, length_ns: int) -> None:
        """Exchange the peers' due messages; deliver those that arrive within the time."""
        for name, node in self.nodes.items():
            self.spread(name, node.tick(now_ns * 1e-9), now_ns)
        while self._way and self._way[0][0] < now_ns + length_ns:
            at_ns, _, sender, to, what = heapq.heappop(self._way)
            self._arrive(sender, to, what, at_ns)

    def held(self, aims: Mapping[str, int]) -> dict[str, int]:
        """Count the first `aims` submaps of each robot that each node has."""
        return {
            name: sum(min(node.replica.share_of((r, 1)).count, n) for r, n in aims.items())
            for name, node in self.nodes.items()
        }

    def _arrive(self, sender: str, to: str, what: m.Message | Member, now_ns: int) -> None:
        node = self.nodes[to]
        match what:
            case Member():
                node.take(what, ch.robot_node(sender))
            case m.SetSummary():
                self.spread(to, node.take_summary(what), now_ns)
            case m.MembersRequest():
                for reply in node.answer(encoded(what)):
                    self.said[to] += len(reply)
                    self.send(to, sender, decoded(reply, m.Members), now_ns)
            case m.Members():
                node.take_carried(what)
                self.spread(to, node.request_rest(what.node), now_ns)

    @property
    def agrees(self) -> bool:
        return len({node.replica.digest for node in self.nodes.values()}) == 1


def measure_spreading(topology: str, robots: int) -> dict[str, float]:
    team = Team(topology, robots)
    team.begin()
    healed_s = CUT_S[1] if topology == "partition" else DRIVE_S
    agreed_s = None
    for now_s in range(DRIVE_S + 600):
        team.second(now_s)
        if now_s >= healed_s and agreed_s is None and team.agrees:
            agreed_s = now_s - healed_s
            if now_s >= DRIVE_S:
                break
    star = DRIVE_S // WINDOW_S * len(encoded(submap("r1", 0)))
    said, heard = list(team.said.values()), list(team.heard.values())
    return {
        "agree_after_s": -1.0 if agreed_s is None else float(agreed_s),
        "said_b_s": float(np.mean(said)) / DRIVE_S,
        "heard_b_s": float(np.mean(heard)) / DRIVE_S,
        "star_b_s": star / DRIVE_S,
    }


def main(show: Callable[[str], Any] = sys.stdout.write) -> int:
    options = parser_of(__doc__)
    options.add_argument("--teams", type=int, nargs="*", default=list(TEAMS))
    options.add_argument("--topologies", nargs="*", default=list(TOPOLOGIES))
    chosen = options.parse_args()
    before = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    found, worse = {}, []
    show("| topology | robots | agree after [s] | said [B/s] | heard [B/s] | star [B/s] |\n")
    show("|---|---|---|---|---|---|\n")
    for topology in chosen.topologies:
        for robots in chosen.teams:
            name = f"{topology}/{robots}"
            found[name] = figures = measure_spreading(topology, robots)
            numbers = " | ".join(f"{value:.0f}" for value in figures.values())
            show(f"| {topology} | {robots} | {numbers} |\n")
            for figure, value in figures.items():
                old = before.get(name, {}).get(figure)
                if old is not None and value > old * (1.0 + TOLERANCE) + 1.0:
                    worse.append(f"{name}: {figure} is {value:.1f}, was {old:.1f}")
    if chosen.json is not None:
        there = json.loads(chosen.json.read_text()) if chosen.json.exists() else {}
        chosen.json.write_text(json.dumps(there | found, indent=1) + "\n")
    show("".join(f"worse: {each}\n" for each in worse))
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
