"""World node: publishes measurements in team time, as far as credit allows."""

import json
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import msgspec
import numpy as np

from teamslam.sim.publisher.source import TRUTH_BATCH_NS, Source, for_the_evaluator
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.driver.source import (
    BATCH,
    CREDIT_MEASUREMENTS,
    CREDIT_RECORDER,
    FIRST_INCARNATION,
    answer_request,
)
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import decoded

SHOWN = 3  # most differing fields in a warning
REMEDY = "start it again with the same scenario and options"


class Configurations:
    """Expected configurations by node, and announcements."""

    def __init__(self, expected: Mapping[str, m.Configuration]) -> None:
        self._expected = expected
        self._announced: set[str] = set()
        self._right: set[str] = set()
        self._mismatches: dict[str, str] = {}

    def take(self, announced: m.Configuration) -> None:
        """Compare an announcement."""
        if not self._expected:
            return
        node = announced.node
        self._announced.add(node)
        self._mismatches.pop(node, None)
        expected = self._expected.get(node)
        if expected is None:
            self._mismatches[node] = (
                f"{node} is not in the world's scenario, which has {', '.join(self._expected)}: "
                + REMEDY
            )
        elif announced.digest != expected.digest:
            found = _differences(announced.configuration, expected.configuration)
            more = f", and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
            self._mismatches[node] = (
                f"{node} differs from the world's scenario: {', '.join(found[:SHOWN])}{more}: "
                + REMEDY
            )
        else:
            self._right.add(node)

    @property
    def mismatches(self) -> tuple[str, ...]:
        """Deviating nodes, fields and remedy."""
        return tuple(self._mismatches[node] for node in sorted(self._mismatches))

    @property
    def forbid(self) -> bool:
        """Whether a node announced only wrong configurations: of both kinds, another process uses
        its name.
        """
        return bool(self._mismatches.keys() & self._expected.keys() - self._right)

    def unheard(self, nodes: Collection[str]) -> list[str]:
        """Nodes that have announced nothing."""
        return sorted((self._expected.keys() & set(nodes)) - self._announced)


def _differences(announced: str, expected: str) -> list[str]:
    theirs, ours = dict(_fields(json.loads(announced))), dict(_fields(json.loads(expected)))
    return [
        f"{name} is {theirs.get(name, 'absent')} there and {ours.get(name, 'absent')} here"
        for name in sorted(theirs.keys() | ours.keys())
        if theirs.get(name) != ours.get(name)
    ]


