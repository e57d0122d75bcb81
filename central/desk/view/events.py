"""What happens to a team, in words: who joined, was lost, was refused, and what nodes warn of."""

import re
from dataclasses import dataclass, field
from typing import Literal

from team.wire import messages as m

Kind = Literal["joined", "lost", "left", "map", "withdrawn", "refused", "warning", "done"]


@dataclass(frozen=True)
class Event:
    """One event at a team time; node: whom it is about."""

    stamp_ns: int
    kind: Kind
    node: str
    text: str


@dataclass
class Chronicle:
    """Turns messages into events; each is told once, when it happens."""

    _alive: dict[str, bool] = field(default_factory=dict)
    _done: set[str] = field(default_factory=set)
    _members: set[str] = field(default_factory=set)
    _withdrawn: set[str] = field(default_factory=set)
    _reasons: set[str] = field(default_factory=set)
    _warnings: dict[str, set[str]] = field(default_factory=dict)
    _refused: int = 0
    _begun: bool = False
    _ended: bool = False

    def take(self, message: m.Message, now_ns: int) -> list[Event]:
        """The events that a message brings; `now_ns` is the team time."""
        self._begun = self._begun or isinstance(message, m.PoseEstimate | m.Truth | m.FusedMap)
        match message:
            case m.Liveliness():
                return self._liveliness(message, now_ns)
            case m.Done():
                self._done.add(f"robot/{message.robot}")
                text = f"{message.robot} used all its {message.readings} readings"
                return [Event(now_ns, "done", f"robot/{message.robot}", text)]
            case m.End():
                self._ended = True
                notes = "".join(f"; {note}" for note in message.notes)
                return [Event(now_ns, "done", "world", f"the world has ended{notes}")]
            case m.Withdrawal() if message.robot not in self._withdrawn:
                self._withdrawn.add(message.robot)
                by = "centre" if message.by == "central" else message.by
                text = f"{message.robot} is withdrawn by the {by}: {message.reason}"
                return [Event(now_ns, "withdrawn", f"robot/{message.robot}", text)]
            case m.FusedMap():
                return self._map(message, now_ns)
            case m.Status():
                return self._status(message, now_ns)
            case m.Start() if message.epoch > 1:
                text = f"{message.robot} began life {message.epoch} of its stream"
                return [Event(now_ns, "joined", f"robot/{message.robot}", text)]
            case _:
                return []

    def _liveliness(self, message: m.Liveliness, now_ns: int) -> list[Event]:
        node, name = message.node, message.node.removeprefix("robot/")
        before = self._alive.get(node)
        self._alive[node] = message.alive
        if before is message.alive:
            return []
        if message.alive:
            text = f"{name} joined" if before is None else f"{name} came back"
            return [Event(now_ns, "joined", node, text)]
        if node in self._done or self._ended:
            return [Event(now_ns, "left", node, f"{name} left")]
        return [Event(now_ns, "lost", node, f"{name} was lost")]

    def _map(self, fused: m.FusedMap, now_ns: int) -> list[Event]:
        members = {member.robot for member in fused.members}
        events = [
            Event(now_ns, "map", f"robot/{robot}", f"{robot} is in the team's map")
            for robot in sorted(members - self._members)
        ]
        events += [
            Event(now_ns, "withdrawn", f"robot/{robot}", f"{robot} was withdrawn from the map")
            for robot in sorted((self._members & {*fused.withdrawn}) - self._withdrawn)
        ]
        self._members = members
        events += [
            Event(now_ns, "warning", "central", reason)
            for reason in fused.reasons
            if reason not in self._reasons
        ]
        self._reasons = set(fused.reasons)
        if fused.final:
            count = len(fused.ids) // 4
            events.append(Event(now_ns, "done", "central", f"final map of {count} landmarks"))
        return events

    def _status(self, status: m.Status, now_ns: int) -> list[Event]:
        events = []
        refused = int(status.figures.get("refused", 0.0))
        if refused > self._refused and status.node == "central":
            text = f"the centre refused {refused - self._refused} submaps"
            events.append(Event(now_ns, "refused", "central", text))
            self._refused = refused
        if not self._begun:  # everyone says whom they wait for
            return events
        said = self._warnings.setdefault(status.node, set())
        for warning in status.warnings:
            gist = re.sub(r"[\d.]+", "#", warning)  # a figure that moves is no news
            if gist not in said:
                said.add(gist)
                kind: Kind = "refused" if "refused" in warning else "warning"
                events.append(Event(now_ns, kind, status.node, f"{status.node}: {warning}"))
        return events
