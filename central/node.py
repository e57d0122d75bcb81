"""The centre's node: messages in, messages out; no I/O, no clock.

It subscribes to the inputs of its rule (submaps, own maps or raw measurements), to progress and
liveliness, and to nothing that contains the fused map.
"""

from collections.abc import Collection, Iterable, Sequence

import msgspec

from central.attendance import TeamAttendance
from central.config import CentralConfig
from central.fused import fused_message
from central.rule import final_of, rule_of
from central.scheduler import Scheduler
from team.door import Door, absurd
from team.estimation.gaussian import NO_LANDMARKS
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import decoded, encoded
from team.wire.digest import configured

MOST_ROBOTS = 100
"""Most robots of a team, admitted ones included."""


class CentralNode:
    """The node of the centre: call `begin`, then `handle` for every message, until `finished`.

    announcement: its configuration, which its maps name by the digest. admit: a robot that the
    scenario does not name joins the team when it, or its driver, appears.
    """

    def __init__(
        self, config: CentralConfig, robots: Sequence[str], *, admit: bool = False
    ) -> None:
        self.config = config
        self._admits = admit
        self._admitted: list[str] = []
        self.announcement = configured("central", 0, 0, config)
        self._door = Door(robots)
        self._attendance = TeamAttendance.of(robots)
        self._rule = rule_of(config, self.announcement.digest, sorted(robots))
        self._scheduler = Scheduler(self._rule)
        self._intake = self._scheduler.intake
        self._broadcasts = 0
        self._newest: m.FusedMap | None = None
        self._credit: list[Outgoing] | None = None
        self._concluding = False
        self.finished = False
        self.final: m.FusedMap | None = None

    @property
    def listens(self) -> tuple[ch.Channel, ...]:
        """The channels to subscribe to."""
        own = (ch.ROBOT_PROGRESS, ch.ROBOT_DONE, ch.END, ch.GIVEN_UP, ch.HEAD, ch.ROBOT_HEAD,
               ch.END_ORDER)  # fmt: skip
        others = (ch.ROBOT_CONFIG,) if self._admits else ()
        return tuple(dict.fromkeys((*self._intake.listens, *own, *others)))

    @property
    def warnings(self) -> list[str]:
        """What went wrong, in words, the newest last."""
        return self._scheduler.warnings

    def begin(self) -> list[Outgoing]:
        """The first messages of the node: its configuration."""
        return [Outgoing(ch.CENTRAL_CONFIG, "", self.announcement)]

    def refusal(self, message: m.Message) -> str | None:
        """Why a message can not be true of this team: its robots, counters, stamps, or its end."""
        self._admit(message)
        refused = self._door.refusal(message)
        if refused is None and isinstance(message, m.End):
            refused = self._attendance.contradicts(message)
            if refused is not None:
                self._attendance.note_end(message)
                # Where the robots' last words confirm it, nothing may come behind it.
                refused = None if self._attendance.concluded(self._intake.dealt) else refused
        return refused

    def _admit(self, message: m.Message) -> None:
        """Admit a robot that announces itself, or whose driver begins its stream."""
        robot = message.robot if isinstance(message, m.InitialPose) else None
        if isinstance(message, m.Configuration):
            robot = ch.robot_of(message.node)
        if not self._admits or robot is None or robot in self._attendance.robots or absurd(message):
            return
        if len(self._attendance.robots) < MOST_ROBOTS:
            for admits in (self._door, self._attendance, self._scheduler):
                admits.admit(robot)
            self._admitted.append(robot)

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; `now_ns` is the team time of its arrival (unused: stamps are time)."""
        if isinstance(message, m.FusedMap):
            return self._take_final(message)
        self._credit = None
        known = self._attendance.ordered
        self._attendance.take(message)
        if isinstance(message, m.TeamEnd):  # a node that joins later gets it from the centre
            repeated = [] if known else [Outgoing(ch.TEAM_END, "", message)]
            return repeated + self._advance()
        self._credit = self._intake.take(message, self._attendance.now_ns)
        return self._advance() + self._credit  # the credit comes after the map that it gave

    def set_aside(self, message: m.Message, why: str) -> list[Outgoing]:
        """Continue behind a message whose handling raised an exception: its sender gets the credit.

        One that the rule could not take counts as refused. A running map that raises takes nothing
        from the final one; where that can not be computed, the newest map that could is the final
        one, provisional and with the reason.
        """
        out, self._credit = self._credit, []
        self._attendance.note_change(message)
        if out is None:
            out = self._intake.refuse(message, why, self._attendance.now_ns)
        if self.finished or not self._is_over:
            return out
        return out + (self._conclude_anyway(why) if self._concluding else self._conclude())

    def _take_final(self, final: m.FusedMap) -> list[Outgoing]:
        """Take the final map that an earlier process of this centre has published."""
        if final.final and not self.finished:
            self.finished, self.final = True, final
        return []

    @property
    def robots(self) -> Collection[str]:
        """The robots of the team."""
        return self._attendance.robots.keys()

    @property
    def awaited(self) -> list[str]:
        """The robots that are not there and that the final map waits for."""
        return [] if self.finished else self._attendance.awaited(self._intake.dealt)

    @property
    def ends(self) -> bool:
        """Whether all streams have ended, as the world or their drivers have announced."""
        return self._attendance.end is not None

    def _advance(self) -> list[Outgoing]:
        if self.finished:
            return []
        self._attendance.withdrawn = frozenset(self._intake.withdrawn)
        out = self._counted(self._scheduler.advance(self._attendance))
        return out + self._conclude() if self._is_over else out

    def _counted(self, out: list[Outgoing]) -> list[Outgoing]:
        maps = [o.message for o in out if isinstance(o.message, m.FusedMap)]
        self._broadcasts += bool(maps)
        self._newest = maps[-1] if maps else self._newest
        return out

    def refresh(self) -> list[Outgoing]:
        """A map of all that is here, if the last one lacks something; for when there is time."""
        return [] if self.finished else self._counted(self._scheduler.refresh(self._attendance))

    @property
    def _is_over(self) -> bool:
        """The streams have ended, and nobody and nothing of them is waited for."""
        return self._attendance.concluded(self._intake.dealt) and self._intake.complete

    def _conclude_anyway(self, why: str) -> list[Outgoing]:
        newest = self._newest
        if newest is None:
            digest, now_ns = self.announcement.digest, self._attendance.now_ns
            newest = fused_message(
                self.config, digest, NO_LANDMARKS, (), stamp_ns=now_ns, joint=False
            )
        reasons = (*newest.reasons, f"not the final map, which raised: {why}")
        lost = tuple(self._attendance.missing(self._intake.dealt))
        final = msgspec.structs.replace(
            newest, final=True, provisional=True, reasons=reasons, lost=lost
        )
        self.finished, self.final = True, final
        return [Outgoing(ch.FINAL_MAP, "", final)]

    def _conclude(self) -> list[Outgoing]:
        self._concluding = True
        out = self._scheduler.conclude(self._attendance.now_ns)
        self.finished = True
        final = final_of(out)
        lost = tuple(self._attendance.missing(self._intake.dealt))
        if lost:
            final = msgspec.structs.replace(final, provisional=True, lost=lost)
        self.final = final
        return [*out[:-1], Outgoing(ch.FINAL_MAP, "", final)]

    def requests(self) -> list[m.MeasurementsRequest]:
        """The measurements that are missing and must be asked for at their source."""
        return [] if self.finished else self._intake.requests(self._attendance.now_ns)

    def answer_submaps(self, request: bytes) -> Iterable[bytes]:
        """The answer to `SubmapsRequest`: what is here of the robot, its latest incarnation
        first.
        """
        stored = self._intake.stored_messages(decoded(request, m.SubmapsRequest).robot)
        return [encoded(message) for message in stored]

    def lacking(self) -> list[m.SubmapsRequest]:
        """What robots have sent by their own word and is not here: to be asked of them."""
        return [] if self.finished else self._intake.lacking(self._attendance)

    def status(self) -> m.Status:
        """The centre's status, for people."""
        figures = {
            "broadcasts": float(self._broadcasts),
            "submaps": float(self._intake.submaps),
            "landmarks": float(self._rule.landmarks),
            "team_time_s": self._attendance.now_ns * 1e-9,
            "refused": float(self._intake.refused + self._rule.not_folded),
        }
        state = "done" if self.finished else "joining"
        given_up = [
            f"{robot} is given up: nobody waits for it, and the final map will be provisional"
            for robot in self._attendance.given_up
        ]
        admitted = (
            (f"admitted, though not in the scenario: {', '.join(self._admitted)}",)
            if self._admitted
            else ()
        )
        warnings = (
            *given_up,
            *admitted,
            *self._rule.findings,
            *self.warnings[-3:],
        )
        now_ns = self._attendance.now_ns
        return m.Status(
            stamp_ns=now_ns,
            node="central",
            state=state,
            figures=figures | dict(self._rule.figures),
            warnings=warnings,
        )
