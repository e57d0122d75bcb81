"""Seeded radio in team time: reach, delay, loss, duplicates, link capacity."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from teamslam.sim.radio.bus import reach_of
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.estimation.hybrid_slam.window import generator

Reach = Callable[[str, str, int], bool]  # whether two nodes reach each other at a team time [ns]


def always(one: str, other: str, now_ns: int) -> bool:
    return True


@dataclass(frozen=True)
class Meeting:
    """Nodes that reach each other from begin_ns until end_ns at any distance."""

    nodes: frozenset[str]
    begin_ns: int
    end_ns: int


def air_of(scenario: Scenario, streams: WorldStreams, seed: int = 0) -> "Air":
    radio = scenario.radio
    delay_ns = round(radio.delay_s * 1e9)
    return Air(
        reach=reach_of(radio, streams.streams).between,
        loss=radio.loss,
        delay_ns=(delay_ns, delay_ns),
        bytes_per_s=radio.bytes_per_s,
        seed=seed,
    )


def meetings(windows: Sequence[Meeting]) -> Reach:
    def reach(one: str, other: str, now_ns: int) -> bool:
        return any(
            {one, other} <= each.nodes and each.begin_ns <= now_ns < each.end_ns for each in windows
        )

    return reach


@dataclass
class Air:
    """loss, duplicates: probabilities. delay_ns: (least, greatest). bytes_per_s: per link."""

    reach: Reach = always
    loss: float = 0.0
    duplicates: float = 0.0
    delay_ns: tuple[int, int] = (0, 0)
    bytes_per_s: float | None = None
    seed: int = 0
    sent: dict[tuple[str, str], int] = field(default_factory=dict)
    _busy: dict[tuple[str, str], float] = field(default_factory=dict)
    _number: int = 0

    def arrivals(self, sender: str, to: str, size: int, now_ns: int) -> list[int]:
        if not self.reach(sender, to, now_ns):
            return []
        self.sent[sender, to] = self.sent.get((sender, to), 0) + size
        begin = float(now_ns)
        if self.bytes_per_s is not None:
            begin = max(begin, self._busy.get((sender, to), 0.0)) + size / self.bytes_per_s * 1e9
            self._busy[sender, to] = begin
        if not (self.loss or self.duplicates or self.delay_ns[1]):
            return [int(begin)]
        self._number += 1
        draws = generator(self.seed, "air", 0, self._number)
        if draws.random() < self.loss:
            return []
        copies = 2 if draws.random() < self.duplicates else 1
        low, high = self.delay_ns
        return [int(begin) + low + int(draws.random() * (high - low)) for _ in range(copies)]
