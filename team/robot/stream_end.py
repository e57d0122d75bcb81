"""The end of a robot's stream, as its world, its driver or an operator announces it."""

from teamslam.team.stream.inbox import Inbox
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.message_order import later_end, later_head


class EndOfStream:
    """The end of one robot's stream. A world ends it by `End`, a driver by its `StreamHead`."""

    def __init__(self, robot: str, inbox: Inbox) -> None:
        self._robot = robot
        self._inbox = inbox
        self._last: m.StreamEnd | None = None
        self._world_end: m.End | None = None
        self._head: m.StreamHead | None = None
        self.driver_is_there: bool | None = None
        self.is_ordered = False
        self.at_source: tuple[int, int] | None = None
        """Incarnation and measurements at which a world ends the stream, by its own answer."""

    def is_reached(self) -> bool:
        """Whether every measurement up to the last one has been consumed.

        A live team that is to end ends the stream where it is, if its driver is not present.
        """
        if self._last is None:
            if self.driver_is_there or not self.is_ordered:
                return False
            self._last = self._at(self._inbox.received)
        return self._inbox.complete(self._last)

    def last_of(self, incarnation: int) -> int | None:
        """The measurements of an incarnation that has ended; None while it has not."""
        last = self._last
        return last.measurements if last is not None and last.incarnation == incarnation else None

    @property
    def waits_for_driver(self) -> bool:
        """Whether measurements must come from a driver that is not present."""
        driven = self._head is not None and self.at_source is None
        return driven and self.driver_is_there is False

    def missing(self) -> tuple[int, int, int] | None:
        """Incarnation, first and last measurement to ask the source for."""
        return None if self.waits_for_driver else self._inbox.missing(self._known())

    def _known(self) -> m.StreamEnd | None:
        """The stream's last announced counter, whether it has ended or not."""
        head = self._head
        if self._last is not None or head is None:
            return self._last
        return m.StreamEnd(
            robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
        )

    def announced_by(self, end: m.End) -> tuple[int, int]:
        """Incarnation and measurements at which an announced end ends this robot's stream.

        One that does not name the robot says that its stream has none.
        """
        ends = [(s.incarnation, s.measurements) for s in end.streams if s.robot == self._robot]
        return ends[0] if ends else (self._inbox.incarnation, 0)

    def refusal(self, message: m.End | m.StreamHead) -> str | None:
        """Why an announced end can not be true of the stream, in words."""
        if isinstance(message, m.End):
            of_source = self.at_source in _ends_of(message, self._robot)
            return None if of_source else self._inbox.contradicts(message, self._robot)
        if message.robot != self._robot:
            return f"how far {message.robot} is"
        ended = message.state == "ended"
        return self._inbox.contradicts(_end_at(message), self._robot) if ended else None

    def receive(self, message: m.Liveliness | m.End | m.TeamEnd) -> None:
        """Take the driver's presence, a world's end or an order to end."""
        match message:
            case m.Liveliness():
                if message.node == ch.source_node(self._robot):
                    self.driver_is_there = message.alive
            case m.End():
                self.take(message)
            case m.TeamEnd():
                self.is_ordered = True

    def take(self, end: m.End) -> None:
        """Take a world's end; one that does not name this robot ends its stream where it is."""
        self._world_end = end = later_end(end, self._world_end)
        mine = [stream for stream in end.streams if stream.robot == self._robot]
        if self.at_source is not None:  # no other word counts any more
            incarnation, count = self.at_source
            self._last = m.StreamEnd(robot=self._robot, incarnation=incarnation, measurements=count)
            return
        self._last = mine[0] if mine else self._at(0)

    def take_head(self, head: m.StreamHead) -> m.StreamHead:
        """Take the newest head of the driver.

        The stream ends when the head says so, unless a later incarnation begins after that.
        """
        self._head = head = later_head(head, self._head)
        if self.at_source is not None:
            return head
        if head.state == "ended":
            self.take(_end_at(head))
        elif self._last is not None and head.incarnation > self._last.incarnation:
            self._last = None
        return head

    def _at(self, measurements: int) -> m.StreamEnd:
        return m.StreamEnd(
            robot=self._robot, incarnation=self._inbox.incarnation, measurements=measurements
        )


def _ends_of(end: m.End, robot: str) -> set[tuple[int, int]]:
    return {(s.incarnation, s.measurements) for s in end.streams if s.robot == robot}


def _end_at(head: m.StreamHead) -> m.End:
    """The end of one robot's stream as a world would announce it."""
    last = m.StreamEnd(
        robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
    )
    return m.End(stamp_ns=head.stamp_ns, streams=(last,))
