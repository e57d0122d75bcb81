"""Simulated links in team time: delay, loss, partitions, a centre that dies.

A lost submap is sent again, so none of this can change the final map of the rule `join` (law 2).
"""

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from teamslam.team.estimation.randomness import generator
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import encoded

RESEND_NS = 1_000_000_000
"""A lost submap is sent again after this time."""
PATIENCE_NS = 3_000_000_000
"""Time after which the centre considers a robot lost."""
_FROM_ROBOTS = (ch.SUBMAP, ch.SIGHTING_FACTOR, ch.OWN_MAP, ch.ROBOT_PROGRESS, ch.ROBOT_DONE)
_FROM_CENTRE = (ch.FUSED_MAP, ch.PRIOR, ch.FINAL_MAP, ch.CENTRAL_PROGRESS)


class Link:
    """Delivery of messages to a node at their arrival times, liveliness first."""

    def __init__(self, arrival_ns: Callable[[Sample, int], int] | None = None) -> None:
        self._arrival_ns = arrival_ns
        self._in_flight: list[tuple[int, bool, int, Sample]] = []
        self._sent = 0

    def say(self, at_ns: int, message: m.Liveliness) -> None:
        """Deliver a node's liveliness token at this time."""
        sample = Sample(ch.ALIVE.key(message.node), encoded(message), 0, 0, 0)
        self._hold(at_ns, sample, sent=False)

    def arrived(self, samples: Sequence[Sample], now_ns: int) -> list[Sample]:
        """Messages that have arrived by now, given those sent since the last call."""
        if self._arrival_ns is None:
            return list(samples)
        for sample in samples:
            self._hold(self._arrival_ns(sample, now_ns), sample, sent=True)
        there = []
        while self._in_flight and self._in_flight[0][0] <= now_ns:
            there.append(heapq.heappop(self._in_flight)[-1])
        return there

    def _hold(self, at_ns: int, sample: Sample, *, sent: bool) -> None:
        heapq.heappush(self._in_flight, (at_ns, sent, self._sent, sample))
        self._sent += 1

    @property
    def next_ns(self) -> int | None:
        """Arrival time of the next message in flight."""
        return self._in_flight[0][0] if self._in_flight else None


@dataclass(frozen=True)
class Partition:
    """Robots that do not reach the centre from begin_ns until end_ns."""

    robots: frozenset[str]
    begin_ns: int
    end_ns: int


@dataclass(frozen=True)
class Conditions:
    """Conditions of a team's links.

    loss: probability per transmission of a submap to the centre. delay_ns: of submaps to the
    centre. down_ns: interval without a centre; the next one starts empty and requests everything
    from the robots.
    """

    delay_ns: int = 0
    loss: float = 0.0
    seed: int = 0
    partitions: tuple[Partition, ...] = ()
    down_ns: tuple[int, int] | None = None

    def centre_is_down(self, now_ns: int) -> bool:
        """Whether there is no centre at this time."""
        return self.down_ns is not None and self.down_ns[0] <= now_ns < self.down_ns[1]

    @property
    def centre_back_ns(self) -> int:
        """Time at which there is a centre again."""
        return 0 if self.down_ns is None else self.down_ns[1]

    def to_centre(self, robots: Sequence[str]) -> Link:
        """The robots' link to the centre."""
        if not (self.delay_ns or self.loss or self.partitions):
            return Link()
        link = Link(self._arrival_at_centre)
        for robot, cut in self._cuts(robots):
            node = ch.robot_node(robot)
            if cut.end_ns - cut.begin_ns > PATIENCE_NS:
                link.say(
                    cut.begin_ns + PATIENCE_NS, m.Liveliness(stamp_ns=0, node=node, alive=False)
                )
                link.say(cut.end_ns, m.Liveliness(stamp_ns=0, node=node, alive=True))
        return link

    def to_robot(self, robot: str) -> Link:
        """The centre's link to a robot."""
        cuts = [cut for _, cut in self._cuts([robot])]
        if not cuts:
            return Link()
        link = Link(lambda sample, now_ns: _behind(cuts, now_ns, sample, _FROM_CENTRE))
        for cut in cuts:
            link.say(cut.begin_ns, m.Liveliness(stamp_ns=0, node="central", alive=False))
            link.say(cut.end_ns, m.Liveliness(stamp_ns=0, node="central", alive=True))
        return link

    def _cuts(self, robots: Sequence[str]) -> list[tuple[str, Partition]]:
        return [(r, cut) for r in robots for cut in self.partitions if r in cut.robots]

    def _arrival_at_centre(self, sample: Sample, now_ns: int) -> int:
        _, robot, message = opened(sample)
        if isinstance(message, m.Submap):
            now_ns += self.delay_ns + RESEND_NS * self._losses(message)
        cuts = [cut for _, cut in self._cuts([robot])]
        return _behind(cuts, now_ns, sample, _FROM_ROBOTS)

    def _losses(self, submap: m.Submap) -> int:
        if self.loss == 0.0:
            return 0
        draws = generator(self.seed, f"{submap.robot} loses", submap.incarnation, submap.sequence)
        return int(draws.geometric(1.0 - self.loss)) - 1


def _behind(
    cuts: Sequence[Partition], now_ns: int, sample: Sample, channels: Sequence[ch.Channel]
) -> int:
    """`now_ns`, or the end of the partitions that a message crosses at that time."""
    found = ch.channel_of(sample.key)
    if found is None or found[0] not in channels:
        return now_ns
    for cut in sorted(cuts, key=lambda c: c.begin_ns):
        if cut.begin_ns <= now_ns < cut.end_ns:
            now_ns = cut.end_ns
    return now_ns
