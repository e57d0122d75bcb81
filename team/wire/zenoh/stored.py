"""What a router stores of a team while it runs: its final map, and orders of operators who have
left.

The final map is stored for processes that were absent when it was published. A starting process can
not know itself whether it belongs to the run that has ended or to a new one; the router knows the
nodes of that run that never announced their end (`Tally`): a node of that name missed the end, and
is sent the map once. Orders (a robot withdrawn or given up, verdicts on landmarks, the end of a
live team) are valid until the final map is published or no process of the team is present any more.
"""

import threading
from dataclasses import dataclass, field

from team.wire.messages import FinalMapReply

MOST_ORDERS = 10_000
"""Number of orders to a team that are stored; an operator who gives more has to repeat the
others.
"""


@dataclass
class StoredMessages:
    """The stored messages of one team. Calls may come from any thread; times are a monotonic
    clock's [s].
    """

    _there: set[str] = field(default_factory=set, init=False)
    _silent: set[str] = field(default_factory=set, init=False)
    _owed: set[str] = field(default_factory=set, init=False)
    _final: tuple[float, bytes] | None = field(default=None, init=False)
    _orders: dict[bytes, None] = field(default_factory=dict, init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def token(self, node: str, *, alive: bool) -> bool:
        """Records that a node's liveliness token appears or disappears; returns whether the node
        crashed.
        """
        with self._lock:
            if alive:
                self._there.add(node)
                self._silent.add(node)
                return False
            self._there.discard(node)
            if not self._there:
                self._orders.clear()
            return node in self._silent

    def last_word(self, node: str) -> None:
        """Records that a process of this node ends in order, so that it does not need the final
        map.
        """
        with self._lock:
            self._silent.discard(node)
            self._owed.discard(node)

    def end(self, final: bytes, now_s: float) -> None:
        """Stores the team's final map."""
        with self._lock:
            self._final = now_s, final
            self._owed = set(self._silent)
            self._orders.clear()

    def order(self, order: bytes) -> None:
        """Stores an operator's order; only the first MOST_ORDERS are stored."""
        with self._lock:
            if len(self._orders) < MOST_ORDERS:
                self._orders[order] = None

    def orders(self) -> list[bytes]:
        """The valid orders, the oldest first."""
        with self._lock:
            return list(self._orders)

    def answer(self, node: str, now_s: float) -> FinalMapReply | None:
        """The reply to a node that requests the final map; None while there is no map."""
        with self._lock:
            if self._final is None:
                return None
            missed = node in self._owed
            self._owed.discard(node)
            since_s, final = self._final
            return FinalMapReply(
                stamp_ns=0, age_ns=round(1e9 * (now_s - since_s)), final=final, missed=missed
            )
