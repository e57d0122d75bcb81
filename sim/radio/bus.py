"""Simulate a robot's radio at its bus: drop messages of robots out of reach.

The world announces radio reach in advance (`world/radio`). A message counts as sent at its stamp;
its bytes and receiver decide random loss.
"""

import heapq
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from itertools import combinations
from typing import cast

import numpy as np

from teamslam.sim.world.config import Radio
from teamslam.sim.world.streams import RobotStream
from teamslam.team import core
from teamslam.team.shapes import Bool, Float, Int64
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Answer, Bus, Outgoing, Sample, Tap
from teamslam.team.wire.codec import WireError, decoded, encoded

PERIOD_NS = 1_000_000_000  # team time [ns] of constant reach


@dataclass(frozen=True)
class Reach:
    """Reach between robots: row t holds from first_ns + t · PERIOD_NS.

    pairs: T × P, pairs of robots in order. ends_ns: end of each stream.
    """

    robots: tuple[str, ...]
    first_ns: int
    pairs: Bool[np.ndarray, "T P"]
    ends_ns: dict[str, int]

    def between(self, one: str, other: str, now_ns: int) -> bool:
        """Whether two robots reach each other; the last row extends."""
        if one == other or one not in self.ends_ns or other not in self.ends_ns:
            return True
        if now_ns >= max(self.ends_ns[one], self.ends_ns[other]):
            return True
        row = min(max((now_ns - self.first_ns) // PERIOD_NS, 0), len(self.pairs) - 1)
        i, j = sorted((self.robots.index(one), self.robots.index(other)))
        n = len(self.robots)
        return bool(self.pairs[row, i * n - i * (i + 1) // 2 + j - i - 1])


def reach_of(radio: Radio, streams: Sequence[RobotStream]) -> Reach:
    """Reach in a world; raises ValueError if a range needs missing truth."""
    robots = tuple(stream.robot for stream in streams)
    first_ns = min((int(s.stamps_ns[0]) for s in streams if len(s)), default=0)
    ends_ns = {s.robot: int(s.stamps_ns[-1]) if len(s) else first_ns for s in streams}
    rows = (max(ends_ns.values(), default=first_ns) - first_ns) // PERIOD_NS + 1
    times = first_ns + PERIOD_NS * np.arange(rows, dtype=np.int64)
    couples = list(combinations(range(len(streams)), 2))
    pairs = np.ones((rows, len(couples)), dtype=np.bool_)
    if radio.comm_range_m is not None:
        at = [_positions(stream, times) for stream in streams]
        for k, (i, j) in enumerate(couples):
            pairs[:, k] = core.hypot(*(at[i] - at[j]).T) <= radio.comm_range_m
    if radio.windows:
        seconds = (times - first_ns) * 1e-9
        opened = np.zeros_like(pairs)
        for window in radio.windows:
            then = (window.from_s <= seconds) & (seconds < window.to_s)
            for k, (i, j) in enumerate(couples):
                opened[:, k] |= then & ({robots[i], robots[j]} <= set(window.robots))
        pairs &= opened
    return Reach(robots, first_ns, pairs, ends_ns)


def _positions(stream: RobotStream, times: Int64[np.ndarray, " T"]) -> Float[np.ndarray, "T 2"]:
    if stream.truth is None or stream.truth_ns is None or not len(stream.truth):
        raise ValueError(f"radio.comm_range_m needs the truth of {stream.robot}: there is none")
    x, y = (np.interp(times, stream.truth_ns, stream.truth[:, axis]) for axis in (0, 1))
    return np.column_stack([x, y])


_RADIO = {
    channel.name
    for channel in ch.CHANNELS
    if channel.template.startswith(("robot/{robot}", "source/{robot}", "{node}"))
}


class RadioBus:
    """Bus of one robot behind a simulated radio."""

    def __init__(self, bus: Bus, robot: str, radio: Radio) -> None:
        self._bus = bus
        self._robot = robot
        self._radio = radio
        self._reach: Reach | None = None
        self._done = False
        self._in_flight: list[tuple[float, int, Sample]] = []
        self._count = 0
        self._busy: dict[str, float] = {}
        self._tokens: dict[str, bool] = {}
        self._near: dict[str, bool] = {}
        self._now_ns = -(2**62)
        bus.subscribe(ch.RADIO)
        tap = getattr(bus, "tap", None)
        self.tap: Tap | None = tap
        self._tap(None)

    def __getattr__(self, name: str) -> object:
        return getattr(self._bus, name)

    def publish(self, out: Outgoing) -> int:
        """Publish; a `Done` message ends the robot's stream."""
        self._now_ns = max(self._now_ns, out.message.stamp_ns)
        self._done = self._done or out.channel is ch.ROBOT_DONE
        self._tap(self.tap)
        try:
            return self._bus.publish(out)
        finally:
            self._tap(None)

    def _tap(self, tap: Tap | None) -> None:
        if hasattr(self._bus, "tap"):
            self._bus.tap = tap

    def ask(
        self, channel: ch.Channel, name: str, request: m.Message, timeout_s: float
    ) -> list[bytes]:
        """Request from the test bench or the own source."""
        self._tap(self.tap)
        try:
            return self._bus.ask(channel, name, request, timeout_s)
        finally:
            self._tap(None)

    def request(self, channel: ch.Channel, name: str, request: m.Message) -> None:
        """Send a request to a robot in reach."""
        robot = ch.robot_of(name)
        if channel is not ch.MEMBERS or robot is None or self._reaches(robot, self._now_ns):
            self._bus.request(channel, name, request)

    def answer(self, channel: ch.Channel, name: str, answer: Answer) -> None:
        """Answer requests of robots in reach."""

        def answer_in_reach(request: bytes) -> Iterable[bytes]:
            if channel is ch.MEMBERS:
                asker = ch.robot_of(decoded(request, m.MembersRequest).node)
                if asker is not None and not self._reaches(asker, self._now_ns):
                    return []
            return answer(request)

        self._bus.answer(channel, name, answer_in_reach)

    def receive(self, timeout_s: float) -> list[Sample]:
        """Messages, and tokens of robots whose reach changed."""
        through: list[Sample] = []
        for sample in self._bus.receive(timeout_s):
            found = ch.channel_of(sample.key)
            if found is not None and found[0] is ch.RADIO:
                self._reach = reach_in(sample.payload) or self._reach
            elif found is None or (by := self._sender(*found)) is None:
                through.append(sample)
            elif found[0] is ch.ALIVE:
                self._note(by, sample)
            else:
                self._carry(by, sample, through)
        now_s = time.monotonic()
        while self._in_flight and self._in_flight[0][0] <= now_s:
            through.append(heapq.heappop(self._in_flight)[-1])
        received = [*self._changes(), *through]
        if self.tap is not None and received:
            self.tap(received)
        return received

    def _sender(self, channel: ch.Channel, name: str) -> str | None:
        if channel.name not in _RADIO:
            return None
        robot = ch.robot_of(name) if channel.template.startswith("{node}") else name
        return None if robot in (None, self._robot) else robot

    def _carry(self, by: str, sample: Sample, through: list[Sample]) -> None:
        sent_ns = max(sample.stamp_ns, -(2**62))
        if not self._reaches(by, sent_ns) or self._is_lost(sample):
            return
        wait_s = self._radio.delay_s
        if self._radio.bytes_per_s is not None:
            now_s = time.monotonic()
            begin_s = max(now_s, self._busy.get(by, 0.0))
            self._busy[by] = begin_s + len(sample.payload) / self._radio.bytes_per_s
            wait_s += self._busy[by] - now_s
        if wait_s <= 0.0:
            through.append(sample)
            return
        self._count += 1
        heapq.heappush(self._in_flight, (time.monotonic() + wait_s, self._count, sample))

    def _reaches(self, other: str, at_ns: int) -> bool:
        reach = self._reach
        if reach is None or other not in reach.ends_ns:
            return reach is None
        ended = at_ns >= reach.ends_ns[other]
        if ended:  # its stream is over: wait for the end of this robot's
            return self._done
        return reach.between(self._robot, other, at_ns)

    def _is_lost(self, sample: Sample) -> bool:
        if not self._radio.loss:
            return False
        named = f"{self._robot} {sample.key} {sample.counter} {sample.wall_ns}".encode()
        drawn = int.from_bytes(blake2b(named, digest_size=8).digest(), "little") / 2.0**64
        return drawn < self._radio.loss

    def _note(self, robot: str, sample: Sample) -> None:
        self._tokens[robot] = decoded(sample.payload, m.Liveliness).alive

    def _changes(self) -> list[Sample]:
        """Tokens of robots that came into or left reach: alive means in reach, too."""
        changed = []
        for robot, alive in self._tokens.items():
            in_reach = alive and self._reaches(robot, self._now_ns)
            if in_reach != self._near.get(robot):
                self._near[robot] = in_reach
                node = ch.robot_node(robot)
                token = m.Liveliness(stamp_ns=0, node=node, alive=in_reach)
                changed.append(Sample(ch.ALIVE.key(node), encoded(token), 0, time.time_ns(), 0))
        return changed


def behind_radio(bus: Bus, robot: str, radio: Radio) -> Bus:
    """Wrap a robot's bus in its radio."""
    return cast(Bus, RadioBus(bus, robot, radio))


def plan_of(reach: Reach) -> m.RadioPlan:
    """Encode the announced reach."""
    return m.RadioPlan(
        stamp_ns=reach.first_ns,
        robots=reach.robots,
        ends_ns=tuple(reach.ends_ns[robot] for robot in reach.robots),
        pairs=np.packbits(reach.pairs, axis=1).tobytes(),
    )


def reach_in(payload: bytes) -> Reach | None:
    """Decode the announced reach."""
    try:
        plan = decoded(payload, m.RadioPlan)
    except WireError:
        return None
    n = len(plan.robots)
    couples = n * (n - 1) // 2
    width = (couples + 7) // 8
    rows = np.frombuffer(plan.pairs, np.uint8).reshape(-1, max(width, 1))
    pairs = np.unpackbits(rows, axis=1)[:, :couples].astype(np.bool_)
    return Reach(
        plan.robots, plan.stamp_ns, pairs, dict(zip(plan.robots, plan.ends_ns, strict=True))
    )
