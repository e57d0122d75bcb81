"""The readings of one robot, put in the order of its reading counter."""

from collections.abc import Iterator

from team.wire.messages import Reading


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

    def resume(self, epoch: int, next_reading: int) -> None:
        """Everything before `next_reading` of `epoch` has been consumed in an earlier life."""
        self.epoch = epoch
        self.next_reading = next_reading
        self._waiting = {n: r for n, r in self._waiting.items() if n >= next_reading}

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

    @property
    def gap(self) -> tuple[int, int] | None:
        """First and last reading that are missing before the earliest one that waits."""
        if not self._waiting or self.next_reading in self._waiting:
            return None
        return self.next_reading, min(self._waiting) - 1

    @property
    def waiting(self) -> int:
        """How many readings wait for their turn."""
        return len(self._waiting) + sum(len(r) for r in self._later.values())
