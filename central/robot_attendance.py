"""The presence and progress of one robot at the centre."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Generic, TypeVar

from teamslam.team.wire import messages as m

MOST_NOTED = 1_000
"""Most announced ends of the team, and `Done` messages of a robot, that are stored."""


@dataclass
class Attendance:
    """The progress and presence of one robot at the centre.

    done: the accepted one of the `Done` messages; dones: all that arrived. began: the latest
    incarnation that has begun; 0: none. head: the newest head of its driver, in a live team.
    driver: whether its driver is present; None: unknown.
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
        """Whether the robot has consumed all that its driver numbered, and the stream is not
        open.
        """
        head, done = self.head, self.done
        if head is None or done is None or head.state == "open":
            return False
        return (done.incarnation, done.measurements) >= (head.incarnation, head.measurements)


S = TypeVar("S")


class Awaited(Generic[S]):
    """Tests whether any of many is awaited: the last awaited one first, then all."""

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


class Least:
    """The least of many named values that change one by one; infinite without any."""

    def __init__(self) -> None:
        self._values: dict[str, float] = {}
        self._heap: list[tuple[float, str]] = []

    def put(self, name: str, value: float) -> None:
        """Set the value of a name."""
        if self._values.get(name) != value:
            self._values[name] = value
            heappush(self._heap, (value, name))

    @property
    def value(self) -> float:
        """The least value."""
        while self._heap and self._values[self._heap[0][1]] != self._heap[0][0]:
            heappop(self._heap)
        return self._heap[0][0] if self._heap else float("inf")


T = TypeVar("T", m.Done, m.End)


def note(message: T, noted: list[T]) -> None:
    """Append a new message; the newest MOST_NOTED stay."""
    if message not in noted:
        noted.append(message)
        del noted[:-MOST_NOTED]
