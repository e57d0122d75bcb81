"""Keys that are not a team's, as those of ROS 2: what is published there, as it comes."""

import json
from collections.abc import Sequence
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import NamedTuple, Self

import zenoh

from team.wire.bus import BusError

TOKENS_S = 5.0
"""How long to wait for the tokens that are there."""


class ForeignSample(NamedTuple):
    """One publication; of a liveliness token the payload is empty and alive says which way."""

    key: str
    payload: bytes
    token: bool = False
    alive: bool = True


class ForeignKeys:
    """Subscriptions to keys and tokens at a router or peer; raises BusError where none answers.

    Received on Zenoh's thread into one queue; `receive` takes from it.
    """

    def __init__(
        self, connect: str, keys: Sequence[str], tokens: Sequence[str], patience_s: float = 10.0
    ) -> None:
        config = zenoh.Config()
        settings: dict[str, object] = {
            "mode": "client",
            "connect/endpoints": [connect],
            "connect/timeout_ms": max(1, round(1e3 * patience_s)),
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
        }
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise BusError(f"nobody answers at {connect} ({patience_s:g} s): {error}") from None
        self._queue: SimpleQueue[ForeignSample] = SimpleQueue()
        for token in tokens:  # those that are there come before all samples
            for reply in self._session.liveliness().get(token, timeout=TOKENS_S):
                if reply.ok is not None:
                    self._take_token(reply.ok)
            self._session.liveliness().declare_subscriber(token, self._take_token)
        for key in keys:
            self._session.declare_subscriber(key, self._take)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._session.close()  # type: ignore[no-untyped-call] # zenoh leaves out `-> None`

    def receive(self, timeout_s: float) -> list[ForeignSample]:
        """All that has come; waits for the first so long."""
        found: list[ForeignSample] = []
        try:
            found.append(self._queue.get(timeout=timeout_s))
            while True:
                found.append(self._queue.get_nowait())
        except Empty:
            return found

    def _take(self, sample: zenoh.Sample) -> None:
        self._queue.put(ForeignSample(str(sample.key_expr), sample.payload.to_bytes()))

    def _take_token(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        self._queue.put(ForeignSample(str(sample.key_expr), b"", token=True, alive=alive))
