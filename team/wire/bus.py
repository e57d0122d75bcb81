"""The interface of a bus, which carries payloads by key, and a bus in memory."""

import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import msgspec

from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.channels import Channel, channel_of, row_of
from teamslam.team.wire.codec import WireError, decoded, encoded
from teamslam.team.wire.logs import LOG, make_printable

_IN_WORDS = (
    m.Status,
    m.Fault,
    m.FusedMap,
    m.GivenUp,
    m.TeamEnd,
    m.Verdict,
    m.Withdrawal,
    m.WithdrawalHeard,
)
"""Messages with texts for people."""


class Sample(msgspec.Struct, frozen=True, gc=False):
    """A received publication.

    key: relative to the team. stamp_ns: team time. wall_ns, counter: the publisher's, for this key.
    """

    key: str
    payload: bytes
    stamp_ns: int
    wall_ns: int
    counter: int


class Outgoing(NamedTuple):
    """A message on its channel, for a robot or node (empty if the key has no name)."""

    channel: Channel
    name: str
    message: m.Message

    @property
    def key(self) -> str:
        """The relative key."""
        return self.channel.key(self.name)


class BusError(RuntimeError):
    """A failed request to the bus: no router answers, the port is in use, the link is cut."""


_PLACES = re.compile(r"\{(robot|node)\}")
Answer = Callable[[bytes], Iterable[bytes]]
"""Convert the payload of a query to the payloads of its replies."""


@runtime_checkable
class Tap(Protocol):
    """A store of all samples that a bus sends and receives, replies included."""

    def __call__(self, samples: list[Sample]) -> None:
        """Store samples."""

    def lost(self, robot: str) -> list[tuple[int, int, int]]:
        """Return the missing intervals of a robot's measurements (incarnation, first, last)."""


@runtime_checkable
class Bus(Protocol):
    """The bus as a shell uses it; by default no sample is lost.

    dropped: number of received samples without a valid attachment, or under another key.
    """

    dropped: int

    def publish(self, out: Outgoing) -> int:
        """Publish, blocking while receivers are slower; return the payload's size [bytes]."""

    def publish_raw(self, sample: Sample) -> None:
        """Publish a logged sample again, unchanged."""

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        """Subscribe to a channel: `receive` returns each sample of other publishers once.

        whole: deliver all stored samples of a `latest` channel, not only the newest.
        """

    def receive(self, timeout_s: float) -> list[Sample]:
        """Return the samples since the last call, in order; wait at most `timeout_s` for one."""

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        """Answer the queries of `channel` for one name, or `*`; a ValueError's text is a reply."""

    def ask(self, channel: Channel, name: str, request: m.Message, timeout_s: float) -> list[bytes]:
        """Query; return the replies' payloads in order, perhaps none; raises `BusError`."""

    def request(self, channel: Channel, name: str, request: m.Message) -> None:
        """Send a query, unless the same one is open; `receive` returns the replies."""

    def redeliver(self) -> None:
        """Request and deliver all samples of `all` channels and whole subscriptions again."""

    def find_missing(self) -> dict[str, list[tuple[int, int]]]:
        """Return the missing samples: by key, intervals of a publisher's counters."""
        return {}

    def find_awaited(self) -> set[str]:
        """Return the keys with missing samples that their publisher may still have."""
        return set()

    def publish_totals(self) -> m.Tally | None:
        """Publish the number of published samples of each key; None if no sample can be lost."""
        return None

    def declare_alive(self, node: str) -> None:
        """Hold a liveliness token until the bus is closed."""

    def watch_alive(self, node: str = "*") -> None:
        """Receive `Liveliness` of tokens that appear and disappear, the present ones first."""

    def is_alive(self, node: str) -> bool:
        """Return whether a process holds the node's liveliness token."""

    def close(self) -> None:
        """Leave the network and withdraw the tokens."""


def opened(sample: Sample) -> tuple[Channel, str, m.Message]:
    """Decode a sample and check it against its key; return channel, name and message.

    Raises `WireError`, also for a message of one robot or node on the key of another.
    """
    found = channel_of(sample.key)
    if found is None:
        raise WireError("wrong tag", f"no channel has the key {sample.key[:200]!r}")
    channel, name = found
    message: m.Message = decoded(sample.payload, *channel.kinds)
    robot = getattr(message, "robot", name)
    if robot != name and "{robot}" in channel.template:
        raise WireError("wrong field", f"a message of {robot!r} on the key {sample.key!r}")
    sender = getattr(message, "node", None) if type(message) in _WITH_NODE else None
    if channel is ch.ORDER or channel is ch.END_ORDER:
        sender = getattr(message, "by", None)
    if sender is not None and sender != channel.publisher(name):
        raise WireError("wrong field", f"a message of {sender[:80]!r} on the key {sample.key!r}")
    return channel, name, message


