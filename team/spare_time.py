"""Schedules a node's deferrable work: when nothing else waits, and for a limited share of the
time.
"""

import time

FAILED_S = 10.0
"""Work that raised an exception is tried again after this time [s]."""


class SpareTime:
    """Decides by the wall clock when the next piece of deferrable work may begin.

    share: of the time, at most. took_s: duration of the last useful piece; None before the first.
    """

    def __init__(self, share: float) -> None:
        self._rest = 1.0 / share - 1.0
        self._next = 0.0
        self.took_s: float | None = None

    @property
    def wait_s(self) -> float:
        """Time until the next piece may begin [s]; 0: now."""
        return max(0.0, self._next - time.monotonic())

    def note(self, began: float, *, useful: bool) -> None:
        """Note that a piece that began at this `time.monotonic` is done; a useless one costs
        nothing.
        """
        now = time.monotonic()
        if useful:
            self.took_s = now - began
            self._next = now + self._rest * self.took_s

    def failed(self) -> None:
        """Note that a piece raised an exception."""
        self._next = time.monotonic() + FAILED_S
