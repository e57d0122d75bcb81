"""When a node may do what can wait: when nothing else waits, and for no more than its share."""

import time

FAILED_S = 10.0
"""Work that raised is tried again after this time."""


class SpareTime:
    """Decides by the wall clock when the next piece of such work may begin.

    share: of the time, at the most. took_s: how long the last piece that did something took; None:
    there was none yet.
    """

    def __init__(self, share: float) -> None:
        self._rest = 1.0 / share - 1.0
        self._next = 0.0
        self.took_s: float | None = None

    @property
    def wait_s(self) -> float:
        """Until it may begin; 0: now."""
        return max(0.0, self._next - time.monotonic())

    def note(self, began: float, *, useful: bool) -> None:
        """A piece that began then (`time.monotonic`) is done; one with no result costs nothing."""
        now = time.monotonic()
        if useful:
            self.took_s = now - began
            self._next = now + self._rest * self.took_s

    def failed(self) -> None:
        """A piece raised."""
        self._next = time.monotonic() + FAILED_S
