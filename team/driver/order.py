"""Order measurements by stamp, landmarks before the odometry that ends at the same time.

A camera's frame may arrive tens of milliseconds after the odometry of its time. A measurement is
therefore held until one newer by `latency_ns` has arrived. Its number depends on the order of the
calls alone and can be reconstructed from the file.
"""

from heapq import heappop, heappush

Place = tuple[int, int]
"""(stamp [ns], kind): at equal stamps smaller kinds come first, odometry last."""


class Sorter:
    """Sort items by their places, with a bounded delay."""

    def __init__(self, latency_ns: int) -> None:
        self.latency_ns = latency_ns
        self._waiting: list[tuple[Place, int, int]] = []
        self._arrived = 0
        self._newest_ns: int | None = None
        self.released: Place | None = None
        """Place of the last returned item; earlier places are closed."""

    def put(self, place: Place, item: int) -> list[int]:
        """Add an item; return the items whose place is now final."""
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
