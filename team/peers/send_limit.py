"""Limit on the bytes of members that a peer sends to others."""

GIVEN_BYTES = 32 * 2**20
"""Most bytes of members per second, to all nodes together."""


class Given:
    """Bytes sent within the current second: bounds the cost of endless requests.

    Not counted by node, since the name in a request is not authenticated.
    """

    def __init__(self) -> None:
        self._second = 0
        self._bytes = 0

    def allows(self, now_s: float) -> bool:
        """Whether more may be sent now."""
        if int(now_s) != self._second:
            self._second, self._bytes = int(now_s), 0
        return self._bytes < GIVEN_BYTES

    def note(self, size: int) -> None:
        """Count bytes sent."""
        self._bytes += size
