"""How many bytes of members a peer gives to others."""

GIVEN_BYTES = 8 * 2**20
"""Most bytes of members given to one node within a second; to all nodes together GIVEN_TO_ALL."""
GIVEN_TO_ALL = 32 * 2**20


class Given:
    """Bytes given within the current second, to each node and to all, which limits the cost of
    endless requests.
    """

    def __init__(self) -> None:
        self._second = 0
        self._bytes: dict[str, int] = {}

    def allows(self, node: str, now_s: float) -> bool:
        """Whether a node may be given more now."""
        if int(now_s) != self._second:
            self._second, self._bytes = int(now_s), {}
        return self._bytes.get(node, 0) < GIVEN_BYTES and sum(self._bytes.values()) < GIVEN_TO_ALL

    def note(self, node: str, size: int) -> None:
        """Count bytes given to a node."""
        self._bytes[node] = self._bytes.get(node, 0) + size
