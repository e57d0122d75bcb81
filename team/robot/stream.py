"""A robot's sensor stream: the order of its measurements, and its end."""

from teamslam.team.door import (
    EARLY_NS,
    LATE_NS,
    MOST_COUNT,
    MOST_LIVES,
    absurd,
    another_time,
)
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.message_order import later_head, merge_ends

NEAR_LIVES = 16  # largest accepted step of the incarnation


class Inbox:
    """Order of a robot's measurements, since Zenoh guarantees none across keys.

    Duplicates and earlier incarnations are dropped. A later incarnation begins with its measurement
    0. ahead: waiting measurements of the incarnation, by number. later: those of later
    incarnations.
    """

    def __init__(self) -> None:
        self.incarnation = 0
        self.next_measurement = 0
        self.ahead: dict[int, m.Measurement] = {}
        self.later: dict[int, dict[int, m.Measurement]] = {}
        self._received = 0
        self._began_ns: int | None = None
        self._of_source: set[int] = set()

    def confirm(self, measurement: m.Measurement) -> None:
        """Mark a measurement as confirmed by its source."""
        if measurement.incarnation == self.incarnation:
            self._of_source.add(measurement.number)

    def resume(self, incarnation: int, next_measurement: int) -> None:
        """Skip measurements consumed by an earlier process."""
        self.incarnation = incarnation
        self.next_measurement = next_measurement
        waiting = self.later.pop(incarnation, {}) | self.ahead
        self.ahead = {
            n: r
            for n, r in waiting.items()
            if r.incarnation == incarnation and n >= next_measurement
        }
        self._forget(incarnation)

    def put(self, measurement: m.Measurement) -> None:
        """Add a measurement, in any order."""
        if measurement.incarnation > self.incarnation:
            self.later.setdefault(measurement.incarnation, {})[measurement.number] = measurement
        elif (
            measurement.incarnation == self.incarnation
            and measurement.number >= self.next_measurement
        ):
            self.ahead[measurement.number] = measurement

    def refusal(self, measurement: m.Measurement) -> str | None:
        """Return why a measurement cannot belong to this stream, or None.

        Incarnations follow one another and begin with their only initial pose, the earliest stamp.
        """
        number, incarnation = measurement.number, measurement.incarnation
        began_ns = self._began_ns
        if incarnation > MOST_LIVES or number > MOST_COUNT:
            return absurd(measurement)
        if (type(measurement) is m.InitialPose) != (number == 0):
            what = type(measurement).__name__
            return f"{what} as measurement {number}; the initial pose is measurement 0"
        if incarnation != self.incarnation:
            if self.next_measurement and incarnation > self.incarnation + NEAR_LIVES:
                return f"of incarnation {incarnation}, while {self.incarnation} is in progress"
            return None
        if began_ns is None or -EARLY_NS <= measurement.stamp_ns - began_ns <= LATE_NS:
            return None
        return None if number in self._of_source else another_time(measurement.stamp_ns, began_ns)

    def contradicts(self, end: m.End, robot: str) -> str | None:
        """Return why an announced end contradicts the stream, or None."""
        ends = {
            stream.incarnation: stream.measurements
            for stream in end.streams
            if stream.robot == robot
        }
        if not ends and self.next_measurement:
            return f"an end that omits {robot}"
        last = ends.get(self.incarnation)
        if last is not None and last < self.next_measurement:
            return (
                f"ends with measurement {last} of {robot}, which has consumed "
                f"{self.next_measurement}"
            )
        return None

    def take(self, measurement: m.Measurement) -> bool:
        """Consume a measurement that is next, as most are; False if it must be stored (`put`)."""
        number = measurement.number
        if (
            number != self.next_measurement
            or not number
            or measurement.incarnation != self.incarnation
            or self.ahead
        ):
            return False
        self.next_measurement = number + 1
        if self._of_source:
            self._of_source.discard(number)
        return True

    def take_next(self) -> m.Measurement | None:
        """Remove and return the next measurement."""
        while True:
            measurement = self.ahead.pop(self.next_measurement, None)
            if measurement is not None:
                if self._of_source:
                    self._of_source.discard(self.next_measurement)
                self.next_measurement += 1
                if type(measurement) is m.InitialPose:
                    self._began_ns = measurement.stamp_ns
                return measurement
            beginnings = [e for e, r in self.later.items() if 0 in r] if self.later else None
            if not beginnings:
                return None
            following = min(beginnings)
            self.incarnation, self.next_measurement = following, 0
            self.ahead = self.later.pop(following)
            self._forget(following)

    def _forget(self, incarnation: int) -> None:
        self._received = 0
        self._of_source.clear()
        self.later = {e: measurements for e, measurements in self.later.items() if e > incarnation}

    @property
    def received(self) -> int:
        """Gap-free count of the incarnation's measurements."""
        self._received = max(self._received, self.next_measurement)
        while self._received in self.ahead:
            self._received += 1
        return self._received

    @property
    def gap(self) -> tuple[int, int, int] | None:
        """Incarnation, first and last measurement of the gap before the earliest waiting one.

        With only a later incarnation, the gap is at its beginning.
        """
        if self.ahead:
            first = min(self.ahead)
            return (
                None
                if first <= self.next_measurement
                else (self.incarnation, self.next_measurement, first - 1)
            )
        if not self.later:
            return None
        following = min(self.later)
        first = min(self.later[following])
        return (following, 0, first - 1) if first else None

    def complete(self, end: m.StreamEnd) -> bool:
        """Return whether the whole stream has been consumed."""
        return end.measurements == 0 or (
            self.incarnation == end.incarnation and self.next_measurement >= end.measurements
        )

    def missing(self, end: m.StreamEnd | None) -> tuple[int, int, int] | None:
        """Return incarnation, first and last measurement to request: a gap, or everything up to the
        end.

        The source has nothing after the end, and no incarnations but the present and the last.
        """
        gap = self.gap
        if end is None:
            return gap
        of_stream = gap is not None and gap[0] in (self.incarnation, end.incarnation)
        if gap is not None and of_stream and gap[:2] < (end.incarnation, end.measurements):
            return gap
        if self.complete(end) or end.incarnation < self.incarnation:
            return None
        first = self._here(end.incarnation)
        return (end.incarnation, first, end.measurements - 1) if first < end.measurements else None

    def _here(self, incarnation: int) -> int:
        if incarnation == self.incarnation:
            return self.received
        later, first = self.later.get(incarnation, {}), 0
        while first in later:
            first += 1
        return first


