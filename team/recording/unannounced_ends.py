"""Find processes that ended without a `Tally`, so that their last messages may be missing."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from teamslam.team.recording.counters import match_totals, split_lives
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import NO_COUNTER, Sample
from teamslam.team.wire.messages import Tally


@dataclass
class LastWords:
    """Statuses and final totals of each process; 24 bytes a status and more."""

    _statuses: dict[str, list[tuple[int, int, int]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    """By node, in order of arrival: counter, wall clock [ns], team time [ns]."""
    _totals: dict[str, dict[int, int]] = field(default_factory=lambda: defaultdict(dict))
    """By node and process start, the number of statuses in the process's final totals."""

    def take_status(self, node: str, sample: Sample) -> None:
        """Add a node's status."""
        if sample.counter != NO_COUNTER:
            status = sample.counter, min(sample.wall_ns, 2**63 - 1), sample.stamp_ns
            self._statuses[node].append(status)

    def take_tally(self, tally: Tally) -> None:
        """Add a process's final totals."""
        totals = dict(zip(tally.keys, tally.counts, strict=True))
        count = totals.get(ch.STATUS.key(tally.node), 0)
        self._totals[tally.node][tally.since_ns] = count

    def findings(self) -> Iterator[tuple[str, str]]:
        """Yield keys and gaps in the record of their processes; none if no process published
        totals.

        Logs of nodes in memory have no totals.
        """
        if not self._totals:
            return
        for node, statuses in sorted(self._statuses.items()):
            counters, walls, stamps_ns = np.array(statuses, np.int64).T
            lives = split_lives(counters, walls)
            published = [int(counters[life[-1]]) + 1 for life in lives]
            totals = tuple(self._totals.get(node, {}).values())
            ended = {life for _, life in match_totals(published, totals)}
            for k, life in enumerate(lives):
                if k not in ended:
                    last_s = stamps_ns[life[-1]] * 1e-9
                    yield (
                        ch.TALLY.key(node),
                        f"the process with messages until {last_s:.1f} s announced no totals: "
                        "it was killed or cut off, and its later messages may be missing",
                    )
