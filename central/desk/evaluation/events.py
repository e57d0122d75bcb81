"""The events of a run in words: who came and went, what was joined, refused, warned of."""

import re
from dataclasses import dataclass, field

from team.wire import channels as ch
from team.wire import messages as m

KINDS = ("came", "lost", "restarted", "map", "warning", "ended")
MOST = 2000
"""Events that are kept; a node that warns of something new every second says no more by then."""
_FIGURE = re.compile(r"\d+\.\d+")
_AWAITED = ("waiting for ", "has not appeared yet", "no readings of this team yet")
"""Nobody is there at once: that is no event."""


@dataclass(frozen=True)
class Event:
    """Something that happened: team time [ns], of which node, one of KINDS, in words."""

    stamp_ns: int
    node: str
    kind: str
    text: str


@dataclass
class EventLog:
    """Takes the messages of a log in its order; `events` in the order of team time."""

    found: list[Event] = field(default_factory=list)
    alive: dict[str, bool] = field(default_factory=dict)
    epochs: dict[str, int] = field(default_factory=dict)
    joined: dict[str, int] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    warned: set[tuple[str, str]] = field(default_factory=set)
    done: set[str] = field(default_factory=set)

    @property
    def events(self) -> tuple[Event, ...]:
        """All of them; equal times in the order of the log."""
        return tuple(sorted(self.found, key=lambda event: event.stamp_ns))

    def take(self, channel: ch.Channel, name: str, message: m.Message) -> None:
        """Take one message; most are no event."""
        match message:
            case m.Liveliness():
                self._take_liveliness(message)
            case m.Configured() if channel is ch.ROBOT_CONFIG:
                self._take_epoch(message)
            case m.Start() if message.epoch > self.epochs.get(message.robot, message.epoch):
                self.epochs[message.robot] = message.epoch
                text = f"its stream of readings begins anew, epoch {message.epoch}"
                self._add(message.stamp_ns, message.robot, "restarted", text)
            case m.Start():
                self.epochs[message.robot] = message.epoch
            case m.FusedMap():
                self._take_map(message)
            case m.Status():
                self._take_status(name, message)
            case m.Done():
                self._take_done(message)
            case m.End():
                for note in message.notes:
                    self._add(message.stamp_ns, "world", "warning", note)
                self._add(message.stamp_ns, "world", "ended", "every reading is published")
            case _:
                pass

    def _add(self, stamp_ns: int, node: str, kind: str, text: str) -> None:
        if len(self.found) < MOST:
            self.found.append(Event(stamp_ns, node.removeprefix("robot/"), kind, text))

    def _take_liveliness(self, message: m.Liveliness) -> None:
        node, before = message.node, self.alive.get(message.node)
        self.alive[node] = message.alive
        if before == message.alive:
            return
        if message.alive:
            again = before is False
            kind, text = ("restarted", "is there again") if again else ("came", "is there")
        elif node in self.done:
            return
        else:
            kind, text = "lost", "is lost"
        self._add(message.stamp_ns, node, kind, text)

    def _take_epoch(self, message: m.Configured) -> None:
        """A robot announces its configuration once per life of its process."""
        if self.alive.get(message.node) is False:
            self._add(message.stamp_ns, message.node, "restarted", "announces itself again")

    def _take_map(self, fused: m.FusedMap) -> None:
        """What a map says of who is in it, where that changes."""
        for member in fused.members:
            if member.robot not in self.joined:
                self.joined[member.robot] = member.sequence
                text = f"its submaps are in the team's map, frame {fused.frame or '–'}"
                self._add(fused.stamp_ns, member.robot, "map", text)
        said = {without_figures(reason): reason for reason in fused.reasons}
        for shape in sorted(said.keys() - self.reasons.keys()):
            self._add(fused.stamp_ns, "central", "map", said[shape])
        for shape in sorted(self.reasons.keys() - said.keys()):
            self._add(fused.stamp_ns, "central", "map", f"no longer: {self.reasons[shape]}")
        self.reasons = said
        if fused.final:
            text = f"the final map, {len(fused.ids) // 4} landmarks"
            self._add(fused.stamp_ns, "central", "ended", text)
            self.done |= set(self.alive)

    def _take_status(self, node: str, status: m.Status) -> None:
        """A warning once, whatever the figures in it; that someone is awaited is none."""
        for warning in status.warnings:
            name = (node, without_figures(warning))
            awaited = any(text in warning for text in _AWAITED)
            if name not in self.warned and not awaited:
                self.warned.add(name)
                self._add(status.stamp_ns, node, "warning", warning)

    def _take_done(self, done: m.Done) -> None:
        node = ch.robot_node(done.robot)
        if node not in self.done:
            self.done.add(node)
            text = f"has used its {done.readings:,} readings, {done.submaps} submaps"
            self._add(done.stamp_ns, node, "ended", text)


def without_figures(text: str) -> str:
    """The text without its decimals: the same finding with other figures is nothing new."""
    return _FIGURE.sub("#", text)