def try_open(sample: Sample) -> tuple[Channel, str, m.Message] | None:
    """Decode a sample; None if it is invalid or of no channel."""
    try:
        return opened(sample)
    except WireError:
        return None


def open_printable(sample: Sample) -> tuple[Channel, str, m.Message]:
    """Decode a sample, with printable texts."""
    channel, name, message = opened(sample)
    return channel, name, with_printable_texts(message)


def with_printable_texts(message: m.Message) -> m.Message:
    """Make the texts for people printable."""
    return make_printable(message) if isinstance(message, _IN_WORDS) else message


def open_valid(samples: Iterable[Sample]) -> Iterator[tuple[Channel, str, m.Message]]:
    """Decode the valid samples, with printable texts, and leave out the others."""
    for sample in samples:
        try:
            yield open_printable(sample)
        except WireError as error:
            LOG.debug("dropped %s: %s", sample.key[:80], error)


_WITH_NODE = {m.Configuration, m.Progress, m.Status, m.Liveliness, m.Fault, m.SetSummary, m.Members}
"""Messages that name the node that sends them."""


def read_reply(channel: Channel, name: str, payload: bytes, wall_ns: int) -> Sample:
    """Convert a reply to a sample of its channel; raises `WireError` for one to another query."""
    if channel is ch.KEPT:
        stored = Sample(**msgspec.structs.asdict(decoded(payload, m.Kept)))
        if opened(stored)[0] not in ch.REPLIES[ch.KEPT]:
            text = f"the router stores nothing on the key {stored.key[:80]!r}"
            raise WireError("wrong field", text)
        return stored
    message: m.Message = decoded(payload)
    of = next((c for c in ch.REPLIES[channel] if isinstance(message, c.kinds)), None)
    robot = getattr(message, "robot", getattr(message, "node", ""))
    named = _PLACES.search(channel.template) is not None
    if of is None or (named and robot != name):
        text = f"{type(message).__name__} of {robot!r} is no reply to {channel.key(name)!r}"
        raise WireError("wrong field", text)
    return Sample(of.key(robot), payload, message.stamp_ns, wall_ns, NO_COUNTER)


NO_COUNTER = 2**32 - 1  # the counter of a sample that was a reply


LATEST_CACHE = 8_192
"""Stored publications of a `latest` key: a robot may be 4096 measurements ahead."""
_LARGE = {m.FusedMap: 256, m.MapEstimate: 256, m.Prior: 256, m.Message: 256, m.ParticleCloud: 1_024}
"""The same for maps and views of tens of kilobytes each, and for particles of kilobytes."""
WHOLE_CACHE = 1_000_000


def cache_size(channel: Channel) -> int:
    """Return the number of publications of a key that its publisher stores."""
    if channel.delivery == "all":
        return WHOLE_CACHE
    return _LARGE.get(channel.message, LATEST_CACHE)


@dataclass
class MemoryNetwork:
    """The keys of one process: publications are delivered at once, in order.

    Those of `latest` and `all` channels are stored for late joiners.
    """

    buses: list["MemoryBus"] = field(default_factory=list)
    stored: dict[str, deque[tuple["MemoryBus", Sample]]] = field(default_factory=dict)
    answers: list[tuple[Channel, str, Answer]] = field(default_factory=list)
    alive: dict[str, tuple["MemoryBus", Sample]] = field(default_factory=dict)
    receivers: dict[str, list["MemoryBus"]] = field(default_factory=dict)
    """The buses that subscribed to a key, in the order in which they were made; a cache."""

    def receivers_of(self, key: str) -> list["MemoryBus"]:
        """Return the buses that subscribed to a key, in the order in which they were made."""
        if key not in self.receivers:
            row = row_of(key)
            owner = None if row is None else row.owner(key)
            self.receivers[key] = [
                bus for bus in self.buses if row is not None and bus.wants(row, owner)
            ]
        return self.receivers[key]

    def deliver(self, source: "MemoryBus", sample: Sample) -> None:
        """Deliver a sample to every other subscribed bus, and store it for late joiners."""
        found = channel_of(sample.key)
        if found is not None and found[0].delivery != "stream":
            stored = self.stored.setdefault(sample.key, deque(maxlen=cache_size(found[0])))
            stored.append((source, sample))
        self.notify(source, sample)

    def notify(self, source: "MemoryBus", sample: Sample) -> None:
        """Queue a sample for every other subscribed bus."""
        for bus in self.receivers_of(sample.key):
            if bus is not source:
                bus.arrived.append(sample)


