"""Observe a running team: nodes, progress, rates, clocks, dependencies."""

import time
from dataclasses import dataclass, field
from statistics import median

from teamslam.central.desk.names import in_order
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, open_valid
from teamslam.team.wire.message_order import later_head

LOOK_S = 0.1
APART_S = 1.0  # reported clock difference [s]; longer than any transmission delay
PAST_S = 3600.0  # stamps further than this [s] from the machine's clock are recorded data
DRIFT = 0.1  # relative drift of an offset that is a lag, not a clock


@dataclass
class Member:
    """One node; clock_s: team time less the wall clock; drift: its change per second."""

    alive: bool = False
    status: m.Status | None = None
    clock_s: float | None = None
    drift: float = 0.0
    _clock: tuple[float, float] | None = None
    _first: tuple[float, float] | None = None
    _last: tuple[float, float] | None = None

    def take(self, status: m.Status, wall_ns: int) -> None:
        """Process a status published at the node's wall time."""
        self.status = status
        count = status.figures.get("measurements", status.figures.get("submaps", 0.0))
        self._last = 1e-9 * wall_ns, count
        self._first = self._first or self._last
        measured = status.node.startswith("source/") and status.state == "measuring"
        self.clock_s = 1e-9 * (status.stamp_ns - wall_ns) if measured else None
        if self.clock_s is not None:
            self._clock = began_s, offset_s = self._clock or (1e-9 * wall_ns, self.clock_s)
            lasted_s = 1e-9 * wall_ns - began_s
            self.drift = (self.clock_s - offset_s) / lasted_s if lasted_s > 0.0 else 0.0

    @property
    def rate(self) -> float | None:
        """Measurements (for the centre: submaps) per second."""
        if self._first is None or self._last is None or self._last[0] <= self._first[0]:
            return None
        return (self._last[1] - self._first[1]) / (self._last[0] - self._first[0])


@dataclass
class Presence:
    """Observed team; members by node."""

    members: dict[str, Member] = field(default_factory=dict)
    heads: dict[str, m.StreamHead] = field(default_factory=dict)
    has_ended: bool = False

    def _of(self, node: str) -> Member:
        return self.members.setdefault(node, Member())

    def take(self, bus: Bus, for_s: float) -> None:
        """Observe the team for a time [s]."""
        for channel in (ch.STATUS, ch.HEAD, ch.ROBOT_HEAD, ch.TEAM_END, ch.FINAL_MAP):
            bus.subscribe(channel)
        bus.watch_alive()
        until = time.monotonic() + for_s
        while time.monotonic() < until:
            for sample in bus.receive(LOOK_S):
                for _, _, message in open_valid([sample]):
                    self._take_message(message, sample.wall_ns)

    def _take_message(self, message: m.Message, wall_ns: int) -> None:
        match message:
            case m.Liveliness():
                self._of(message.node).alive = message.alive
            case m.Status():
                self._of(message.node).take(message, wall_ns)
            case m.StreamHead():
                head = self.heads.get(message.robot)
                self.heads[message.robot] = later_head(message, head)
            case m.FusedMap():
                self.has_ended = True

    def is_there(self, node: str) -> bool:
        """Whether the node is alive."""
        return node in self.members and self.members[node].alive

    @property
    def robots(self) -> list[str]:
        """Robots that have, or had, a process or driver."""
        named = (node.partition("/") for node in self.members)
        found = {robot for kind, _, robot in named if kind in ("robot", "source")}
        return in_order(found | self.heads.keys())

    def clocks(self) -> dict[str, float]:
        """Offset [s] of each driver's clock from the team's median."""
        there = {node: each.clock_s for node, each in self.members.items() if each.alive}
        found = {node: clock_s for node, clock_s in there.items() if clock_s is not None}
        middle = median(found.values()) if found else 0.0
        return {node: clock_s - middle for node, clock_s in found.items()}

    def advice(self) -> list[str]:
        """Describe waiting nodes and remedies."""
        advice = []
        if self.has_ended:
            advice.append("the final map is out: the team has ended")
        if not self.is_there("central"):
            advice.append(
                "no centre: robots go on mapping, their maps are not joined; start teamslam central"
            )
        for robot in [] if self.is_there("world") else self.robots:
            advice += self._of_robot(robot)
        clocks = self.clocks()
        for node in in_order(clocks):
            ahead_s = clocks[node]
            if abs(ahead_s) > APART_S and len(clocks) > 1:
                way = "ahead of" if ahead_s > 0 else "behind"
                remedy = _remedy(self.members[node], behind=ahead_s < 0.0)
                advice.append(f"{node} stamps {abs(ahead_s):.1f} s {way} the others: {remedy}")
        told = ((n, s) for n in in_order(self.members) if (s := self.members[n].status) is not None)
        alive = ((node, status) for node, status in told if self.is_there(node))
        return advice + [f"{node}: {each}" for node, status in alive for each in status.warnings]

    def _of_robot(self, robot: str) -> list[str]:
        has_driver, head = self.is_there(ch.source_node(robot)), self.heads.get(robot)
        ended = head is not None and head.state == "ended"
        advice = []
        if not self.is_there(ch.robot_node(robot)):
            advice.append(
                f"{robot} has no process: its driver keeps what it measures; start "
                f"teamslam robot SCENARIO {robot}, or go on by teamslam end --without {robot}"
            )
        if not (has_driver or ended or self.has_ended):
            resumed = "" if head is None else f" after measurement {head.measurements - 1}"
            advice.append(
                f"{robot} has no driver{resumed}: start it, or end the team by teamslam end, or go "
                f"on by teamslam end --without {robot}"
            )
        return advice


def _remedy(member: Member, *, behind: bool) -> str:
    if abs(member.clock_s or 0.0) > PAST_S:
        if not behind:
            return "recorded data, of which the others began later or go slower; the map waits"
        return (
            "recorded data, which began later or go slower: the map waits for them; a program that "
            "is started again need not begin anew, but may go on after robot.last_time"
        )
    if behind and abs(member.drift) > DRIFT:
        way = "catches up" if member.drift > 0.0 else "falls further behind"
        return (
            f"it lags and {way}: its program delivers old measurements; started again, it may go "
            "on after robot.last_time"
        )
    remedy = "set its machine's clock (NTP, PTP), or stamp with the clock that the others have"
    return remedy + ("; or its program lags behind its measurements" if behind else "")
