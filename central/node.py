"""The centre's node: messages in, messages out; no I/O, no clock.

It listens to start poses, submaps (or own maps, under a rule with feedback), progress and
liveliness, and to nothing that holds the fused map.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from central.config import CentralConfig
from central.feedback_rule import FeedbackRule
from central.join_rule import JoinRule
from team import translate
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import decoded, encoded


@dataclass
class _Robot:
    """What the centre knows of one robot."""

    alive: bool = False
    seen: bool = False
    progress: m.Progress | None = None
    done: m.Done | None = None


class CentralNode:
    """One centre for the robots of a team: `begin`, then `handle`, until `finished`."""

    listens = (
        ch.START, ch.SUBMAP, ch.SIGHTING_FACTOR, ch.OWN_MAP, ch.ROBOT_PROGRESS, ch.ROBOT_DONE,
        ch.END,
    )  # fmt: skip

    def __init__(self, config: CentralConfig, robots: Sequence[str]) -> None:
        self.config = config
        self._announcement = translate.configured("central", 0, 0, config)
        self._robots = {robot: _Robot() for robot in sorted(robots)}
        self._join = JoinRule(config, self._announcement.digest)
        self._feedback = FeedbackRule(config, self._announcement.digest)
        self._end: m.End | None = None
        self._now_ns = 0
        self._broadcasts = 0
        self.finished = False
        self.final: m.FusedMap | None = None

    @property
    def feedback(self) -> bool:
        """Whether the rule fuses maps that the robots absorb again."""
        return self.config.fusion != "join"

    @property
    def warnings(self) -> list[str]:
        """What went wrong, in words, the newest last."""
        return self._join.warnings

    def begin(self) -> list[Outgoing]:
        """What the node says first: its configuration."""
        return [Outgoing(ch.CENTRAL_CONFIG, "", self._announcement)]

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; `now_ns` is the team time of its arrival (unused: stamps are time)."""
        last: list[Outgoing] = []
        match message:
            case m.Start():
                self._join.take_start(message)
            case m.Submap():
                last = self._take_submap(message)
            case m.SightingFactor():
                last = self._take_sighting(message)
            case m.MapEstimate():
                self._now_ns = max(self._now_ns, message.stamp_ns)
                self._feedback.take_map(message)
            case m.Progress() if message.robot in self._robots:
                self._robots[message.robot].progress = message
                self._now_ns = max(self._now_ns, message.stamp_ns)
            case m.Done() if message.robot in self._robots:
                self._take_done(message)
            case m.End():
                self._end = message
            case m.Liveliness():
                self._take_liveliness(message)
            case _:
                pass
        return self._advance() + last  # the credit comes after the map that it gave

    def _take_submap(self, submap: m.Submap) -> list[Outgoing]:
        self._now_ns = max(self._now_ns, submap.stamp_ns)
        return self._credit(submap, self._join.take_submap(submap))

    def _take_sighting(self, sighting: m.SightingFactor) -> list[Outgoing]:
        """The last one of a submap that is here already completes it."""
        before = self._join.count((sighting.robot, sighting.epoch))
        count = self._join.take_sighting(sighting)
        return self._credit(sighting, count) if count > before else []

    def _credit(self, of: m.Submap | m.SightingFactor, count: int) -> list[Outgoing]:
        progress = m.Progress(self._now_ns, "central", of.robot, of.epoch, 0, count)
        return [Outgoing(ch.CENTRAL_PROGRESS, of.robot, progress)]

    def _take_done(self, done: m.Done) -> None:
        """A robot's last word is that of its last epoch, in whichever order they come."""
        robot = self._robots[done.robot]
        if robot.done is None or robot.done.epoch <= done.epoch:
            robot.done = done

    def _take_liveliness(self, message: m.Liveliness) -> None:
        kind, _, name = message.node.partition("/")
        robot = self._robots.get(name) if kind == "robot" else None
        if robot is not None:
            robot.alive = message.alive
            robot.seen = robot.seen or message.alive

    def _advance(self) -> list[Outgoing]:
        if self.finished:
            return []
        if self.feedback:
            out = self._feedback.advance(self._takes_part, list(self._robots))
        else:
            out = self._join.advance(self._watermark_ns(), self._now_ns)
        self._broadcasts += bool(out)
        if self._end is not None and all(self._settled(r) for r in self._robots):
            out += self._conclude()
        return out

    def _conclude(self) -> list[Outgoing]:
        rule = self._feedback if self.feedback else self._join
        out = rule.conclude(self._now_ns)
        self.finished = True
        final = out[-1].message
        assert isinstance(final, m.FusedMap)
        self.final = final
        return out

    def _settled(self, name: str) -> bool:
        """Nothing more comes from the robot: it is done and its submaps are here, or it is lost."""
        robot = self._robots[name]
        if robot.done is not None and self._is_last_epoch(name, robot.done.epoch):
            stream = (name, robot.done.epoch)
            if self.feedback or self._join.count(stream) >= robot.done.submaps:
                return True
        return robot.seen and not robot.alive

    def _is_last_epoch(self, name: str, epoch: int) -> bool:
        assert self._end is not None
        ends = [s for s in self._end.streams if s.robot == name]
        return not ends or epoch >= ends[0].epoch

    def _takes_part(self, name: str, number: int) -> bool:
        robot = self._robots[name]
        return robot.done is None and (robot.alive or not robot.seen)

    def _watermark_ns(self) -> float:
        """The least progress of the live robots: no submap that ends before it can still come."""
        least = float("inf")
        for name, robot in self._robots.items():
            if robot.seen and not robot.alive:
                continue
            if robot.done is not None and self._end is not None and self._settled(name):
                continue
            progress = robot.progress
            if progress is None:
                return float("-inf")
            here = self._join.count((name, progress.epoch))
            if here < progress.submaps:
                return float("-inf")
            least = min(least, progress.stamp_ns)
        return least

    def answer_submaps(self, request: bytes) -> Iterable[bytes]:
        """The answer to `SubmapsWanted`: the start of the latest epoch, then its submaps."""
        wanted = decoded(request, m.SubmapsWanted)
        submaps = self._join.submaps(wanted.robot)
        start = self._join.start(wanted.robot, submaps[0].epoch) if submaps else None
        return [] if start is None else [encoded(start), *(encoded(s) for s in submaps)]

    def status(self) -> m.Status:
        """What the centre is doing, for people."""
        figures = {
            "broadcasts": float(self._broadcasts),
            "submaps": float(sum(self._join.count(s) for s in self._join.streams)),
            "landmarks": float(self._feedback.landmarks if self.feedback else self._join.landmarks),
            "team_time_s": self._now_ns * 1e-9,
            "refused": float(self._join.refused),
        }
        found = self._join.finding
        state = "done" if self.finished else "joining"
        warnings = (*found.warnings, *self.warnings[-3:])
        return m.Status(self._now_ns, "central", state, figures | found.figures, warnings)
