"""The readings of one robot, put in the order of its reading counter."""

from collections.abc import Iterator

from team.wire.messages import Reading, StreamEnd


class Inbox:
    """Holds readings until their turn: Zenoh promises no order across keys.

    A reading is yielded once; duplicates and readings of earlier epochs are dropped. A later epoch
    begins when its reading 0 arrives.
    """

    def __init__(self) -> None:
        self.epoch = 0
        self.next_reading = 0
        self._waiting: dict[int, Reading] = {}
        self._later: dict[int, dict[int, Reading]] = {}
        self._received = 0

    def resume(self, epoch: int, next_reading: int) -> None:
        """Everything before `next_reading` of `epoch` has been consumed in an earlier life."""
        self.epoch = epoch
        self.next_reading = next_reading
        waiting = self._later.pop(epoch, {}) | self._waiting
        self._waiting = {n: r for n, r in waiting.items() if r.epoch == epoch and n >= next_reading}
        self._forget(epoch)

    def put(self, reading: Reading) -> None:
        """Take a reading, in any order."""
        if reading.epoch > self.epoch:
            self._later.setdefault(reading.epoch, {})[reading.reading] = reading
        elif reading.epoch == self.epoch and reading.reading >= self.next_reading:
            self._waiting[reading.reading] = reading

    def taken(self) -> Iterator[Reading]:
        """The readings whose turn has come, one by one."""
        while True:
            reading = self._waiting.pop(self.next_reading, None)
            if reading is not None:
                self.next_reading += 1
                yield reading
                continue
            following = min((e for e, r in self._later.items() if 0 in r), default=None)
            if following is None:
                return
            self.epoch, self.next_reading = following, 0
            self._waiting = self._later.pop(following)
            self._forget(following)

    def _forget(self, epoch: int) -> None:
        """Nothing of this epoch or an earlier one can become its turn any more."""
        self._received = 0
        self._later = {e: readings for e, readings in self._later.items() if e > epoch}

    @property
    def received(self) -> int:
        """The count of readings of this epoch that are here without a gap, consumed or not."""
        self._received = max(self._received, self.next_reading)
        while self._received in self._waiting:
            self._received += 1
        return self._received

    @property
    def gap(self) -> tuple[int, int, int] | None:
        """Epoch, first and last reading that are missing before the earliest one that waits.

        Of a later epoch that is its beginning, when nothing else of this one is here.
        """
        if self._waiting:
            first = min(self._waiting)
            return (
                None if first <= self.next_reading else (self.epoch, self.next_reading, first - 1)
            )
        if not self._later:
            return None
        following = min(self._later)
        first = min(self._later[following])
        return (following, 0, first - 1) if first else None

    def complete(self, end: StreamEnd) -> bool:
        """Whether every reading up to the stream's last one has had its turn."""
        return end.readings == 0 or (self.epoch == end.epoch and self.next_reading >= end.readings)

    def missing(self, end: StreamEnd | None) -> tuple[int, int, int] | None:
        """Epoch, first and last reading to ask the source for: a gap, or all up to the end."""
        gap = self.gap
        if gap is not None:
            return gap
        if end is None or self.complete(end) or self.waiting or end.epoch < self.epoch:
            return None
        first = self.next_reading if end.epoch == self.epoch else 0
        return end.epoch, first, end.readings - 1

    @property
    def waiting(self) -> int:
        """How many readings wait for their turn."""
        return len(self._waiting) + sum(len(r) for r in self._later.values())
