"""How many bytes of members a peer gives to others."""

GIVEN_BYTES = 32 * 2**20
"""Most bytes of members given within a second, to all nodes together."""


class Given:
    """Bytes given within the current second, which limits the cost of endless requests.

    They are not counted by node: nothing proves the name in a request.
    """

    def __init__(self) -> None:
        self._second = 0
        self._bytes = 0

    def allows(self, now_s: float) -> bool:
        """Whether more may be given now."""
        if int(now_s) != self._second:
            self._second, self._bytes = int(now_s), 0
        return self._bytes < GIVEN_BYTES

    def note(self, size: int) -> None:
        """Count bytes that are given."""
        self._bytes += size
