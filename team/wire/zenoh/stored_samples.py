"""Samples of a team that a router stores for absent processes: ends and orders.

A stored sample keeps its key, bytes and attachment, and thereby its author. An end replaces one of
the same author, and is sent to a node that was in that run and never announced its end (`Tally`),
until one of its processes does. Orders are valid until the centre's final map, or until no process
of the team is present.
"""

import threading
from dataclasses import dataclass, field

import msgspec

from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.channels import ENDS, FINAL_MAP, ORDERS
from teamslam.team.wire.codec import WireError, decoded, encoded
from teamslam.team.wire.messages import FusedMap, Kept, KeptRequest

MOST_ORDERS = 10_000  # most stored orders to a team, signatures included
MOST_ENDS = 400  # most keys of stored ends: two per robot of the largest team, and others

MOST_NODES = 1_000  # most nodes of a team whose end is tracked


@dataclass(frozen=True)
class _End:
    channel: str
    since_s: float
    reply: bytes
    missed_by: set[str]


@dataclass
class StoredMessages:
    """Stored messages of one team. Calls come from any thread; times are monotonic [s]."""

    _there: set[str] = field(default_factory=set, init=False)
    _silent: set[str] = field(default_factory=set, init=False)
    _ends: dict[str, _End] = field(default_factory=dict, init=False)
    _orders: dict[tuple[str, bytes], tuple[str, bytes]] = field(default_factory=dict, init=False)
    """By key and payload, the channel and the payload of the reply."""
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def token(self, node: str, *, alive: bool) -> bool:
        """Record a node's liveliness token; return whether the node crashed."""
        with self._lock:
            if alive:
                self._there.add(node)
                if len(self._silent) < MOST_NODES:
                    self._silent.add(node)
                return False
            self._there.discard(node)
            if not self._there:
                self._orders.clear()
            return node in self._silent

    def last_word(self, node: str) -> None:
        """Record the orderly end of a node's process, which needs no stored end."""
        with self._lock:
            self._silent.discard(node)
            for end in self._ends.values():
                end.missed_by.discard(node)

    def take(self, sample: Sample, now_s: float) -> None:
        """Store an end or an order; raises `WireError` for an invalid one."""
        channel, _, message = opened(sample)
        reply = encoded(Kept(**msgspec.structs.asdict(sample)))
        decoded(reply, Kept)  # its receivers check the attachment, too
        if channel in ENDS and isinstance(message, FusedMap) and not message.final:
            raise WireError("wrong field", f"no final map on the key {sample.key!r}")
        name = sample.key, sample.payload
        with self._lock:
            if channel in ENDS and (sample.key in self._ends or len(self._ends) < MOST_ENDS):
                self._ends[sample.key] = _End(channel.name, now_s, reply, set(self._silent))
                if channel is FINAL_MAP:
                    self._orders.clear()
            elif channel in ORDERS and len(self._orders) < MOST_ORDERS:
                self._orders.setdefault(name, (channel.name, reply))

    def answer(self, request: KeptRequest, now_s: float) -> list[bytes]:
        """Return the stored samples for a node, the oldest first, as payloads of `Kept`."""
        with self._lock:
            orders = [reply for name, reply in self._orders.values() if name in request.channels]
            ends = [
                end
                for end in self._ends.values()
                if end.channel in request.channels
                and (now_s - end.since_s <= 1e-9 * request.run_ns or request.node in end.missed_by)
            ]
        return [*orders, *(end.reply for end in sorted(ends, key=lambda end: end.since_s))]
