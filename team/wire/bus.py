"""A bus carries payloads by key. Two implementations: here in memory, and `team.wire.zenoh`.

A received `Sample` contains the relative key, the payload as it was published, the team time, the
publisher's wall clock and the publisher's counter of this key. A node never uses a bus itself: its
shell receives the samples, decodes them, and publishes the messages that the node returns.
"""

import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from typing import NamedTuple, Protocol, runtime_checkable

import msgspec

from team.wire.channels import ALIVE, END_ORDER, KEPT, ORDER, REPLIES, VIEW, Channel, channel_of
from team.wire.codec import WireError, decoded, encoded
from team.wire.logs import LOG
from team.wire.messages import (
    Configuration,
    Fault,
    FusedMap,
    GivenUp,
    Kept,
    Liveliness,
    MapEstimate,
    Members,
    Message,
    ParticleCloud,
    Prior,
    Progress,
    SetSummary,
    Status,
    Tally,
    TeamEnd,
    Verdict,
    Withdrawal,
    WithdrawalHeard,
)
from team.wire.text import readable

_IN_WORDS = (Status, Fault, FusedMap, GivenUp, TeamEnd, Verdict, Withdrawal, WithdrawalHeard)
"""Messages with texts for people."""


class Sample(msgspec.Struct, frozen=True, gc=False):
    """One publication as it was received; a log has hundreds of thousands."""

    key: str
    payload: bytes
    stamp_ns: int
    wall_ns: int
    counter: int


class Outgoing(NamedTuple):
    """A message on its channel, for one robot or node (empty where the channel's key has no
    name).
    """

    channel: Channel
    name: str
    message: Message

    @property
    def key(self) -> str:
        """The relative key."""
        return self.channel.key(self.name)


class BusError(RuntimeError):
    """The bus can not do what was requested: no router answers, the port is in use, the link is
    cut.
    """


_PLACES = re.compile(r"\{(robot|node)\}")
Answer = Callable[[bytes], Iterable[bytes]]
"""Answers a query: takes the request's payload, returns the payloads of the replies."""


@runtime_checkable
class Tap(Protocol):
    """Stores all samples that a bus sends and receives, replies included: a process' own log."""

    def __call__(self, samples: list[Sample]) -> None:
        """Stores these samples."""

    def lost(self, robot: str) -> list[tuple[int, int, int]]:
        """Intervals of a robot's measurements that are known to exist and are not stored, as after
        a crash: incarnation, first number, last number.
        """


@runtime_checkable
class Bus(Protocol):
    """The bus as a shell uses it.

    dropped: number of received samples that were dropped, since they came without a sound
        attachment, or under another key than the one on which they were published.
    """

    dropped: int

    def publish(self, out: Outgoing) -> int:
        """Publishes; returns the payload's number of bytes. Blocks, with a bound, while receivers
        are slower.
        """

    def publish_raw(self, sample: Sample) -> None:
        """Publishes a logged sample again, with its bytes, its stamps and its counter."""

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        """Subscribes: from now on `receive` returns what others publish on the channel, each sample
        once.

        whole: for a `latest` channel all samples that its publishers still have, not only the
            newest one.
        """

    def receive(self, timeout_s: float) -> list[Sample]:
        """All samples received since the last call, in order; waits at most `timeout_s` for the
        first one.
        """

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        """Answers the queries of `channel` for one name, or `*`; a ValueError's text is sent to the
        asker.
        """

    def ask(self, channel: Channel, name: str, request: Message, timeout_s: float) -> list[bytes]:
        """The replies' payloads, in order; empty when nobody answers. Raises `BusError` on an
        error.
        """

    def request(self, channel: Channel, name: str, request: Message) -> None:
        """Sends a query without waiting: `receive` returns the replies, as samples of their
        channels.

        Does nothing while the same query is open. A reply has no counter of its own (`NO_COUNTER`),
        and the wall clock of its arrival.
        """

    def again(self) -> None:
        """Requests and delivers all samples of `all` channels and whole subscriptions once more."""

    def lacking(self) -> dict[str, list[tuple[int, int]]]:
        """Samples that are known to exist and were not received: by key, intervals of a publisher's
        counters.
        """

    def awaited(self) -> set[str]:
        """Keys with missing samples that their publisher may still have."""

    def publish_totals(self) -> Tally | None:
        """Publishes how many samples of each key this process has published; None where nothing can
        get lost.
        """

    def declare_alive(self, node: str) -> None:
        """Holds a liveliness token until the bus is closed."""

    def watch_alive(self, node: str = "*") -> None:
        """Receives `Liveliness` of others' tokens as they appear and disappear, the present ones
        first.
        """

    def is_alive(self, node: str) -> bool:
        """Whether anyone holds the node's liveliness token."""

    def close(self) -> None:
        """Leaves the network; the tokens are withdrawn."""


