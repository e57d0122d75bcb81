"""A bus carries payloads by key. Two implementations: here in memory, and `team.wire.zenoh`.

A `Sample` is what arrives: the relative key, the payload as it was published, and beside it the
team time, the publisher's wall clock and its counter of this key. A node never sees a bus: its
shell takes samples from it, decodes them at the door, and publishes what the node returns.
"""

import logging
import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

from team.wire.channels import ALIVE, END_ORDER, ORDER, REPLIES, VIEW, Channel, channel_of
from team.wire.codec import WireError, decoded, encoded
from team.wire.messages import (
    Configuration,
    Fault,
    FusedMap,
    Liveliness,
    MapEstimate,
    Members,
    Message,
    ParticleCloud,
    Prior,
    Progress,
    SetSummary,
    Status,
    TeamEnd,
    Withdrawal,
)

_LOG = logging.getLogger("teamslam")


@dataclass(frozen=True)
class Sample:
    """One publication as it arrived."""

    key: str
    payload: bytes
    stamp_ns: int
    wall_ns: int
    counter: int


class Outgoing(NamedTuple):
    """A message on its channel, for one robot or node (empty where the key has no name)."""

    channel: Channel
    name: str
    message: Message

    @property
    def key(self) -> str:
        """The relative key."""
        return self.channel.key(self.name)


class BusError(RuntimeError):
    """The bus can not do what it was asked: nobody listens, the port is taken, the link is cut."""


_PLACES = re.compile(r"\{(robot|node)\}")
Answer = Callable[[bytes], Iterable[bytes]]
"""Answers a query: the request's payload in, the replies' payloads out."""


@runtime_checkable
class Tap(Protocol):
    """What keeps all that a bus sends and receives, replies to its questions, too: an own log."""

    def __call__(self, samples: list[Sample]) -> None:
        """Keep these."""

    def lost(self, robot: str) -> list[tuple[int, int, int]]:
        """Measurements of a robot that are known of and not kept, as after a death: incarnation,
        first number, last number.
        """


@runtime_checkable
class Bus(Protocol):
    """What a shell needs of a bus."""

    def publish(self, out: Outgoing) -> int:
        """Publish; the payload's bytes. Blocks, with a bound, when receivers do not keep up."""

    def publish_raw(self, sample: Sample) -> None:
        """Publish a sample of a log again: its bytes, its stamps and its counter."""

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        """From now on `receive` returns what others publish there, each sample once.

        whole: of a `latest` channel not the newest one, but all that there still is.
        """

    def receive(self, timeout_s: float) -> list[Sample]:
        """What has arrived, in order; waits at most `timeout_s` for the first."""

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        """Answer the queries of `channel` for one name, or `*`; an asker is told a ValueError."""

    def ask(self, channel: Channel, name: str, request: Message, timeout_s: float) -> list[bytes]:
        """The replies' payloads, in order; empty when nobody answers, `BusError` on an error."""

    def request(self, channel: Channel, name: str, request: Message) -> None:
        """Ask without waiting: the replies come out of `receive`, as samples of their channels.

        While the same is being asked nothing happens. A reply has no counter of its own
        (`NO_COUNTER`), and the wall clock of its arrival.
        """

    def again(self) -> None:
        """What was delivered of `all` and whole channels is asked for and delivered once more."""

    def lacking(self) -> dict[str, list[tuple[int, int]]]:
        """What is known of and has not arrived: by key, intervals of a publisher's numbers."""

    def declare_alive(self, node: str) -> None:
        """Hold a liveliness token until the bus is closed."""

    def watch_alive(self, node: str = "**") -> None:
        """Receive `Liveliness` of others' tokens as they appear and go, the present ones first."""

    def is_alive(self, node: str) -> bool:
        """Whether anyone holds the node's liveliness token."""

    def close(self) -> None:
        """Leave; the tokens go."""


