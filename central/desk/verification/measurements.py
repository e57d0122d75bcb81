"""The measurements of one stream in a log, by their numbers; plain odometry is kept as arrays."""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Int64

from team.stream.odometry_block import OdometryBlock, OdometryTable, together
from team.wire import messages as m


class RecordedMeasurements(Mapping[int, m.Measurement]):
    """The measurements of one incarnation of a robot, each once: of two with one number the first
    in the log. A place is a sample's index in the log.

    contradicted: numbers of measurements that the log has twice with different content.
    """

    def __init__(self, robot: str, incarnation: int) -> None:
        self._name = robot, incarnation
        self._messages: dict[int, tuple[m.Measurement, int]] = {}
        self._parts: list[tuple[OdometryTable, Int64[np.ndarray, " n"]]] = []
        self._last_row = -1
        self._other_odometry: Int64[np.ndarray, " n"] | None = None
        self.contradicted: list[int] = []

    def put(self, message: m.Measurement, place: int) -> None:
        """Add a measurement, unless one of its number is there from before this place."""
        number = message.number
        before = self.get(number)
        if before is not None and before != message:
            self.contradicted.append(number)
        there = self._messages.get(number)
        row = self._row_of(number) if there is None else None
        if there is not None and there[1] < place:
            return
        if row is not None:
            if self._places[row] < place:
                return
            others = np.arange(len(self._places)) != row
            self._parts = [(self._rows.only(others), self._places[others])]
        self._messages[number] = message, place
        self._other_odometry = None

    def put_rows(self, table: OdometryTable, places: Int64[np.ndarray, " n"]) -> None:
        """Add plain odometry in the order of the log, as `put` adds each."""
        numbers = table.numbers
        before = np.maximum.accumulate(np.concatenate(([self._last_row], numbers[:-1])))
        is_new = np.array([each not in self._messages for each in numbers.tolist()], np.bool_)
        is_new &= numbers > before
        if is_new.any():
            self._parts.append((table.only(is_new), places[is_new]))
            self._last_row = int(numbers[is_new][-1])
        for k in np.flatnonzero(~is_new).tolist():
            self.put(table.block(*self._name, k, k + 1).message(0), int(places[k]))

    # As a mapping.

    def __getitem__(self, number: int) -> m.Measurement:
        there = self._messages.get(number)
        if there is not None:
            return there[0]
        row = self._row_of(number)
        if row is None:
            raise KeyError(number)
        return self._rows.block(*self._name, row, row + 1).message(0)

    def __contains__(self, number: object) -> bool:
        if number in self._messages:
            return True
        return isinstance(number, int) and self._row_of(number) is not None

    def __iter__(self) -> Iterator[int]:
        return iter(sorted([*self._messages, *self._rows.numbers.tolist()]))

    def __len__(self) -> int:
        return len(self._messages) + len(self._places)

    # What is asked of many at once.

    @property
    def span_ns(self) -> tuple[int, int]:
        """The least and the greatest stamp."""
        stamps = [each.stamp_ns for each, _ in self._messages.values()]
        if len(self._places):
            rows = self._rows.stamps_ns
            stamps += [int(rows.min()), int(rows.max())]
        return min(stamps), max(stamps)

    def intervals(self, begin: int, end: int) -> int:
        """Number of odometry intervals of any kind with numbers begin … end − 1."""
        if self._other_odometry is None:
            others = (n for n, (x, _) in self._messages.items() if isinstance(x, m.AnyOdometry))
            self._other_odometry = np.array(sorted(others), np.int64)
        both = self._rows.numbers, self._other_odometry
        return sum(int(each.searchsorted(end) - each.searchsorted(begin)) for each in both)

    def consecutive(self, begin: int, end: int) -> Iterator[m.Measurement | OdometryBlock]:
        """The measurements begin … end − 1, up to the first gap; odometry in blocks."""
        rows, number = self._rows, begin
        gaps = np.flatnonzero(np.diff(rows.numbers) != 1)
        while number < end:
            there, row = self._messages.get(number), self._row_of(number)
            if there is not None:
                yield there[0]
                number += 1
            elif row is not None:
                gap = int(gaps.searchsorted(row))
                last = int(gaps[gap]) if gap < len(gaps) else len(rows.numbers) - 1
                count = min(last + 1 - row, end - number)
                yield rows.block(*self._name, row, row + count)
                number += count
            else:
                return

    @property
    def _rows(self) -> OdometryTable:
        """All plain odometry by ascending number."""
        return self._whole()[0]

    @property
    def _places(self) -> Int64[np.ndarray, " n"]:
        return self._whole()[1]

    def _whole(self) -> tuple[OdometryTable, Int64[np.ndarray, " n"]]:
        if len(self._parts) != 1:
            tables, places = zip((OdometryTable.empty(), NO_PLACES), *self._parts, strict=True)
            self._parts = [(together(tables), np.concatenate(places))]
        return self._parts[0]

    def _row_of(self, number: int) -> int | None:
        if number > self._last_row:
            return None
        numbers = self._rows.numbers
        row = int(numbers.searchsorted(number))
        return row if row < len(numbers) and numbers[row] == number else None


NO_PLACES = np.empty(0, np.int64)
