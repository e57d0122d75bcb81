"""The last words of a log's processes: whose end is not known, so that its tail may be missing.

A process counts what it publishes and says at its end how much that was (`Tally`). One that was
killed says nothing: what it had published last may never have left its machine, and no counter that
arrived tells of it. Each life of a process counts its statuses from 0, so its lives are known.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from team.wire import channels as ch
from team.wire.bus import NO_COUNTER, Sample
from team.wire.messages import Tally

MISSING = "missing: "
"""How the recorder's last word on what it lacks begins."""


class _Spoke(NamedTuple):
    """A status: the publisher's wall clock [ns], its counter, the team time [ns]."""

    wall_ns: int
    counter: int
    stamp_ns: int


@dataclass
class LastWords:
    """The statuses and last words of each process of a log; 24 bytes a status and more."""

    _spoke: dict[str, list[_Spoke]] = field(default_factory=lambda: defaultdict(list))
    _ended: dict[str, list[tuple[int, int]]] = field(default_factory=lambda: defaultdict(list))

    def take_status(self, node: str, sample: Sample) -> None:
        """Note that a node was there."""
        if sample.counter != NO_COUNTER:
            self._spoke[node].append(_Spoke(sample.wall_ns, sample.counter, sample.stamp_ns))

    def take_tally(self, tally: Tally, wall_ns: int) -> None:
        """Note how a process ended: between which wall clocks it was there."""
        self._ended[tally.node].append((tally.since_ns, wall_ns))

    def findings(self) -> Iterator[tuple[str, str]]:
        """A key, and what is not known of its process; nothing where no process says how it ends.

        A log of nodes in memory has no last words at all.
        """
        if not self._ended:
            return
        for node, spoke in sorted(self._spoke.items()):
            for life in _lives(sorted(spoke)):
                last = life[-1]
                if any(since <= last.wall_ns <= until for since, until in self._ended[node]):
                    continue
                yield (
                    ch.TALLY.key(node),
                    f"no last word of the process that spoke until {last.stamp_ns * 1e-9:.1f} s: "
                    "it was killed or cut off, and what it said after that may be missing",
                )


def _lives(spoke: list[_Spoke]) -> Iterator[list[_Spoke]]:
    """The statuses of each process in turn: each counts from the beginning."""
    life: list[_Spoke] = []
    for each in spoke:
        if life and each.counter <= life[-1].counter:
            yield life
            life = []
        life.append(each)
    if life:
        yield life
