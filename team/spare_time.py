"""Schedule a node's deferrable work for a limited share of the time."""

import time

FAILED_S = 10.0
"""Time [s] before work that raised an exception is tried again."""


class SpareTime:
    """The wall-clock time at which the next piece of deferrable work may begin.

    share: largest share of the time. took_s: duration of the last useful piece; None: none yet.
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
        """Record a finished piece that began at this `time.monotonic`; useless ones are free."""
        now = time.monotonic()
        if useful:
            self.took_s = now - began
            self._next = now + self._rest * self.took_s

    def failed(self) -> None:
        """Record a piece that raised an exception."""
        self._next = time.monotonic() + FAILED_S
