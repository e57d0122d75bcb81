"""Put the measurements of one robot in the order of their counter."""

from teamslam.team.door import MOST_COUNT, MOST_LIVES, absurd, another_time
from teamslam.team.wire.messages import End, InitialPose, Measurement, StreamEnd

NEAR_LIVES = 16
"""Largest accepted step of the incarnation, which grows one by one, and seldom."""


class Inbox:
    """Hold measurements until their turn: Zenoh guarantees no order across keys.

    Duplicates and measurements of earlier incarnations are dropped. A later incarnation begins when
    its measurement 0 arrives.

    ahead: measurements of the incarnation that wait for their turn, by number. later: those of
    later incarnations.
    """

    def __init__(self) -> None:
        self.incarnation = 0
        self.next_measurement = 0
        self.ahead: dict[int, Measurement] = {}
        self.later: dict[int, dict[int, Measurement]] = {}
        self._received = 0
        self._began_ns: int | None = None
        self._of_source: set[int] = set()

    def confirm(self, measurement: Measurement) -> None:
        """Confirm a measurement by the source's answer, whatever its stamp."""
        if measurement.incarnation == self.incarnation:
            self._of_source.add(measurement.number)

    def resume(self, incarnation: int, next_measurement: int) -> None:
        """Skip measurements of `incarnation` consumed by an earlier process."""
        self.incarnation = incarnation
        self.next_measurement = next_measurement
        waiting = self.later.pop(incarnation, {}) | self.ahead
        self.ahead = {
            n: r
            for n, r in waiting.items()
            if r.incarnation == incarnation and n >= next_measurement
        }
        self._forget(incarnation)

    def put(self, measurement: Measurement) -> None:
        """Add a measurement, in any order."""
        if measurement.incarnation > self.incarnation:
            self.later.setdefault(measurement.incarnation, {})[measurement.number] = measurement
        elif (
            measurement.incarnation == self.incarnation
            and measurement.number >= self.next_measurement
        ):
            self.ahead[measurement.number] = measurement

    def refusal(self, measurement: Measurement) -> str | None:
        """Why a measurement cannot belong to this stream; None if it can.

        Counters are no absurd ones. Incarnations follow one another and begin with their only
        initial pose, the earliest stamp.
        """
        number, incarnation = measurement.number, measurement.incarnation
        if incarnation > MOST_LIVES or number > MOST_COUNT:
            return absurd(measurement)
        if (type(measurement) is InitialPose) != (number == 0):
            what = type(measurement).__name__
            return f"{what} as measurement {number}; the initial pose is measurement 0"
        if incarnation != self.incarnation:
            if self.next_measurement and incarnation > self.incarnation + NEAR_LIVES:
                return f"of incarnation {incarnation}, while {self.incarnation} is in progress"
            return None
        if self._began_ns is None or number in self._of_source:
            return None
        return another_time(measurement.stamp_ns, self._began_ns)

    def contradicts(self, end: End, robot: str) -> str | None:
        """Why an announced end cannot be the end of the robot's stream."""
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

    def take_next(self) -> Measurement | None:
        """Remove and return the next measurement, if its turn has come."""
        while True:
            measurement = self.ahead.pop(self.next_measurement, None)
            if measurement is not None:
                if self._of_source:
                    self._of_source.discard(self.next_measurement)
                self.next_measurement += 1
                if type(measurement) is InitialPose:
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
        """Drop measurements whose turn cannot come after this incarnation."""
        self._received = 0
        self._of_source.clear()
        self.later = {e: measurements for e, measurements in self.later.items() if e > incarnation}

    @property
    def received(self) -> int:
        """Gap-free count of this incarnation's measurements, consumed or not."""
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

    def complete(self, end: StreamEnd) -> bool:
        """Whether every measurement of the stream has been consumed."""
        return end.measurements == 0 or (
            self.incarnation == end.incarnation and self.next_measurement >= end.measurements
        )

    def missing(self, end: StreamEnd | None) -> tuple[int, int, int] | None:
        """Incarnation, first and last measurement to request from the source: a gap, or everything
        up to the end.

        The source has nothing after the end, or of incarnations other than the present and the
        last.
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

    @property
    def waiting(self) -> int:
        """Number of measurements that wait for their turn."""
        return len(self.ahead) + sum(len(r) for r in self.later.values())
