"""Check: whether a log is whole, complete and sound; every finding one line."""

from collections import defaultdict
from typing import NamedTuple

from team.recording.counters import Counters
from team.recording.cut import CUT
from team.recording.declared import declared, misdeclared
from team.recording.merge import MERGED
from team.recording.reader import Log, LogError
from team.recording.records import index_damage
from team.recording.repair import salvaged
from team.wire import channels as ch
from team.wire.bus import Sample, opened
from team.wire.codec import WireError

FILE = "file"
"""Where a finding is that no key has."""


class Finding(NamedTuple):
    """What is wrong, and where: a key, or `FILE`."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


def checked(log: Log) -> list[Finding]:
    """Everything that is wrong with a log: file, schemas, counters, messages; none if it is sound.

    Liveliness and the recorder's own messages are not published on a counted key: their counters
    are not looked at. Memory: 16 bytes a message, and one chunk.
    """
    found = _of_file(log)
    counters: dict[str, Counters] = defaultdict(Counters)
    unsound: dict[str, tuple[int, str]] = {}
    for chunk in salvaged(log):
        if isinstance(chunk, LogError):
            found.append(Finding(FILE, chunk.what))
            continue
        for sample in chunk:
            reason = _unsound(sample)
            if reason is not None:
                count, first = unsound.get(sample.key, (0, reason))
                unsound[sample.key] = (count + 1, first)
            counters[sample.key].take(sample)
    declarations = declared(log)
    for key in sorted(declarations):
        wrong = misdeclared(declarations[key])
        if wrong is not None:
            found.append(Finding(key, wrong))
    part = _noted(log, CUT)
    merged = _noted(log, MERGED)
    for key in sorted(counters):
        if _is_counted(key):
            lines = counters[key].findings(part=part, sorted_by_time=merged)
            found += [Finding(key, line) for line in lines]
        if key in unsound:
            count, first = unsound[key]
            found.append(Finding(key, f"{count} unsound, the first: {first}"))
    return found


def _of_file(log: Log) -> list[Finding]:
    if not log.complete:
        return [Finding(FILE, "its recorder did not finish it; `teamslam repair` completes it")]
    with log.path.open("rb") as file:
        damage = index_damage(file)
    return [] if damage is None else [Finding(FILE, damage)]


def _unsound(sample: Sample) -> str | None:
    if ch.channel_of(sample.key) is None:
        return None  # a viewer's, or a key that `misdeclared` names
    try:
        message = opened(sample)[2]
    except WireError as error:
        return f"message {sample.counter}: {error}"
    if message.stamp_ns != sample.stamp_ns:
        return f"message {sample.counter}: logged at {sample.stamp_ns} ns, of {message.stamp_ns} ns"
    return None


def _noted(log: Log, note: str) -> bool:
    """Whether the metadata has this note, of the log or of one that it was merged from."""
    return any(name.partition("@")[0] == note for name in log.metadata)


def _is_counted(key: str) -> bool:
    row = ch.channel_of(key)
    return row is None or not (row[0] is ch.ALIVE or row[1] == "recorder")
