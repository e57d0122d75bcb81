"""Track the presence and progress of each robot, and which the final map awaits."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import InitVar, dataclass, field
from typing import Generic, TypeVar

from teamslam.team.wire import messages as m
from teamslam.team.wire.message_order import later_head, merge_ends, merge_progress

MOST_NOTED = 1_000
"""Most announced ends of the team, and `Done` messages of a robot, that are stored."""


@dataclass
class Attendance:
    """The progress and presence of one robot at the centre.

    done: the accepted one of `dones`. began: the latest incarnation; 0: none. head: its driver's
    newest; driver: whether that is present; None: unknown.
    """

    alive: bool = False
    seen: bool = False
    given_up: bool = False
    progress: m.Progress | None = None
    done: m.Done | None = None
    dones: list[m.Done] = field(default_factory=list)
    began: int = 0
    head: m.StreamHead | None = None
    driver: bool | None = None

    @property
    def lost(self) -> bool:
        """Whether the robot was present and is absent now."""
        return self.seen and not self.alive

    @property
    def stream_end(self) -> m.StreamEnd | None:
        """The end announced by its driver, unless a later incarnation has begun."""
        head = self.head
        if head is None or head.state != "ended" or head.incarnation < self.began:
            return None
        return m.StreamEnd(
            robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
        )

    @property
    def has_all(self) -> bool:
        """Whether the robot has consumed all that its driver numbered, and the stream has ended."""
        head, done = self.head, self.done
        if head is None or done is None or head.state == "open":
            return False
        return (done.incarnation, done.measurements) >= (head.incarnation, head.measurements)

    def note_done(self, done: m.Done) -> None:
        """Store a `Done`; that of the last incarnation counts."""
        if done not in self.dones:
            self.dones = [*self.dones[1 - MOST_NOTED :], done]
        if self.done is None or self.done.incarnation <= done.incarnation:
            self.done = done


S = TypeVar("S")


class Awaited(Generic[S]):
    """Test whether any of many is awaited, the last awaited one first."""

    def __init__(self) -> None:
        self._left: list[S] = []

    def is_none(self, everyone: Iterable[S], waits_for: Callable[[S], bool]) -> bool:
        """Whether none is awaited."""
        while self._left:
            if waits_for(self._left[-1]):
                return False
            self._left.pop()
        self._left = [each for each in everyone if waits_for(each)]
        return not self._left


@dataclass
class TeamAttendance:
    """Progress and presence of each robot of the team.

    has_received: whether all messages announced in a `Done` are processed. processed: number of
    processed submaps of a stream. now_ns: the newest team time. world_end: the world's last
    counters. ordered: an operator has ordered the live team to end.
    """

    names: InitVar[Sequence[str]]
    has_received: Callable[[m.Done], bool]
    processed: Callable[[tuple[str, int]], int]
    robots: dict[str, Attendance] = field(init=False)
    world_end: m.End | None = None
    ends: dict[m.End, Awaited[m.StreamEnd]] = field(default_factory=dict)
    now_ns: int = 0
    withdrawn: frozenset[str] = frozenset()
    ordered: bool = False
    _has_head: bool = field(default=False, init=False)
    _ended: m.End | None = field(default=None, init=False)
    _last: dict[str, int] = field(default_factory=dict, init=False)
    _unsettled: Awaited[str] = field(default_factory=Awaited, init=False)
    _changed: set[str] = field(default_factory=set, init=False)
    _of_all: tuple[object, ...] = field(default=(), init=False)
    _until: dict[str, float] = field(default_factory=dict, init=False)
    _watermark_ns: float = field(default=float("inf"), init=False)

    def __post_init__(self, names: Sequence[str]) -> None:
        self.robots = {robot: Attendance() for robot in sorted(names)}

    def admit(self, robot: str) -> None:
        """Add a robot."""
        self.robots = dict(sorted({**self.robots, robot: Attendance()}.items()))
        self._changed.add(robot)

    def forget_members(self) -> None:
        """Forget `Done` and `GivenUp`, to be filed again."""
        for robot in self.robots.values():
            robot.done, robot.given_up = None, False
            robot.dones.clear()
        self._changed.update(self.robots)

    def take(self, message: m.Message) -> None:
        """Update the attendance from a message."""
        self.note_change(message)
        match message:
            case m.Submap() | m.MapEstimate():
                self.now_ns = max(self.now_ns, message.stamp_ns)
            case m.Progress() if message.robot in self.robots:
                robot = self.robots[message.robot]
                robot.progress = merge_progress(message, robot.progress)
                self.now_ns = max(self.now_ns, message.stamp_ns)
            case m.Done() if message.robot in self.robots:
                self.robots[message.robot].note_done(message)
            case m.End():
                self.note_end(message)
                self.world_end = merge_ends(message, self.world_end)
            case m.TeamEnd():
                self.ordered = True
            case m.InitialPose() | m.StreamHead() if message.robot in self.robots:
                self._take_of_driver(message, self.robots[message.robot])
            case m.Liveliness() if message.node.startswith("source/"):
                robot = self.robots.get(message.node.removeprefix("source/"), Attendance())
                robot.driver = message.alive
            case m.Liveliness():
                found = self._named(message.node)
                if found is not None:
                    found.alive = message.alive
                    found.seen = found.seen or message.alive
            case m.GivenUp() if (found := self._named(message.node)) is not None:
                found.given_up = True
            case _:
                pass

    def note_change(self, message: m.Message) -> None:
        """Note that a message's robot may have changed."""
        name = getattr(message, "robot", None) or getattr(message, "node", "").rpartition("/")[2]
        if name in self.robots:
            self._changed.add(name)

    def note_end(self, end: m.End) -> None:
        """Store an announced end, even a refused one: the robots' `Done` may confirm it."""
        self.ends.setdefault(end, Awaited())
        if len(self.ends) > MOST_NOTED:
            del self.ends[next(iter(self.ends))]

    def _take_of_driver(self, message: m.InitialPose | m.StreamHead, robot: Attendance) -> None:
        robot.began = max(robot.began, message.incarnation)
        if isinstance(message, m.StreamHead):
            robot.head = later_head(message, robot.head)
            self._has_head = True
            self.now_ns = max(self.now_ns, message.stamp_ns)

    def _named(self, node: str) -> Attendance | None:
        kind, _, name = node.partition("/")
        return self.robots.get(name) if kind == "robot" else None

    @property
    def is_live(self) -> bool:
        """Whether drivers, not a world, publish."""
        return self.ordered or self._has_head

    @property
    def end(self) -> m.End | None:
        """The last counters of all streams, after an order to end from `Done`; None while one is
        open.
        """
        if self.world_end is not None or not self.is_live:
            return self.world_end
        streams = []
        for name, robot in self.robots.items():
            last = robot.stream_end
            done = robot.done
            if last is None and self.ordered and done and done.incarnation >= robot.began:
                last = m.StreamEnd(
                    robot=name, incarnation=done.incarnation, measurements=done.measurements
                )
            if last is not None:
                streams.append(last)
            elif not (robot.given_up or name in self.withdrawn or self._never_measured(name)):
                return None
        return m.End(stamp_ns=self.now_ns, streams=tuple(streams))

    def _never_measured(self, name: str) -> bool:
        return self.ordered and not self.robots[name].began

    def is_complete(self, name: str) -> bool:
        """Whether the robot is done and its messages are processed."""
        done = self.robots[name].done
        return (
            done is not None
            and self._is_last_incarnation(name, done.incarnation)
            and self.has_received(done)
        )

    def contradicts(self, end: m.End) -> str | None:
        """Return why this cannot be the end of the team's streams."""
        ends = {(s.robot, s.incarnation): s.measurements for s in end.streams}
        silent = sorted(self.robots.keys() - {robot for robot, _ in ends})
        if silent:
            return f"an end that omits {', '.join(silent)}"
        for name, robot in self.robots.items():
            progress = robot.progress
            last = None if progress is None else ends.get((name, progress.incarnation))
            if progress is not None and last is not None and last < progress.measurements:
                return (
                    f"ends with measurement {last} of {name}, which has consumed "
                    f"{progress.measurements}"
                )
        return None

    def is_settled(self, name: str) -> bool:
        """Whether the final map need not wait for this robot. It waits for a lost one."""
        return self._is_excused(name) or self._never_measured(name) or self.is_complete(name)

    @property
    def given_up(self) -> list[str]:
        """The robots given up by an order."""
        return [robot for robot, attendance in self.robots.items() if attendance.given_up]

    def missing(self) -> list[str]:
        """List the robots with incomplete streams or, after an order to end, perhaps more."""
        return [
            name
            for name, robot in self.robots.items()
            if name not in self.withdrawn
            and not self._never_measured(name)
            and not (self.is_complete(name) and (robot.has_all or not self.ordered))
        ]

    def awaited(self) -> list[str]:
        """The absent robots that the map awaits."""
        return [r for r, a in self.robots.items() if not (a.alive or self.is_settled(r))]

    def _is_last_incarnation(self, name: str, incarnation: int) -> bool:
        end = self.end
        if end is None:
            return False
        if end is not self._ended:
            self._ended = end
            self._last = {s.robot: s.incarnation for s in reversed(end.streams)}
        return incarnation >= self._last.get(name, incarnation)

    def is_concluded(self) -> bool:
        """Whether the streams have ended and no robot is awaited."""
        return self._all_settled() or (self._accept_confirmed_end() and self._all_settled())

    def _all_settled(self) -> bool:
        return self.end is not None and self._unsettled.is_none(
            self.robots, lambda name: not self.is_settled(name)
        )

    def _accept_confirmed_end(self) -> bool:
        """Accept an end that the robots' `Done` messages confirm; a stranger may announce a later
        one.
        """
        for end, unconfirmed in self.ends.items():
            if not unconfirmed.is_none(end.streams, self._is_open):
                continue
            found = {s.robot: self._confirmed(s) for s in end.streams}
            others = self.robots.keys() - found.keys()
            if all(self._is_excused(r) for r in others) and any(found.values()):
                self.world_end = end
                self._changed.update(found)
                for name, done in found.items():
                    self.robots[name].done = done or self.robots[name].done
                return True
        return False

    def _is_open(self, stream: m.StreamEnd) -> bool:
        return self._confirmed(stream) is None and not self._is_excused(stream.robot)

    def _is_excused(self, name: str) -> bool:
        robot = self.robots[name]
        return robot.given_up or (name in self.withdrawn and not robot.alive)

    def _confirmed(self, end: m.StreamEnd) -> m.Done | None:
        robot = self.robots[end.robot]
        counts = end.incarnation, end.measurements
        same = (d for d in robot.dones if (d.incarnation, d.measurements) == counts)
        return next(filter(self.has_received, same), None)

    @property
    def watermark_ns(self) -> float:
        """The least progress of the live robots: every submap that ends before it has arrived."""
        of_all = (self.end, self.withdrawn, self.ordered, self._has_head)
        if of_all != self._of_all:
            self._changed.update(self.robots)
        self._of_all = of_all
        changed = {name: self._until_ns(name) for name in self._changed}
        self._changed.clear()
        if not changed.items() <= self._until.items():
            self._until |= changed
            self._watermark_ns = min(self._until.values())
        return self._watermark_ns

    def _until_ns(self, name: str) -> float:
        """Progress of a robot if all its submaps until then are here; infinite if not awaited."""
        robot = self.robots[name]
        if robot.lost or self._is_away(robot) or self.is_settled(name):
            return float("inf")
        progress = robot.progress
        if progress is None or self.processed((name, progress.incarnation)) < progress.submaps:
            return float("-inf")
        return progress.stamp_ns

    def _is_away(self, robot: Attendance) -> bool:
        if not self.is_live:
            return False
        head = robot.head
        return (
            not robot.began or robot.driver is False or (head is not None and head.state == "left")
        )
