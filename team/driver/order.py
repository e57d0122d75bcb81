"""Orders measurements as a source must: by stamp, landmarks before the odometry that ends there.

A camera's frame may arrive tens of milliseconds after the odometry of its time. So a measurement
waits until one newer by `latency_ns` has arrived; then its place is known. Which number a
measurement gets depends on the order of the calls alone, so it can be found again from a file.
"""

from heapq import heappop, heappush

Place = tuple[int, int]
"""(stamp [ns], kind): at equal stamps smaller kinds come first, odometry last."""


class Sorter:
    """Collects items with their places and returns them in order."""

    def __init__(self, latency_ns: int) -> None:
        self.latency_ns = latency_ns
        self._waiting: list[tuple[Place, int, int]] = []
        self._arrived = 0
        self._newest_ns: int | None = None
        self.released: Place | None = None
        """Place of the last returned item; nothing may be put before it."""

    def put(self, place: Place, item: int) -> list[int]:
        """Take an item; returns the items whose place is settled now."""
        heappush(self._waiting, (place, self._arrived, item))
        self._arrived += 1
        newest_ns = place[0] if self._newest_ns is None else max(self._newest_ns, place[0])
        self._newest_ns = newest_ns
        return self._until(newest_ns - self.latency_ns)

    def flush(self) -> list[int]:
        """Return all waiting items."""
        return [] if self._newest_ns is None else self._until(self._newest_ns + 1)

    def _until(self, until_ns: int) -> list[int]:
        out = []
        while self._waiting and self._waiting[0][0][0] < until_ns:
            self.released, _, item = heappop(self._waiting)
            out.append(item)
        return out
