"""The presence and progress of one robot, as the centre knows them."""

from dataclasses import dataclass, field
from typing import TypeVar

from team.wire import messages as m

MOST_NOTED = 1_000
"""Most announced ends of the team, and `Done` messages of a robot, that are stored."""


@dataclass
class Attendance:
    """The progress and presence of one robot, as the centre knows them.

    done: the believed one of the `Done` messages; dones: all that have arrived. began: the latest
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
        """True once the robot was present and is not any more."""
        return self.seen and not self.alive

    @property
    def stream_end(self) -> m.StreamEnd | None:
        """Where its driver has ended the stream, unless a later incarnation has begun."""
        head = self.head
        if head is None or head.state != "ended" or head.incarnation < self.began:
            return None
        return m.StreamEnd(
            robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
        )

    @property
    def has_all(self) -> bool:
        """True once the robot has consumed all that its driver has numbered and the stream is
        not open.
        """
        head, done = self.head, self.done
        if head is None or done is None or head.state == "open":
            return False
        return (done.incarnation, done.measurements) >= (head.incarnation, head.measurements)


T = TypeVar("T", m.Done, m.End)


def note(message: T, noted: list[T]) -> None:
    """Append a message that is not there yet; the newest MOST_NOTED stay."""
    if message not in noted:
        noted.append(message)
        del noted[:-MOST_NOTED]