class EndOfStream:
    """The end of one robot's stream, by a world's `End` or a driver's `StreamHead`."""

    def __init__(self, robot: str, inbox: Inbox) -> None:
        self._robot = robot
        self._inbox = inbox
        self.last: m.StreamEnd | None = None
        """Last measurement of the stream, once its end is announced."""
        self._world_end: m.End | None = None
        self._head: m.StreamHead | None = None
        self.driver_is_there: bool | None = None
        self.is_ordered = False
        self.at_source: tuple[int, int] | None = None
        """Incarnation and measurements at which a world ends the stream, by its own answer."""

    def is_reached(self) -> bool:
        """Return whether every measurement up to the last one has been consumed.

        An ending live team ends the stream of an absent driver where it is.
        """
        if self.last is None:
            if self.driver_is_there or not self.is_ordered:
                return False
            self.last = self._at(self._inbox.received)
        return self._inbox.complete(self.last)

    def last_of(self, incarnation: int) -> int | None:
        """Return the number of measurements of an incarnation that has ended."""
        last = self.last
        return last.measurements if last is not None and last.incarnation == incarnation else None

    @property
    def waits_for_driver(self) -> bool:
        """Whether an absent driver has measurements to publish."""
        driven = self._head is not None and self.at_source is None
        return driven and self.driver_is_there is False

    def missing(self) -> tuple[int, int, int] | None:
        """Return incarnation, first and last measurement to request."""
        return None if self.waits_for_driver else self._inbox.missing(self._known())

    def _known(self) -> m.StreamEnd | None:
        head = self._head
        if self.last is not None or head is None:
            return self.last
        return m.StreamEnd(
            robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
        )

    def announced_by(self, end: m.End) -> tuple[int, int]:
        """Return incarnation and measurements at which an announced end ends this stream; 0 if
        unnamed.
        """
        ends = [(s.incarnation, s.measurements) for s in end.streams if s.robot == self._robot]
        return ends[0] if ends else (self._inbox.incarnation, 0)

    def refusal(self, message: m.End | m.StreamHead) -> str | None:
        """Return why an announced end cannot be valid for the stream, or None."""
        if isinstance(message, m.End):
            of_source = self.at_source in _ends_of(message, self._robot)
            return None if of_source else self._inbox.contradicts(message, self._robot)
        if message.robot != self._robot:
            return f"how far {message.robot} is"
        ended = message.state == "ended"
        return self._inbox.contradicts(_end_at(message), self._robot) if ended else None

    def receive(self, message: m.Liveliness | m.End | m.TeamEnd) -> None:
        """Process the driver's presence, a world's end or an order to end."""
        match message:
            case m.Liveliness():
                if message.node == ch.source_node(self._robot):
                    self.driver_is_there = message.alive
            case m.End():
                self.take(message)
            case m.TeamEnd():
                self.is_ordered = True

    def take(self, end: m.End) -> None:
        """Process a world's end; one without this robot ends its stream here."""
        self._world_end = end = merge_ends(end, self._world_end)
        mine = [stream for stream in end.streams if stream.robot == self._robot]
        if self.at_source is not None:  # the only authority from here on
            incarnation, count = self.at_source
            self.last = m.StreamEnd(robot=self._robot, incarnation=incarnation, measurements=count)
            return
        self.last = mine[0] if mine else self._at(0)

    def take_head(self, head: m.StreamHead) -> m.StreamHead:
        """Process the driver's newest head, which may end the stream or begin a later
        incarnation.
        """
        self._head = head = later_head(head, self._head)
        if self.at_source is not None:
            return head
        if head.state == "ended":
            self.take(_end_at(head))
        elif self.last is not None and head.incarnation > self.last.incarnation:
            self.last = None
        return head

    def _at(self, measurements: int) -> m.StreamEnd:
        return m.StreamEnd(
            robot=self._robot, incarnation=self._inbox.incarnation, measurements=measurements
        )


def _ends_of(end: m.End, robot: str) -> set[tuple[int, int]]:
    return {(s.incarnation, s.measurements) for s in end.streams if s.robot == robot}


def _end_at(head: m.StreamHead) -> m.End:
    last = m.StreamEnd(
        robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
    )
    return m.End(stamp_ns=head.stamp_ns, streams=(last,))
