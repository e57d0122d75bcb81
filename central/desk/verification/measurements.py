"""Measurements of one stream in a log, by number."""

from bisect import bisect_left
from collections.abc import Iterator, Mapping

from teamslam.team.wire import messages as m


class RecordedMeasurements(Mapping[int, m.Measurement]):
    """Measurements of one incarnation; the first in the log for each number.

    contradicted: numbers that the log has twice with different content.
    """

    def __init__(self) -> None:
        self._messages: dict[int, m.Measurement] = {}
        self._odometry: list[int] | None = None
        self.contradicted: list[int] = []

    def put(self, message: m.Measurement) -> None:
        """Add a measurement unless its number is present."""
        known = self._messages.setdefault(message.number, message)
        if known is not message and known != message:
            self.contradicted.append(message.number)
        self._odometry = None

    def __getitem__(self, number: int) -> m.Measurement:
        return self._messages[number]

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self._messages))

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Least and greatest stamp."""
        stamps = [each.stamp_ns for each in self._messages.values()]
        return min(stamps), max(stamps)

    def intervals(self, begin: int, end: int) -> int:
        """Number of odometry intervals numbered begin … end − 1."""
        if self._odometry is None:
            numbers = (n for n, x in self._messages.items() if isinstance(x, m.AnyOdometry))
            self._odometry = sorted(numbers)
        return bisect_left(self._odometry, end) - bisect_left(self._odometry, begin)

    def consecutive(self, begin: int, end: int) -> Iterator[m.Measurement]:
        """Measurements begin … end − 1, up to the first gap."""
        for number in range(begin, end):
            if number not in self._messages:
                return
            yield self._messages[number]
