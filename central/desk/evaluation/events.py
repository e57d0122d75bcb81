"""Detect a team's events."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

from teamslam.central.desk.names import in_order, not_joined, short, without_decimals
from teamslam.central.diagnosis import describe
from teamslam.team.wire import messages as m
from teamslam.team.wire.channels import robot_node

Kind = Literal[
    "joined", "restarted", "lost", "left", "map", "closure", "undone", "withdrawn", "refused",
    "warning", "done",
]  # fmt: skip
MOST = 2000  # most events of a run
FIRST = 1
CENTRAL = "central"
_AWAITED = ("waiting for ", "has not appeared yet", "no measurements of this team yet")
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


Found = Iterator[tuple[Kind, str, str]]  # kind, node and text of each event


@dataclass
class EventDetector:
    """Convert ordered messages into events, each once."""

    _alive: dict[str, bool] = field(default_factory=dict)
    _incarnations: dict[str, int] = field(default_factory=dict)
    _done: set[str] = field(default_factory=set)
    _members: set[str] = field(default_factory=set)
    _withdrawn: set[str] = field(default_factory=set)
    _reasons: dict[str, str] = field(default_factory=dict)
    _said: set[str] = field(default_factory=set)  # gists of all reasons of maps
    _joined: set[str] = field(default_factory=set)
    _apart: set[str] = field(default_factory=set)
    _decided: set[tuple[int, str, str]] = field(default_factory=set)
    _warned: set[tuple[str, str]] = field(default_factory=set)
    _refused: int = 0
    _ended: bool = False

    def take(self, message: m.Message, now_ns: int) -> list[Event]:
        """Detect the events of a message at a team time."""
        return [Event(now_ns, *found) for found in self._events(message)]

    def _events(self, message: m.Message) -> Found:
        match message:
            case m.Liveliness():
                yield from self._liveliness(message)
            case m.Configuration():
                if self._alive.get(message.node) is False and message.node.startswith("robot/"):
                    name = message.node.removeprefix("robot/")
                    yield "restarted", message.node, f"{name} announces itself again"
            case m.InitialPose():
                before = self._incarnations.get(message.robot, FIRST)
                self._incarnations[message.robot] = max(before, message.incarnation)
                if message.incarnation > before:
                    text = f"the stream of {message.robot} begins anew, incarnation "
                    yield "restarted", robot_node(message.robot), f"{text}{message.incarnation}"
            case m.Done() if (node := robot_node(message.robot)) not in self._done:
                self._done.add(node)
                text = (
                    f"{message.robot} has taken all its {message.measurements:,} measurements, "
                    f"{message.submaps} submaps"
                )
                yield "done", node, text
            case m.End() if not self._ended:
                self._ended = True
                for note in message.notes:
                    yield "warning", "world", note
                yield "done", "world", "the world has ended"
            case m.Withdrawal() if message.robot not in self._withdrawn:
                self._withdrawn.add(message.robot)
                by = "centre" if message.by == "central" else message.by
                text = f"{message.robot} is withdrawn by the {by}: {message.reason}"
                yield "withdrawn", robot_node(message.robot), text
            case m.FusedMap():
                yield from self._map(message)
            case m.Status():
                yield from self._status(message)

    def _liveliness(self, message: m.Liveliness) -> Found:
        node, name = message.node, message.node.removeprefix("robot/")
        before = self._alive.get(node)
        self._alive[node] = message.alive
        if before is message.alive:
            return
        if message.alive and before is None:
            yield "joined", node, f"{name} joined"
        elif message.alive:
            yield "restarted", node, f"{name} came back"
        elif node in self._done or self._ended:
            yield "left", node, f"{name} left"
        else:
            yield "lost", node, f"{name} was lost"

    def _map(self, fused: m.FusedMap) -> Found:
        apart = {
            name: f"{who} not joined: {why}"
            for who, why in not_joined(fused.reasons)
            for name in who.split(", ")
        }
        members = {member.robot for member in fused.members} - apart.keys()
        for robot in in_order(members - self._members):
            yield "map", robot_node(robot), f"{robot} is in the team's map"
        for robot in in_order((self._members & {*fused.withdrawn}) - self._withdrawn):
            yield "withdrawn", robot_node(robot), f"{robot} was withdrawn from the map"
        self._members = members
        for each in fused.decisions:
            name = (each.stamp_ns, each.kind, each.about)
            if each.kind != "waits" and name not in self._decided:
                self._decided.add(name)
                kind: Kind = "undone" if each.kind == "undone" else "closure"
                yield kind, "central", _describe_decision(each)
        for words in fused.joined:
            if words not in self._joined:
                yield "map", "central", short(words)
        self._joined |= {*fused.joined}
        for words in dict.fromkeys(apart[name] for name in in_order(apart.keys() - self._apart)):
            yield "warning", "central", words
        self._apart = {*apart}
        said = (*map(describe, fused.diagnosis), *fused.reasons)
        reasons = {without_decimals(each): each for each in said if not _is_apart(each)}
        for shape in sorted(reasons.keys() - self._reasons.keys()):
            if shape in self._said or (CENTRAL, shape) not in self._warned:
                yield "warning", "central", reasons[shape]
        for shape in sorted(self._reasons.keys() - reasons.keys()):
            yield "map", "central", f"no longer: {self._reasons[shape]}"
        self._reasons = reasons
        self._said |= reasons.keys()
        if fused.final:
            self._done |= set(self._alive)
            yield "done", "central", f"final map of {len(fused.ids) // 4} landmarks"

    def _status(self, status: m.Status) -> Found:
        refused = int(status.figures.get("refused", 0.0))
        if refused > self._refused and status.node == CENTRAL:
            yield "refused", "central", f"the centre refused {refused - self._refused} submaps"
            self._refused = refused
        for warning in status.warnings:
            gist = (status.node, without_decimals(warning))
            if gist in self._warned or is_awaited(warning) or _is_apart(warning):
                continue
            self._warned.add(gist)
            if status.node == CENTRAL and gist[1] in self._said:
                continue
            kind: Kind = "refused" if "refused" in warning else "warning"
            yield kind, status.node, f"{status.node}: {warning}"


def _describe_decision(decision: m.AssociationDecision) -> str:
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
