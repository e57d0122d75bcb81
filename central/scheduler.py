"""When a map is due: the one scheduler of every fusion rule.

Team time is cut into ticks, whose submaps are folded together, and into broadcasts. A running map
is *closed* where every input up to its time has arrived, else *provisional*; the *final* one comes
at the end. The rule (`central.rule`) makes the map, its intake (`central.intake`) collects the
inputs.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from central.attendance import TeamAttendance
from central.intake import Inputs, Instant
from central.rule import FusionRule, Tail
from team.estimation.contribution import Stream
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing

PATIENCE = 3.0
"""Number of broadcasts, or of ticks where these are longer, after which a map goes out
provisionally although a robot has stalled."""


class Scheduler:
    """Asks one rule for its maps; `intake` is the rule's own."""

    def __init__(self, rule: FusionRule[Any]) -> None:
        self.rule = rule
        self.intake = rule.intake(rule.config, rule.team)
        self.warnings = self.intake.warnings
        rule.warnings = self.warnings
        self._tick_ns = round(rule.config.tick_s * 1e9)
        self._period_ns = rule.config.broadcast_s * 1e9
        self._patience_ns = PATIENCE * 1e9 * max(rule.config.broadcast_s, rule.config.tick_s)
        self._fused_ns: int | None = None
        self._quiet_ns: int | None = None
        self._published: Mapping[Stream, int] = {}
        self._announced: dict[str, str] = {}
        self._compared: tuple[Mapping[Stream, int], Mapping[Stream, int], bool] = ({}, {}, False)

    def admit(self, robot: str) -> None:
        """Add a robot to the team."""
        self.rule.admit(robot)

    def advance(self, attendance: TeamAttendance) -> list[Outgoing]:
        """The maps that are due at the instants until now."""
        return [each for instant in self.intake.instants(attendance) for each in self.at(instant)]

    def refresh(self, attendance: TeamAttendance) -> list[Outgoing]:
        """A map of everything that is here, at once, if the last one lacks something.

        It waits for no tick's end and no teammate: what lies ahead of the watermark is provisional.
        Rules with a clock of their own have none.
        """
        if self.intake.due != "news" or not self._is_news(math.inf):
            return []
        out: list[Outgoing] = []
        for instant in self.intake.instants(attendance):
            out += self.rule.take(instant.inputs)
            out += self._whole(instant.inputs)
        return out

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The last messages, the final map after all others."""
        return self._fused(self.intake.inputs(math.inf, now_ns), "final")

    def at(self, instant: Instant[Any]) -> list[Outgoing]:
        """Fold what is closed at an instant; returns a map if one is due."""
        inputs, now_ns = instant.inputs, instant.now_ns
        out = self.rule.take(inputs)
        convictions = self._convictions(now_ns)
        if convictions or self._is_due(instant):
            return [*out, *convictions, *self._newest(inputs)]
        if self.intake.due == "news" and self.intake.members(math.inf):
            if self._quiet_ns is None:
                self._quiet_ns = now_ns
            if now_ns - self._quiet_ns >= self._patience_ns and self._is_news(math.inf):
                return [*out, *self._fused(inputs, "provisional")]
        return out

    def _is_due(self, instant: Instant[Any]) -> bool:
        due = self.intake.due
        if due == "now":
            return True
        last_ns = instant.since_ns if self._fused_ns is None else self._fused_ns
        if last_ns is not None and instant.now_ns - last_ns < self._period_ns:
            return False
        return due == "period" or self._is_news(instant.inputs.closed_ns)

    def _is_news(self, until_ns: float) -> bool:
        """Whether an input up to this time is missing in the last map."""
        members = self._members(until_ns)
        published, of, found = self._compared
        if published is not self._published or of is not members:
            found = _lacks(self._published, members)
            self._compared = self._published, members, found
        return found

    def _members(self, until_ns: float) -> Mapping[Stream, int]:
        """The inputs up to this time, as a map names them."""
        gone, found = self._left_out, self.intake.members(until_ns)
        return {s: n for s, n in found.items() if s[0] not in gone} if gone else found

    @property
    def _left_out(self) -> Collection[str]:
        """The robots that maps are without: withdrawn ones, and suspended ones."""
        suspended = self.rule.suspended
        return {*self.intake.withdrawn, *suspended} if suspended else self.intake.withdrawn

    def _newest(self, inputs: Inputs) -> list[Outgoing]:
        """The map of the closed ticks, or of everything that is here if that is more.

        A teammate's new submap is worth most to robots that measure the same landmarks, so it does
        not wait for the end of its tick. And no map has less than the one before it: submaps ahead
        of the watermark are in a provisional map and not yet in a closed one.
        """
        whole = self._members(self._ticks_end_ns(inputs.closed_ns))
        gone = self._left_out
        published = {s: n for s, n in self._published.items() if s[0] not in gone}
        if _lacks(whole, published) or _lacks(whole, self._members(inputs.closed_ns)):
            return self._whole(inputs)
        return self._fused(replace(inputs, ahead=False), "closed")

    def _whole(self, inputs: Inputs) -> list[Outgoing]:
        """The map of everything that is here, closed if nothing of it is ahead of the watermark."""
        ahead = _lacks(self._members(inputs.closed_ns), self._members(math.inf))
        return self._fused(inputs, "provisional" if ahead else "closed")

    def _ticks_end_ns(self, closed_ns: float) -> float:
        """The end of the last tick that is over; a tick has the submaps that end in (a, b]."""
        return closed_ns if math.isinf(closed_ns) else closed_ns // self._tick_ns * self._tick_ns

    def _fused(self, inputs: Inputs, tail: Tail) -> list[Outgoing]:
        """A map and the messages that go out with it, after the withdrawals that it causes."""
        out = self.rule.fuse(inputs, tail)
        self._fused_ns = self._quiet_ns = inputs.now_ns
        maps = [each.message for each in out if isinstance(each.message, m.FusedMap)]
        if maps:
            members = maps[-1].members
            self._published = {(x.robot, x.incarnation): x.sequence for x in members}
        return [*self._convictions(inputs.now_ns), *out]

    def _convictions(self, now_ns: int) -> list[Outgoing]:
        """The robots that the fold has withdrawn since the last call; late inputs may take a
        withdrawal back.
        """
        found = self.rule.convicted
        self.intake.withdrawn = tuple(sorted(self.intake.orders | found.keys()))
        for robot in sorted(self._announced.keys() - found.keys()):
            del self._announced[robot]
            self.warnings.append(f"{robot} is withdrawn no more: what came late speaks for it")
        new = [robot for robot in found if robot not in self._announced]
        self._announced |= found
        self.warnings += [f"{robot} withdrawn by central: {found[robot]}" for robot in new]
        return [
            Outgoing(
                ch.WITHDRAWAL,
                robot,
                m.Withdrawal(stamp_ns=now_ns, robot=robot, by="central", reason=found[robot]),
            )
            for robot in new
        ]


def _lacks(members: Mapping[Stream, int], of: Mapping[Stream, int]) -> bool:
    """Whether the first version vector lacks an input of the other."""
    return any(members.get(stream, -1) < last for stream, last in of.items())