def _fields(value: Any, at: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and value:
        for name, part in value.items():
            yield from _fields(part, f"{at}.{name}" if at else name)
    else:
        yield at, json.dumps(value)


BLOCKED_S = 5.0  # duration [s] of missing credit after which a node is named in the status
RESUME_S = 2.0  # wait [s] of a restarted world for all progress reports


@dataclass
class WorldNode:
    """Publish the world: call `begin`, `publish` until `ended`, and `handle` for each message.

    expected: nodes that must be alive first. speed: team seconds per clock second. cache: last
    measurements of a robot that can be requested; an older request begins a new incarnation.
    batch_s: most team time between checks for messages. peers: robots whose final maps are awaited.
    """

    streams: WorldStreams
    expected: frozenset[str]
    scenario: m.Configuration
    speed: float = float("inf")
    cache: int | None = None
    configurations: Configurations = field(default_factory=lambda: Configurations({}))
    tells_map: bool = False
    batch_s: float = float("inf")
    peers: frozenset[str] = frozenset()
    ended: bool = field(default=False, init=False)
    finished: bool = field(default=False, init=False)
    final: m.FusedMap | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._sources = {x.robot: Source(x) for x in self.streams.streams}
        self._names = [x.robot for x in self.streams.streams]
        robots, indices = self.streams.order()
        self._order = deque(zip(robots.tolist(), indices.tolist(), strict=True))
        self._alive: set[str] = set()
        self._concluded: dict[str, m.Concluded] = {}
        self.centre = "central" in self.expected or not self.peers
        self._recorded: dict[tuple[str, int], int] = {}
        self._recorder = False
        self._unrecorded = 0
        self._published = 0
        self._began_at: float | None = None
        self._consumed: dict[tuple[str, int], int] = {}
        self._passed_ns: dict[str, int] = {}
        self._resumed_at: float | None = None
        self._blocked_by: tuple[str, float] | None = None
        self._clock_s = 0.0
        self._starts: list[Outgoing] = []
        first = [int(x.stamps_ns[0]) for x in self.streams.streams if len(x)]
        self._first_ns = min(first, default=0)
        self.now_ns = self._paced_ns = self._first_ns

    listens: ClassVar[tuple[ch.Channel, ...]] = (
        ch.ROBOT_PROGRESS,
        ch.RECORDER_PROGRESS,
        ch.FINAL_MAP,
        ch.CONCLUDED,
        ch.GIVEN_UP,
    )
    announcements: ClassVar[tuple[ch.Channel, ...]] = (ch.ROBOT_CONFIG, ch.CENTRAL_CONFIG)
    """Further subscriptions if configurations are compared."""

    @property
    def waiting_for(self) -> list[str]:
        """Nodes not alive, or without announced configuration."""
        if self._began_at is not None:
            return []
        silent = self.configurations.unheard(self.expected & self._alive)
        return sorted([*(self.expected - self._alive), *silent])

    def begin(self) -> list[Outgoing]:
        """First messages: scenario, true landmarks, known map."""
        out = [Outgoing(ch.WORLD_CONFIG, "", self.scenario)]
        if self.streams.landmarks is not None:
            order = np.argsort(self.streams.landmark_ids)
            truth = m.TruthLandmarks(
                stamp_ns=self._first_ns,
                ids=from_ids(self.streams.landmark_ids[order]),
                positions=from_floats(self.streams.landmarks[order]),
            )
            out.append(Outgoing(ch.TRUTH_LANDMARKS, "", truth))
            if self.tells_map:
                known = m.KnownMap(
                    stamp_ns=self._first_ns, ids=truth.ids, positions=truth.positions
                )
                out.append(Outgoing(ch.KNOWN_MAP, "", known))
        for stream in self.streams.streams:
            out += for_the_evaluator(stream)
        return out

    def refusal(self, message: m.Message) -> str | None:
        """Reason why a message is impossible, or None."""
        match message:
            case m.Progress():
                source = self._sources.get(message.robot)
                if source is None:
                    return f"of {message.robot}, not in this team"
                if message.incarnation > source.incarnation:
                    return (
                        f"of incarnation {message.incarnation} of {message.robot}, "
                        f"{source.incarnation} is"
                    )
                if message.measurements > len(source.stream):
                    self._note_too_far(message, source)
                    return f"consumed {message.measurements} of {len(source.stream)} measurements"
            case m.FusedMap() if message.final and self._published and not self.ended:
                return "a final map before the end of the streams"
            case _:
                pass
        return None

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Process a message; return nothing to send."""
        match message:
            case m.Liveliness():
                self._take_liveliness(message)
            case m.Progress() if message.node == "recorder":
                stream = (message.robot, message.incarnation)
                self._recorded[stream] = max(self._recorded.get(stream, 0), message.measurements)
            case m.Progress():
                if self._began_at is None and message.measurements:
                    self._note_consumed(message)
                source = self._sources.get(message.robot)
                if source is not None and message.incarnation == source.incarnation:
                    source.consumed = max(source.consumed, source.base + message.measurements)
            case m.Configuration():
                self.configurations.take(message)
            case m.FusedMap() if message.final:
                self.final = message
                self._finish()
            case m.Concluded():
                self._concluded[message.robot] = message
                self._finish()
            case m.GivenUp():
                self.expected -= {message.node}
                self.centre = self.centre and not (self.peers and message.node == "central")
                self.peers -= {ch.robot_of(message.node) or ""}
                self._finish()
            case _:
                pass
        return []

    def _finish(self) -> None:
        """End once an expected centre and all peers have final maps; peers need no absent one."""
        conclusions = [self._concluded[robot] for robot in self.peers if robot in self._concluded]
        agreed = (
            len(conclusions) == len(self.peers) and len({each.digest for each in conclusions}) <= 1
        )
        waits = self.centre and (not conclusions or "central" in self._alive)
        central = self.final is not None or not waits
        self.finished = self.finished or (agreed and central)

    def _note_too_far(self, progress: m.Progress, source: Source) -> None:
        """Treat impossible progress as complete, so that its node does not hold the world."""
        if progress.node == "recorder":
            stream = (progress.robot, progress.incarnation)
            self._recorded[stream] = max(self._recorded.get(stream, 0), source.counter)
        else:
            source.consumed = max(source.consumed, source.published)

    def _note_consumed(self, progress: m.Progress) -> None:
        stream = (progress.robot, progress.incarnation)
        if progress.robot in self._sources:
            self._consumed[stream] = max(self._consumed.get(stream, 0), progress.measurements)
            self._passed_ns[progress.robot] = progress.stamp_ns

    def _take_liveliness(self, message: m.Liveliness) -> None:
        (self._alive.add if message.alive else self._alive.discard)(message.node)
        came = not self._recorder and "recorder" in self._alive
        if came and self._began_at is not None:  # its progress counts its log's messages
            self._recorded, self._unrecorded = {}, self._out_of_reach
        self._recorder = "recorder" in self._alive
        for name, source in self._sources.items():
            source.alive = ch.robot_node(name) in self._alive
        if message.node == "central" and not message.alive:
            self._finish()

    def _going_on(self, clock_s: float) -> bool:
        """Whether an earlier process began the world, and all progress is known.

        This process continues from the least progress; receivers drop repetitions.
        """
        if not self._consumed:
            return False
        if self._resumed_at is None:
            self._resumed_at = clock_s
        robots = {ch.robot_node(name) for name in self._sources}
        waiting = self.waiting_for and robots - {ch.robot_node(n) for n, _ in self._consumed}
        return not waiting or clock_s - self._resumed_at >= RESUME_S

    def _skip(self) -> list[Outgoing]:
        starts = []
        for name, source in self._sources.items():
            incarnation = max(
                (e for n, e in self._consumed if n == name), default=FIRST_INCARNATION
            )
            consumed = self._consumed.get((name, incarnation), 0)
            if incarnation > FIRST_INCARNATION:  # only its progress is known, not its begin
                at = int(np.searchsorted(source.stream.stamps_ns, self._passed_ns[name], "right"))
                source.incarnation, source.published = incarnation, max(at, 1)
                self._begin_incarnation(source)
                continue
            if self._recorder:
                consumed = min(consumed, self._recorded.get((name, incarnation), 0))
            source.published = min(consumed, len(source.stream))
            if source.published:
                starts.append(Outgoing(ch.START, name, source.message(0)))
            if source.published and source.stream.truth_ns is not None:
                at_ns = int(source.stream.stamps_ns[source.published - 1]) - TRUTH_BATCH_NS
                source.truth_sent = int(np.searchsorted(source.stream.truth_ns, at_ns))
        remaining = [(r, i) for r, i in self._order if i >= self._sources[self._names[r]].published]
        self._order = deque(remaining)
        self._published = sum(source.published for source in self._sources.values())
        self._unrecorded = self._published - sum(self._recorded.values())
        if remaining:
            robot, index = remaining[0]
            self._paced_ns = int(self._sources[self._names[robot]].stream.stamps_ns[index])
        return starts

    @property
    def _out_of_reach(self) -> int:
        if self.cache is None:
            return 0
        return sum(max(0, x.published - self.cache) for x in self._sources.values())

    @property
    def unrecorded(self) -> int:
        """Number of measurements that a living recorder lacks."""
        if not self._recorder:
            return 0
        return self._published - self._unrecorded - sum(self._recorded.values())

    def publish(self, clock_s: float) -> list[Outgoing]:
        """Next measurements, limited by BATCH, batch_s, pace and credit."""
        if self.ended:  # a new incarnation may begin after the end, with its own last counters
            out, self._starts = self._starts, []
            return [*out, Outgoing(ch.END, "", self._end())] if out else []
        if self._began_at is None:
            if self.configurations.forbid or not (
                self._going_on(clock_s) if self._consumed else not self.waiting_for
            ):
                return []
            self._began_at = clock_s
            self._starts += self._skip() if self._consumed else []
        horizon = self._horizon_ns(clock_s)
        out, self._starts = self._starts, []
        until_ns = float("inf")
        while self._order and len(out) < BATCH:
            robot, index = self._order[0]
            source = self._sources[self._names[robot]]
            stamp_ns = int(source.stream.stamps_ns[index])
            until_ns = min(until_ns, stamp_ns + self.batch_s * 1e9)
            if stamp_ns >= until_ns:
                break
            if stamp_ns > horizon:
                self._blocked_by = None
                break
            if (node := self._without_credit(source)) is not None:
                before = self._blocked_by
                self._blocked_by = before if before and before[0] == node else (node, clock_s)
                self._clock_s = clock_s
                break
            self._blocked_by = None
            self._order.popleft()
            self.now_ns = max(self.now_ns, stamp_ns)
            out.append(source.outgoing(index))
            source.published = index + 1
            self._published += 1
            out += source.truth(stamp_ns)
        if not self._order:
            self.ended = True
            for source in self._sources.values():
                out += source.truth(2**62, 0)
            out.append(Outgoing(ch.END, "", self._end()))
        return out

    def _horizon_ns(self, clock_s: float) -> float:
        assert self._began_at is not None
        if self.speed == float("inf"):
            return self.speed  # no time has passed at first: 0 · ∞ is not a number
        return self._paced_ns + (clock_s - self._began_at) * self.speed * 1e9

    def _without_credit(self, source: Source) -> str | None:
        if source.alive and source.published - source.consumed >= CREDIT_MEASUREMENTS:
            return ch.robot_node(source.stream.robot)
        return "recorder" if self.unrecorded >= CREDIT_RECORDER else None

    def _end(self) -> m.End:
        ends = tuple(
            m.StreamEnd(robot=n, incarnation=x.incarnation, measurements=x.counter)
            for n, x in self._sources.items()
        )
        notes = [*self.streams.notes]
        for name, source in self._sources.items():
            notes += [f"{name}: {note}" for note in source.stream.notes]
        return m.End(stamp_ns=self.now_ns, streams=ends, notes=tuple(notes))

    def measurements(self, request: bytes) -> Iterable[bytes]:
        """Answer a `MeasurementsRequest`."""
        requested = decoded(request, m.MeasurementsRequest)
        source = self._sources.get(requested.robot)
        if source is None or requested.incarnation not in (0, source.incarnation):
            return []
        first = requested.first
        if self.cache is not None and first < source.counter - self.cache:
            if not requested.only:
                self._begin_incarnation(source)
                return []
            first = source.counter - self.cache
        within_cache = msgspec.structs.replace(requested, first=first)
        return answer_request(
            within_cache, source.counter, lambda n: source.message(source.base + n)
        )

    def _begin_incarnation(self, source: Source) -> None:
        source.incarnation += 1
        source.base = source.published - 1
        source.consumed = source.base
        start = source.message(source.base)
        self._starts.append(Outgoing(ch.START, source.stream.robot, start))

    def status(self) -> m.Status:
        """Progress of the world."""
        total = self._published + len(self._order)
        figures = {
            "measurements": float(self._published),
            "of": float(total),
            "team_time_s": (self.now_ns - self._first_ns) * 1e-9,
        }
        waiting = self.waiting_for
        state = "publishing" if self._began_at is not None else "waiting"
        warnings = (f"waiting for {', '.join(waiting)}",) if waiting else ()
        if self._blocked_by is not None and self._clock_s - self._blocked_by[1] >= BLOCKED_S:
            node, since = self._blocked_by
            warnings = (f"{node} blocks the team: no progress for {self._clock_s - since:.0f} s",)
        return m.Status(
            stamp_ns=self.now_ns,
            node="world",
            state="ended" if self.ended else state,
            figures=figures,
            warnings=(*self.configurations.mismatches, *warnings),
        )


def expected_nodes(robots: Sequence[str], *, recorder: bool, centre: bool = True) -> frozenset[str]:
    """Nodes that must be alive first."""
    nodes = {ch.robot_node(robot) for robot in robots} | ({"central"} if centre else set())
    return frozenset(nodes | {"recorder"} if recorder else nodes)