def opened(sample: Sample) -> tuple[Channel, str, Message]:
    """The channel, the name and the message of a sample, checked against its key; raises
    `WireError`.

    A robot's message on another robot's key is refused, and a node's on another node's.
    """
    found = channel_of(sample.key)
    if found is None:
        raise WireError("wrong tag", f"no channel has the key {sample.key[:200]!r}")
    channel, name = found
    message: Message = decoded(sample.payload, *channel.kinds)
    robot = getattr(message, "robot", name)
    if "{robot}" in channel.template and robot != name:
        raise WireError("wrong field", f"a message of {robot!r} on the key {sample.key!r}")
    sender = _sender_of(channel, message)
    if sender not in (None, channel.publisher(name)):
        raise WireError(
            "wrong field", f"a message of {str(sender)[:80]!r} on the key {sample.key!r}"
        )
    return channel, name, message


def shown(sample: Sample) -> tuple[Channel, str, Message]:
    """As `opened`, for a reader that shows the message to people: its texts are printable."""
    channel, name, message = opened(sample)
    return channel, name, readable(message) if isinstance(message, _IN_WORDS) else message


def sound(samples: Iterable[Sample]) -> Iterator[tuple[Channel, str, Message]]:
    """The sound ones of some samples, each as `opened` returns it; the others are left out.

    For a reader that only observes: an unsound sample is no message of the team, whoever has sent
    it. Texts are as `shown` returns them.
    """
    for sample in samples:
        try:
            yield shown(sample)
        except WireError as error:
            LOG.debug("dropped %s: %s", sample.key[:80], error)


def _sender_of(channel: Channel, message: Message) -> str | None:
    """The node that a message gives as its sender; None where it gives none."""
    match message:
        case Configuration() | Progress() | Status() | Liveliness() | Fault():
            return message.node
        case SetSummary() | Members():
            return message.node
        case Withdrawal() if channel is ORDER:
            return message.by
        case TeamEnd() if channel is END_ORDER:
            return message.by
        case _:
            return None


def replied(channel: Channel, name: str, payload: bytes, wall_ns: int) -> Sample:
    """A reply to a query as a sample of the channel that its message belongs to; a stored sample
    as its author published it.

    Raises `WireError` where it is no message that answers this query, or belongs to another robot.
    """
    if channel is KEPT:
        return _kept(payload)
    message: Message = decoded(payload)
    of = next((c for c in REPLIES[channel] if isinstance(message, c.kinds)), None)
    robot = getattr(message, "robot", getattr(message, "node", ""))
    named = _PLACES.search(channel.template) is not None
    if of is None or (named and robot != name):
        text = f"{type(message).__name__} of {robot!r} is no reply to {channel.key(name)!r}"
        raise WireError("wrong field", text)
    return Sample(of.key(robot), payload, message.stamp_ns, wall_ns, NO_COUNTER)


def _kept(payload: bytes) -> Sample:
    """The sample in a reply of the router; raises `WireError`."""
    kept = decoded(payload, Kept)
    sample = Sample(kept.key, kept.payload, kept.stamp_ns, kept.wall_ns, kept.counter)
    if opened(sample)[0] not in REPLIES[KEPT]:
        raise WireError("wrong field", f"the router stores nothing on the key {kept.key[:80]!r}")
    return sample


