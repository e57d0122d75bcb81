"""Detect a team's events."""

from dataclasses import dataclass, field
from typing import Literal

from teamslam.central.desk.names import in_order, not_joined, short, without_decimals
from teamslam.central.diagnosis import describe
from teamslam.team.wire import messages as m
from teamslam.team.wire.channels import robot_node

Kind = Literal[
    "joined",
    "restarted",
    "lost",
    "left",
    "map",
    "closure",
    "undone",
    "withdrawn",
    "refused",
    "warning",
    "done",
]
MOST = 2000
"""Most events of a run."""
FIRST = 1
_AWAITED = (
    "waiting for ",
    "has not appeared yet",
    "no measurements of this team yet",
)
"""Start-up states of a node, which are no events."""


@dataclass(frozen=True)
class Event:
    """One event at a team time."""

    stamp_ns: int
    kind: Kind
    node: str
    text: str

    @property
    def of(self) -> str:
        """Robot name, or the node's name."""
        return self.node.removeprefix("robot/")


@dataclass
class EventDetector:
    """Convert a run's ordered messages into events, each once."""

    _alive: dict[str, bool] = field(default_factory=dict)
    _incarnations: dict[str, int] = field(default_factory=dict)
    _done: set[str] = field(default_factory=set)
    _members: set[str] = field(default_factory=set)
    _withdrawn: set[str] = field(default_factory=set)
    _reasons: dict[str, str] = field(default_factory=dict)
    _joined: set[str] = field(default_factory=set)
    _apart: set[str] = field(default_factory=set)
    _decided: set[tuple[int, str, str]] = field(default_factory=set)
    _warned: set[tuple[str, str]] = field(default_factory=set)
    _refused: int = 0
    _ended: bool = False

    def take(self, message: m.Message, now_ns: int) -> list[Event]:
        """Detect the events of a message at team time `now_ns`."""
        match message:
            case m.Liveliness():
                return self._liveliness(message, now_ns)
            case m.Configuration():
                return self._configured(message, now_ns)
            case m.InitialPose():
                return self._incarnation(message, now_ns)
            case m.Done() if robot_node(message.robot) not in self._done:
                node = robot_node(message.robot)
                self._done.add(node)
                text = (
                    f"{message.robot} has taken all its {message.measurements:,} measurements, "
                    f"{message.submaps} submaps"
                )
                return [Event(now_ns, "done", node, text)]
            case m.End() if not self._ended:
                self._ended = True
                notes = [Event(now_ns, "warning", "world", note) for note in message.notes]
                return [*notes, Event(now_ns, "done", "world", "the world has ended")]
            case m.Withdrawal() if message.robot not in self._withdrawn:
                self._withdrawn.add(message.robot)
                by = "centre" if message.by == "central" else message.by
                text = f"{message.robot} is withdrawn by the {by}: {message.reason}"
                return [Event(now_ns, "withdrawn", robot_node(message.robot), text)]
            case m.FusedMap():
                return self._map(message, now_ns)
            case m.Status():
                return self._status(message, now_ns)
            case _:
                return []

    def _liveliness(self, message: m.Liveliness, now_ns: int) -> list[Event]:
        node, name = message.node, message.node.removeprefix("robot/")
        before = self._alive.get(node)
        self._alive[node] = message.alive
        if before is message.alive:
            return []
        if message.alive:
            if before is None:
                return [Event(now_ns, "joined", node, f"{name} joined")]
            return [Event(now_ns, "restarted", node, f"{name} came back")]
        if node in self._done or self._ended:
            return [Event(now_ns, "left", node, f"{name} left")]
        return [Event(now_ns, "lost", node, f"{name} was lost")]

    def _configured(self, message: m.Configuration, now_ns: int) -> list[Event]:
        if self._alive.get(message.node) is not False or not message.node.startswith("robot/"):
            return []
        name = message.node.removeprefix("robot/")
        return [Event(now_ns, "restarted", message.node, f"{name} announces itself again")]

    def _incarnation(self, start: m.InitialPose, now_ns: int) -> list[Event]:
        before = self._incarnations.get(start.robot, FIRST)
        self._incarnations[start.robot] = max(before, start.incarnation)
        if start.incarnation <= before:
            return []
        text = f"the stream of {start.robot} begins anew, incarnation {start.incarnation}"
        return [Event(now_ns, "restarted", robot_node(start.robot), text)]

    def _map(self, fused: m.FusedMap, now_ns: int) -> list[Event]:
        apart = {
            name: f"{who} not joined: {why}"
            for who, why in not_joined(fused.reasons)
            for name in who.split(", ")
        }
        members = {member.robot for member in fused.members} - apart.keys()
        events = [
            Event(now_ns, "map", robot_node(robot), f"{robot} is in the team's map")
            for robot in in_order(members - self._members)
        ]
        events += [
            Event(now_ns, "withdrawn", robot_node(robot), f"{robot} was withdrawn from the map")
            for robot in in_order((self._members & {*fused.withdrawn}) - self._withdrawn)
        ]
        self._members = members
        events += self._decisions(fused, now_ns)
        events += [
            Event(now_ns, "map", "central", short(words))
            for words in fused.joined
            if words not in self._joined
        ]
        self._joined |= {*fused.joined}
        new = dict.fromkeys(apart[name] for name in in_order(apart.keys() - self._apart))
        events += [Event(now_ns, "warning", "central", words) for words in new]
        self._apart = {*apart}
        said = (*map(describe, fused.diagnosis), *fused.reasons)
        reasons = {without_decimals(each): each for each in said if not _is_apart(each)}
        events += [
            Event(now_ns, "warning", "central", reasons[shape])
            for shape in sorted(reasons.keys() - self._reasons.keys())
        ]
        events += [
            Event(now_ns, "map", "central", f"no longer: {self._reasons[shape]}")
            for shape in sorted(self._reasons.keys() - reasons.keys())
        ]
        self._reasons = reasons
        if fused.final:
            count = len(fused.ids) // 4
            events.append(Event(now_ns, "done", "central", f"final map of {count} landmarks"))
            self._done |= set(self._alive)
        return events

    def _decisions(self, fused: m.FusedMap, now_ns: int) -> list[Event]:
        events = []
        for each in fused.decisions:
            name = (each.stamp_ns, each.kind, each.about)
            if each.kind == "waits" or name in self._decided:
                continue
            self._decided.add(name)
            kind: Kind = "undone" if each.kind == "undone" else "closure"
            events.append(Event(now_ns, kind, "central", decision_words(each)))
        return events

    def _status(self, status: m.Status, now_ns: int) -> list[Event]:
        events = []
        refused = int(status.figures.get("refused", 0.0))
        if refused > self._refused and status.node == "central":
            text = f"the centre refused {refused - self._refused} submaps"
            events.append(Event(now_ns, "refused", "central", text))
            self._refused = refused
        for warning in status.warnings:
            gist = (status.node, without_decimals(warning))
            if gist in self._warned or is_awaited(warning) or _is_apart(warning):
                continue
            self._warned.add(gist)
            kind: Kind = "refused" if "refused" in warning else "warning"
            events.append(Event(now_ns, kind, status.node, f"{status.node}: {warning}"))
        return events


def decision_words(decision: m.AssociationDecision) -> str:
    """Describe a closure or merge with its figures."""
    figures = (
        f"{decision.pairs} landmarks, log-likelihood ratio {decision.llr:.0f} against "
        f"{decision.rival_llr:.0f}, share {decision.share:.2f}, {decision.absent} absent"
    )
    if decision.kind == "undone":
        return f"a closure of {decision.about} is undone: {decision.why} ({figures})"
    if decision.kind == "waits":
        return f"{decision.about} wait: {decision.why} ({figures})"
    what = "merged by their maps" if decision.kind == "merge" else "closed a loop"
    return f"{decision.about} {what}: {figures}"


def is_awaited(warning: str) -> bool:
    """Whether a warning is a start-up state."""
    return any(text in warning for text in _AWAITED)


def _is_apart(reason: str) -> bool:
    return any(not_joined([reason]))
