"""Finds the processes of a log that ended without announcing it, so that messages may be missing.

A process counts its publications and publishes the totals when it ends (`Tally`). A process that
was killed does not: its last publications may never have left its machine, and no received counter
shows that. Each process counts its statuses from 0, which separates the lives of a restarted
process.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from team.wire import channels as ch
from team.wire.bus import NO_COUNTER, Sample
from team.wire.messages import Tally

MISSING = "missing: "
"""Beginning of the recorder's last note, which lists what it lacks."""


class _Spoke(NamedTuple):
    """One status: the publisher's wall clock [ns], its counter, the team time [ns]."""

    wall_ns: int
    counter: int
    stamp_ns: int


@dataclass
class LastWords:
    """The statuses and final totals of each process of a log; 24 bytes a status and more."""

    _spoke: dict[str, list[_Spoke]] = field(default_factory=lambda: defaultdict(list))
    _ended: dict[str, list[tuple[int, int]]] = field(default_factory=lambda: defaultdict(list))

    def take_status(self, node: str, sample: Sample) -> None:
        """Adds a status of a node."""
        if sample.counter != NO_COUNTER:
            self._spoke[node].append(_Spoke(sample.wall_ns, sample.counter, sample.stamp_ns))

    def take_tally(self, tally: Tally, wall_ns: int) -> None:
        """Adds the final totals of a process; wall_ns: their wall clock [ns]."""
        self._ended[tally.node].append((tally.since_ns, wall_ns))

    def findings(self) -> Iterator[tuple[str, str]]:
        """A key, and what is unknown about its process; empty where no process published totals.

        A log of nodes in memory has no such totals.
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
    """The statuses of one process after the other: each counts from 0."""
    life: list[_Spoke] = []
    for each in spoke:
        if life and each.counter <= life[-1].counter:
            yield life
            life = []
        life.append(each)
    if life:
        yield life