NO_COUNTER = 2**32 - 1
"""Stands for the counter of a sample that was a reply: it was published at another time, or
never.
"""


LATEST_CACHE = 8_192
"""Number of publications of a `latest` key that its publisher stores: a robot may be 4096
measurements ahead.
"""
CLOUDS_CACHE = 1_024
"""The same for particles, of kilobytes each."""
MAPS_CACHE = 256
"""The same for maps, of tens of kilobytes each; a joint covariance is larger."""
VIEWS_CACHE = 256
"""The same for views, of tens of kilobytes each."""
WHOLE_CACHE = 1_000_000


def cache_size(channel: Channel) -> int:
    """Number of publications of a key that its publisher stores for late joiners and after a
    cut.
    """
    if channel.delivery == "all":
        return WHOLE_CACHE
    if channel.message in (FusedMap, MapEstimate, Prior):
        return MAPS_CACHE
    if channel is VIEW:
        return VIEWS_CACHE
    return CLOUDS_CACHE if channel.message is ParticleCloud else LATEST_CACHE


@dataclass
class MemoryNetwork:
    """The keys of one process: publications are delivered at once, in order, to every other bus.

    It stores the publications that `latest` and `all` channels promise to late joiners.
    """

    buses: list["MemoryBus"] = field(default_factory=list)
    stored: dict[str, deque[tuple["MemoryBus", Sample]]] = field(default_factory=dict)
    answers: list[tuple[Channel, str, Answer]] = field(default_factory=list)
    alive: dict[str, tuple["MemoryBus", Sample]] = field(default_factory=dict)
    _numbers: Iterator[int] = field(default_factory=count)
    _requests: dict[str, tuple[Channel, dict[str, set["MemoryBus"]]]] = field(default_factory=dict)
    _receivers: dict[str, list["MemoryBus"]] = field(default_factory=dict)

    def enter(self, bus: "MemoryBus") -> None:
        """Adds a bus, the last one to which a sample is delivered."""
        self.buses.append(bus)
        bus.number = next(self._numbers)

    def leave(self, bus: "MemoryBus") -> None:
        """Removes a bus."""
        self.buses.remove(bus)
        for _, buses in self._requests.values():
            for wanting in buses.values():
                wanting.discard(bus)
        self._receivers.clear()

    def want(self, bus: "MemoryBus", channel: Channel, name: str) -> None:
        """Adds the subscription of a bus."""
        _, buses = self._requests.setdefault(channel.name, (channel, {}))
        buses.setdefault(name, set()).add(bus)
        self._receivers.clear()

    def receivers(self, key: str) -> list["MemoryBus"]:
        """The buses that subscribed to a key, in the order in which they were added."""
        found = self._receivers.get(key)
        if found is None:
            wanting: set[MemoryBus] = set()
            for channel, buses in self._requests.values():
                owner = channel.owner(key)
                if owner is not None:
                    names = buses if owner == "" else ("*", "**", owner)
                    wanting.update(*(buses.get(name, ()) for name in names))
            found = self._receivers[key] = sorted(wanting, key=lambda bus: bus.number)
        return found

    def deliver(self, source: "MemoryBus", sample: Sample) -> None:
        """Delivers a sample to every other bus that subscribed, and stores it for late joiners."""
        found = channel_of(sample.key)
        if found is not None and found[0].delivery != "stream":
            stored = self.stored.setdefault(sample.key, deque(maxlen=cache_size(found[0])))
            stored.append((source, sample))
        for bus in self.receivers(sample.key):
            if bus is not source:
                bus.queue(sample)


