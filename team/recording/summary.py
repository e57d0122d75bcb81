"""Summarise a log: messages, bytes, rates and times by key, and the measurement span."""

from dataclasses import dataclass
from typing import NamedTuple

from teamslam.team.recording.reader import Log
from teamslam.team.recording.repair import read_undamaged
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import SENSORS, row_of

FOREIGN = "(no channel)"  # channel of a key without a row in the table


@dataclass
class KeySummary:
    """Messages, payload bytes and team times [ns] of a key."""

    key: str
    channel: str
    messages: int
    bytes: int
    first_ns: int
    last_ns: int

    @property
    def rate_hz(self) -> float | None:
        """Messages per second of team time, (n − 1) / (last − first); None for one instant."""
        if self.last_ns == self.first_ns:
            return None
        return (self.messages - 1) * 1e9 / (self.last_ns - self.first_ns)

    def take(self, sample: Sample) -> None:
        """Count a sample."""
        self.messages += 1
        self.bytes += len(sample.payload)
        self.first_ns = min(self.first_ns, sample.stamp_ns)
        self.last_ns = max(self.last_ns, sample.stamp_ns)


class Summary(NamedTuple):
    """Keys by first message, and defects of the log."""

    keys: tuple[KeySummary, ...]
    damaged: tuple[str, ...]

    def span_ns(self) -> tuple[int, int] | None:
        """Return the team time of the first and last measurement, else of any message."""
        sensors = {channel.name for channel in SENSORS}
        chosen = [each for each in self.keys if each.channel in sensors] or self.keys
        if not chosen:
            return None
        return min(each.first_ns for each in chosen), max(each.last_ns for each in chosen)


def summarise_log(log: Log) -> Summary:
    """Summarise every whole chunk of a possibly damaged log in one pass."""
    found: dict[str, KeySummary] = {}
    damaged: list[str] = []
    for sample in read_undamaged(log, damaged):
        if sample.key not in found:
            row = row_of(sample.key)
            name = FOREIGN if row is None else row.name
            found[sample.key] = KeySummary(sample.key, name, 0, 0, sample.stamp_ns, sample.stamp_ns)
        found[sample.key].take(sample)
    return Summary(tuple(found.values()), tuple(damaged))