def opened(sample: Sample) -> tuple[Channel, str, Message]:
    """The message of a sample, checked against its key; raises `WireError`.

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
    said_by = _said_by(channel, message)
    if said_by not in (None, channel.publisher(name)):
        raise WireError(
            "wrong field", f"a message of {str(said_by)[:80]!r} on the key {sample.key!r}"
        )
    return channel, name, message


def sound(samples: Iterable[Sample]) -> Iterator[tuple[Channel, str, Message]]:
    """What of samples is sound, each as `opened` has it, for who only looks on: the rest is no
    message of the team's, whoever has sent it.
    """
    for sample in samples:
        try:
            yield opened(sample)
        except WireError as error:
            _LOG.debug("dropped %s: %s", sample.key[:80], error)


def _said_by(channel: Channel, message: Message) -> str | None:
    """The node that a message names as its own; None where it names none."""
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
    """A reply to a query as a sample of the channel that its message belongs to.

    Raises `WireError` where it is no message that answers this query, or one of another robot.
    """
    message: Message = decoded(payload)
    of = next((c for c in REPLIES[channel] if isinstance(message, c.kinds)), None)
    robot = getattr(message, "robot", getattr(message, "node", ""))
    named = _PLACES.search(channel.template) is not None
    if of is None or (named and robot != name):
        text = f"{type(message).__name__} of {robot!r} is no reply to {channel.key(name)!r}"
        raise WireError("wrong field", text)
    return Sample(of.key(robot), payload, message.stamp_ns, wall_ns, NO_COUNTER)


NO_COUNTER = 2**32 - 1
"""In the place of the counter of what was asked for: it was published at another time, or never."""


LATEST_KEPT = 8_192
"""Publications of a `latest` key that a publisher keeps: a robot may be 4096 measurements ahead."""
CLOUDS_KEPT = 1_024
"""… of particles: kilobytes each."""
MAPS_KEPT = 256
"""… of maps: tens of kilobytes each, a joint covariance more."""
VIEWS_KEPT = 256
"""… of views: tens of kilobytes each."""
ALL_KEPT = 1_000_000


def kept_of(channel: Channel) -> int:
    """How many publications of a key its publisher keeps, for who comes late or was cut off."""
    if channel.delivery == "all":
        return ALL_KEPT
    if channel.message in (FusedMap, MapEstimate, Prior):
        return MAPS_KEPT
    if channel is VIEW:
        return VIEWS_KEPT
    return CLOUDS_KEPT if channel.message is ParticleCloud else LATEST_KEPT


@dataclass
class MemoryNetwork:
    """The keys of one process: publications are delivered at once, in order, to every other bus.

    It keeps what `latest` and `all` channels promise late joiners.
    """

    buses: list["MemoryBus"] = field(default_factory=list)
    kept: dict[str, deque[tuple["MemoryBus", Sample]]] = field(default_factory=dict)
    answers: list[tuple[Channel, str, Answer]] = field(default_factory=list)
    alive: dict[str, tuple["MemoryBus", Sample]] = field(default_factory=dict)

    def deliver(self, source: "MemoryBus", sample: Sample) -> None:
        """Hand a sample to every other bus that subscribed, and keep it for late joiners."""
        found = channel_of(sample.key)
        if found is not None and found[0].delivery != "stream":
            kept = self.kept.setdefault(sample.key, deque(maxlen=kept_of(found[0])))
            kept.append((source, sample))
        for bus in self.buses:
            if bus is not source:
                bus.offer(sample)


class MemoryBus:
    """A bus within one process: synchronous and deterministic."""

    def __init__(self, network: MemoryNetwork) -> None:
        self._network = network
        self._arrived: deque[Sample] = deque()
        self._requested: list[tuple[Channel, str]] = []
        self._whole: set[str] = set()
        self._known: dict[str, bool] = {}
        self._counters: dict[str, int] = defaultdict(int)
        network.buses.append(self)

    def publish(self, out: Outgoing) -> int:
        """Encode and deliver at once; the wall clock of a memory bus is always zero."""
        counter = self._counters[out.key]
        self._counters[out.key] = counter + 1
        payload = encoded(out.message)
        self.publish_raw(Sample(out.key, payload, out.message.stamp_ns, 0, counter))
        return len(payload)

    def publish_raw(self, sample: Sample) -> None:
        """Deliver at once, as it is."""
        self._network.deliver(self, sample)

    def subscribe(self, channel: Channel, name: str = "*", *, whole: bool = False) -> None:
        """Receive this channel, what is kept for late joiners first."""
        for key, kept in self._network.kept.items():
            if _is_of(channel, name, key) and not self._subscribed(key):
                requested = list(kept) if whole or channel.delivery == "all" else [kept[-1]]
                self._arrived.extend(sample for source, sample in requested if source is not self)
        if whole:
            self._whole.add(channel.name)
        self._want(channel, name)

    def _want(self, channel: Channel, name: str) -> None:
        self._requested.append((channel, name))
        self._known.clear()

    def _subscribed(self, key: str) -> bool:
        known = self._known.get(key)
        if known is None:
            known = any(_is_of(channel, name, key) for channel, name in self._requested)
            self._known[key] = known
        return known

    def offer(self, sample: Sample) -> None:
        """Take the sample if this bus subscribed to it."""
        if self._subscribed(sample.key):
            self._arrived.append(sample)

    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        """Everything that has arrived; a memory bus never waits."""
        arrived = self._arrived  # one by one: another thread may be publishing
        return [arrived.popleft() for _ in range(len(arrived))]

    def answer(self, channel: Channel, name: str, answer: Answer) -> None:
        """Answer queries, within `ask`."""
        self._network.answers.append((channel, name, answer))

    def ask(self, channel: Channel, name: str, request: Message, timeout_s: float) -> list[bytes]:
        """The answers, at once."""
        for answered, names, answer in self._network.answers:
            if answered is channel and _is_of(channel, names, channel.key(name)):
                try:
                    return list(answer(encoded(request)))
                except ValueError as error:
                    raise BusError(f"{channel.key(name)}: {error}") from error
        return []

    def request(self, channel: Channel, name: str, request: Message) -> None:
        """The answers, with the next samples."""
        for payload in self.ask(channel, name, request, 0.0):
            with suppress(WireError):  # what is no reply to this question is dropped
                self._arrived.append(replied(channel, name, payload, 0))

    def again(self) -> None:
        """What is kept of the channels that were subscribed to as a whole, or are `all`, again."""
        for key, kept in self._network.kept.items():
            found = channel_of(key)
            if found is None or not self._subscribed(key):
                continue
            if found[0].delivery == "all" or found[0].name in self._whole:
                self._arrived.extend(sample for source, sample in kept if source is not self)

    def lacking(self) -> dict[str, list[tuple[int, int]]]:
        """Nothing is lost in memory."""
        return {}

    def declare_alive(self, node: str) -> None:
        """Hold a token."""
        self._token(node, alive=True)

    def watch_alive(self, node: str = "**") -> None:
        """Receive changes of tokens, the present ones first."""
        self._want(ALIVE, node)
        for source, sample in self._network.alive.values():
            if source is not self:
                self.offer(sample)

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
        for bus in self._network.buses:
            if bus is not self:
                bus.offer(sample)

    def close(self) -> None:
        """Leave the network; the tokens go."""
        self._network.buses.remove(self)
        own = [node for node, (source, _) in self._network.alive.items() if source is self]
        for node in own:
            self._token(node, alive=False)


def _is_of(channel: Channel, name: str, key: str) -> bool:
    owner = channel.owner(key)
    return owner is not None and (owner == "" or name in ("*", "**", owner))