class MemoryBus:
    """A bus within one process: synchronous and deterministic.

    number: its place among those of the network.
    """

    def __init__(self, network: MemoryNetwork) -> None:
        self.number = 0
        self.dropped = 0
        self._network = network
        self._arrived: deque[Sample] = deque()
        self._whole: set[str] = set()
        self._counters: dict[str, int] = defaultdict(int)
        network.enter(self)

    def publish(self, out: Outgoing) -> int:
        """Encodes and delivers at once; the wall clock of a memory bus is always zero."""
        counter = self._counters[out.key]
        self._counters[out.key] = counter + 1
        payload = encoded(out.message)
        self.publish_raw(Sample(out.key, payload, out.message.stamp_ns, 0, counter))
        return len(payload)

    def publish_raw(self, sample: Sample) -> None:
        """Delivers the sample at once, unchanged."""
        self._network.deliver(self, sample)

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        """Subscribes to this channel; the samples stored for late joiners come first."""
        for key, stored in self._network.stored.items():
            if _is_of(channel, name, key) and not self._subscribed(key):
                requested = list(stored) if whole or channel.delivery == "all" else [stored[-1]]
                self._arrived.extend(sample for source, sample in requested if source is not self)
        if whole:
            self._whole.add(channel.name)
        self._network.want(self, channel, name)

    def _subscribed(self, key: str) -> bool:
        return self in self._network.receivers(key)

    def queue(self, sample: Sample) -> None:
        """Queues a sample, which `receive` returns."""
        self._arrived.append(sample)

    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        """All samples received since the last call; a memory bus never waits."""
        arrived = self._arrived  # one by one: another thread may be publishing
        return [arrived.popleft() for _ in range(len(arrived))]

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        """Answers queries, within `ask`."""
        self._network.answers.append((channel, name, answer))

    def ask(self, channel: Channel, name: str, request: Message, timeout_s: float) -> list[bytes]:
        """The replies' payloads, computed at once."""
        for answered, names, answer in self._network.answers:
            if answered is channel and _is_of(channel, names, channel.key(name)):
                try:
                    return list(answer(encoded(request)))
                except ValueError as error:
                    raise BusError(f"{channel.key(name)}: {error}") from error
        return []

    def request(self, channel: Channel, name: str, request: Message) -> None:
        """Sends a query; `receive` returns the replies with its next samples."""
        for payload in self.ask(channel, name, request, 0.0):
            with suppress(WireError):  # what is no reply to this question is dropped
                self._arrived.append(replied(channel, name, payload, 0))

    def again(self) -> None:
        """Delivers the stored samples of whole subscriptions and of `all` channels once more."""
        for key, stored in self._network.stored.items():
            found = channel_of(key)
            if found is None or not self._subscribed(key):
                continue
            if found[0].delivery == "all" or found[0].name in self._whole:
                self._arrived.extend(sample for source, sample in stored if source is not self)

    def lacking(self) -> dict[str, list[tuple[int, int]]]:
        """Nothing is lost in memory: an empty table."""
        return {}

    def awaited(self) -> set[str]:
        """Nothing is lost in memory: an empty set."""
        return set()

    def publish_totals(self) -> Tally | None:
        """Nothing is lost in memory: nothing is published."""
        return None

    def declare_alive(self, node: str) -> None:
        """Holds a token."""
        self._token(node, alive=True)

    def watch_alive(self, node: str = "*") -> None:
        """Receives changes of tokens, the present ones first."""
        self._network.want(self, ALIVE, node)
        for source, sample in self._network.alive.values():
            if source is not self and self._subscribed(sample.key):
                self.queue(sample)

    def is_alive(self, node: str) -> bool:
        """Whether anyone holds the token."""
        return node in self._network.alive

    def _token(self, node: str, *, alive: bool) -> None:
        sample = Sample(
            ALIVE.key(node), encoded(Liveliness(stamp_ns=0, node=node, alive=alive)), 0, 0, 0
        )
        if alive:
            self._network.alive[node] = (self, sample)
        else:
            self._network.alive.pop(node, None)
        for bus in self._network.receivers(sample.key):
            if bus is not self:
                bus.queue(sample)

    def close(self) -> None:
        """Leaves the network; the tokens are withdrawn."""
        self._network.leave(self)
        own = [node for node, (source, _) in self._network.alive.items() if source is self]
        for node in own:
            self._token(node, alive=False)


def _is_of(channel: Channel, name: str, key: str) -> bool:
    owner = channel.owner(key)
    return owner is not None and (owner == "" or name in ("*", owner))
