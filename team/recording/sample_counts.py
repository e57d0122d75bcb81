"""Count a recorder's samples of each key, by publishing process.

A restarted process counts its publications from 0 again. Consecutive samples form a run; a gap
filled later is another run.
"""

from collections import defaultdict
from dataclasses import dataclass

from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import NO_COUNTER, Sample

NUMBERED = (*ch.SENSORS, ch.SUBMAP)
"""Channels with numbered messages, which the recorder reports as progress."""


@dataclass
class _Run:
    """Samples with counters first … end − 1 and wall clocks [ns] first_ns … last_ns."""

    first: int
    end: int
    first_ns: int
    last_ns: int


class Received:
    """Received counters of each key that its publisher caches."""

    def __init__(self) -> None:
        self._runs: dict[str, list[_Run]] = defaultdict(list)

    def take(self, sample: Sample) -> None:
        """Register a sample; a repetition changes nothing."""
        found = ch.channel_of(sample.key)
        if sample.counter == NO_COUNTER or found is None or not _is_acknowledged(found[0]):
            return
        runs, counter, wall_ns = self._runs[sample.key], sample.counter, sample.wall_ns
        if any(
            run.first <= counter < run.end and run.first_ns <= wall_ns <= run.last_ns
            for run in runs
        ):
            return
        if runs and runs[-1].end == counter and runs[-1].last_ns <= wall_ns:
            runs[-1].end, runs[-1].last_ns = counter + 1, wall_ns
        else:
            runs.append(_Run(counter, counter + 1, wall_ns, wall_ns))

    def of_process(self, key: str, since_ns: int) -> tuple[int, int]:
        """Number of samples of the process that began then, and its next counter."""
        runs = [run for run in self._runs.get(key, ()) if run.first_ns >= since_ns]
        return sum(run.end - run.first for run in runs), max((run.end for run in runs), default=0)

    def lacking(self, tally: m.Tally, awaited: set[str]) -> dict[str, int]:
        """Keys of a process with missing samples, each with the number received.

        awaited: keys whose publisher may still have samples. Other keys need only the newest
        sample.
        """
        found = {}
        for key, count in zip(tally.keys, tally.counts, strict=True):
            row = ch.channel_of(key)
            if row is None or not _is_acknowledged(row[0]):
                continue
            number, end = self.of_process(key, tally.since_ns)
            if number < count and (end < count or key in awaited):
                found[key] = number
        return found


def _is_acknowledged(channel: ch.Channel) -> bool:
    return channel.recorded and channel.delivery != "stream" and channel not in NUMBERED