class MemoryBus(Bus):
    """A bus within one process: synchronous, deterministic, with the wall clock zero.

    Samples stored for late joiners come first; `receive` never waits.
    """

    def __init__(self, network: MemoryNetwork) -> None:
        self.dropped = 0
        self.arrived: deque[Sample] = deque()
        self._network = network
        self._names: dict[str, set[str]] = defaultdict(set)
        self._whole: set[str] = set()
        self._counters: dict[str, int] = defaultdict(int)
        network.buses.append(self)
        network.receivers.clear()

    def publish(self, out: Outgoing) -> int:
        counter = self._counters[out.key]
        self._counters[out.key] = counter + 1
        payload = encoded(out.message)
        self.publish_raw(Sample(out.key, payload, out.message.stamp_ns, 0, counter))
        return len(payload)

    def publish_raw(self, sample: Sample) -> None:
        self._network.deliver(self, sample)

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        for key, stored in self._network.stored.items():
            if _is_of(channel, name, key) and not self._is_subscribed(key):
                requested = list(stored) if whole or channel.delivery == "all" else [stored[-1]]
                self.arrived.extend(sample for source, sample in requested if source is not self)
        if whole:
            self._whole.add(channel.name)
        self._want(channel, name)

    def _want(self, channel: Channel, name: str) -> None:
        self._names[channel.name].add(name)
        self._network.receivers.clear()

    def wants(self, channel: Channel, owner: str | None) -> bool:
        """Return whether this bus subscribed to the channel's key of a robot or node."""
        names = self._names.get(channel.name, ())
        return bool(names) if owner == "" else "*" in names or owner in names

    def _is_subscribed(self, key: str) -> bool:
        return self in self._network.receivers_of(key)

    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        arrived = self.arrived  # one by one: another thread may be publishing
        return [arrived.popleft() for _ in range(len(arrived))]

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        self._network.answers.append((channel, name, answer))

    def ask(self, channel: Channel, name: str, request: m.Message, timeout_s: float) -> list[bytes]:
        for answered, names, answer in self._network.answers:
            if answered is channel and _is_of(channel, names, channel.key(name)):
                try:
                    return list(answer(encoded(request)))
                except ValueError as error:
                    raise BusError(f"{channel.key(name)}: {error}") from error
        return []

    def request(self, channel: Channel, name: str, request: m.Message) -> None:
        for payload in self.ask(channel, name, request, 0.0):
            with suppress(WireError):  # invalid replies are dropped
                self.arrived.append(read_reply(channel, name, payload, 0))

    def redeliver(self) -> None:
        for key, stored in self._network.stored.items():
            row = row_of(key)
            if row is None or not self._is_subscribed(key):
                continue
            if row.delivery == "all" or row.name in self._whole:
                self.arrived.extend(sample for source, sample in stored if source is not self)

    def declare_alive(self, node: str) -> None:
        sample = _token(node, alive=True)
        self._network.alive[node] = (self, sample)
        self._network.notify(self, sample)

    def watch_alive(self, node: str = "*") -> None:
        self._want(ch.ALIVE, node)
        for source, sample in self._network.alive.values():
            if source is not self and self._is_subscribed(sample.key):
                self.arrived.append(sample)

    def is_alive(self, node: str) -> bool:
        return node in self._network.alive

    def close(self) -> None:
        self._network.buses.remove(self)
        self._network.receivers.clear()
        own = [node for node, (source, _) in self._network.alive.items() if source is self]
        for node in own:
            del self._network.alive[node]
            self._network.notify(self, _token(node, alive=False))


def _token(node: str, *, alive: bool) -> Sample:
    token = m.Liveliness(stamp_ns=0, node=node, alive=alive)
    return Sample(ch.ALIVE.key(node), encoded(token), 0, 0, 0)


def _is_of(channel: Channel, name: str, key: str) -> bool:
    owner = channel.owner(key)
    return owner is not None and (owner == "" or name in ("*", owner))
