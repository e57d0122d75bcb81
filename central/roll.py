"""The roll of a team: who is there, how far each robot is, and who is waited for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from team.wire import messages as m

Dealt = Callable[[m.Done], bool]
"""Whether everything that a robot's last word speaks of has been dealt with."""


@dataclass
class Attendance:
    """What the centre knows of one robot."""

    alive: bool = False
    seen: bool = False
    progress: m.Progress | None = None
    done: m.Done | None = None

    @property
    def lost(self) -> bool:
        """It was there and is not any more."""
        return self.seen and not self.alive


@dataclass
class Roll:
    """The team's robots by name; `now_ns` is the newest team time that anyone has spoken of."""

    robots: dict[str, Attendance]
    end: m.End | None = None
    now_ns: int = 0
    _names: tuple[str, ...] = field(default=(), init=False)

    @classmethod
    def of(cls, robots: Sequence[str]) -> "Roll":
        """A team of which nobody has been heard of."""
        return cls({robot: Attendance() for robot in sorted(robots)})

    def take(self, message: m.Message) -> None:
        """Note what a message says of its sender; of strangers nothing."""
        match message:
            case m.Submap() | m.MapEstimate():
                self.now_ns = max(self.now_ns, message.stamp_ns)
            case m.Progress() if message.robot in self.robots:
                self.robots[message.robot].progress = message
                self.now_ns = max(self.now_ns, message.stamp_ns)
            case m.Done() if message.robot in self.robots:
                robot = self.robots[message.robot]
                # A robot's last word is that of its last epoch, in whichever order they come.
                if robot.done is None or robot.done.epoch <= message.epoch:
                    robot.done = message
            case m.End():
                self.end = message
            case m.Liveliness():
                kind, _, name = message.node.partition("/")
                found = self.robots.get(name) if kind == "robot" else None
                if found is not None:
                    found.alive = message.alive
                    found.seen = found.seen or message.alive
            case _:
                pass

    def settled(self, name: str, dealt: Dealt) -> bool:
        """Nothing more comes of the robot: it is done and all of it is here, or it is lost."""
        robot = self.robots[name]
        if robot.done is not None and self._is_last_epoch(name, robot.done.epoch):
            return dealt(robot.done) or robot.lost
        return robot.lost

    def _is_last_epoch(self, name: str, epoch: int) -> bool:
        if self.end is None:
            return False
        ends = [s for s in self.end.streams if s.robot == name]
        return not ends or epoch >= ends[0].epoch

    def concluded(self, dealt: Dealt) -> bool:
        """The world has ended and no robot is waited for."""
        return self.end is not None and all(self.settled(r, dealt) for r in self.robots)

    def takes_part(self, name: str) -> bool:
        """Whether the robot may still send a map: it is there, or was never heard of."""
        robot = self.robots[name]
        return robot.done is None and not robot.lost

    def watermark_ns(self, dealt: Dealt, count: Callable[[tuple[str, int]], int]) -> float:
        """The least progress of the live robots: no submap that ends before it can still come.

        count: how many submaps of a stream have been dealt with.
        """
        least = float("inf")
        for name, robot in self.robots.items():
            if self.settled(name, dealt):
                continue
            progress = robot.progress
            if progress is None or count((name, progress.epoch)) < progress.submaps:
                return float("-inf")
            least = min(least, progress.stamp_ns)
        return least
