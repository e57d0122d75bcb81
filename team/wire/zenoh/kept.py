"""What a router keeps of a team while it runs: its end, and the orders of operators who have left.

The final map is kept for who was away as it came. Whether a process that begins belongs to the run
that has ended or to a new one it can not know itself; the router knows who was in that run and has
never said a last word (`Tally`): a node of that name is a straggler, and is told so once. Orders
(a robot withdrawn or given up, verdicts on landmarks, the end of a live team) hold until the final
map is out or nobody of the team is there any more.
"""

import threading
from dataclasses import dataclass, field

from team.wire.messages import FinalMapReply

MOST_ORDERS = 10_000
"""Orders to a team that are kept: whoever has given more repeats them himself."""


@dataclass
class Kept:
    """Of one team. Every call may come from another thread; times are a monotonic clock's [s]."""

    _there: set[str] = field(default_factory=set, init=False)
    _silent: set[str] = field(default_factory=set, init=False)
    _owed: set[str] = field(default_factory=set, init=False)
    _final: tuple[float, bytes] | None = field(default=None, init=False)
    _orders: dict[bytes, None] = field(default_factory=dict, init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def token(self, node: str, *, alive: bool) -> bool:
        """A node's liveliness token appears or goes; whether it went without a last word."""
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
        """A process of this node ends as it should, and knows what it needs to."""
        with self._lock:
            self._silent.discard(node)
            self._owed.discard(node)

    def end(self, final: bytes, now_s: float) -> None:
        """The team's final map is out."""
        with self._lock:
            self._final = now_s, final
            self._owed = set(self._silent)
            self._orders.clear()

    def order(self, order: bytes) -> None:
        """An operator orders something; of more than MOST_ORDERS the first ones."""
        with self._lock:
            if len(self._orders) < MOST_ORDERS:
                self._orders[order] = None

    def orders(self) -> list[bytes]:
        """The orders that hold, the oldest first."""
        with self._lock:
            return list(self._orders)

    def answer(self, node: str, now_s: float) -> FinalMapReply | None:
        """The final map for a node that asks for it; None while there is none."""
        with self._lock:
            if self._final is None:
                return None
            missed = node in self._owed
            self._owed.discard(node)
            since_s, final = self._final
            return FinalMapReply(
                stamp_ns=0, age_ns=round(1e9 * (now_s - since_s)), final=final, missed=missed
            )
