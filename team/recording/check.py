"""Check a log: whether it is whole, complete and sound; each finding is one line."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from team.recording.counters import Counters
from team.recording.cut import CUT
from team.recording.declared import find_misdeclaration, read_declarations
from team.recording.inventory import MISSING, Inventory
from team.recording.last_words import LastWords
from team.recording.reader import Log, LogError
from team.recording.records import check_index
from team.recording.repair import REPAIRED, read_undamaged
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Sample, opened
from team.wire.codec import WireError

FILE = "file"
"""The place of a finding that belongs to no key."""


class Finding(NamedTuple):
    """A defect of a log, and its place: a key, or `FILE`."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


def check_log(log: Log) -> list[Finding]:
    """All defects of a log: of the file, its schemas, counters and messages; none if the log is
    sound.

    Missing messages are recognised by the numbers of measurements and submaps, the ends of the
    streams, the counters of each key, and the totals that processes publish when they end
    (`holes`). Memory: 16 bytes a message, and one chunk.
    """
    found = _of_file(log)
    evidence = _evidence(log)
    unsound: dict[str, tuple[int, str]] = {}
    for chunk in read_undamaged(log):
        if isinstance(chunk, LogError):
            found.append(Finding(FILE, chunk.what))
            continue
        for sample in chunk:
            reason = _unsound(sample)
            if reason is not None:
                count, first = unsound.get(sample.key, (0, reason))
                unsound[sample.key] = (count + 1, first)
            evidence.take(sample)
    declarations = read_declarations(log)
    for key in sorted(declarations):
        wrong = find_misdeclaration(declarations[key])
        if wrong is not None:
            found.append(Finding(key, wrong))
    found += evidence.findings()
    for key, (count, first) in sorted(unsound.items()):
        found.append(Finding(key, f"{count} unsound, the first: {first}"))
    return found


def holes(log: Log) -> list[Finding]:
    """The messages that a log lacks or has twice, and whether its recorder finished it; empty for
    a complete log.

    Liveliness and the recorder's own messages are not published on a counted key: their counters
    are ignored.
    """
    evidence = _evidence(log)
    damaged = [] if log.complete else [Finding(FILE, UNFINISHED)]
    for chunk in read_undamaged(log):
        if isinstance(chunk, LogError):
            damaged.append(Finding(FILE, chunk.what))
            continue
        for sample in chunk:
            evidence.take(sample)
    return [*damaged, *evidence.findings()]


@dataclass
class _Evidence:
    """The evidence about missing samples in the samples of a log.

    part: it is a cut of another log. repaired: it was made of one that its recorder did not finish.
    totals: by key, the final number of publications of each process, by the process's beginning.
    """

    part: bool
    repaired: bool
    inventory: Inventory = field(default_factory=Inventory)
    counters: dict[str, Counters] = field(default_factory=lambda: defaultdict(Counters))
    totals: dict[str, dict[int, int]] = field(default_factory=lambda: defaultdict(dict))
    last_words: LastWords = field(default_factory=LastWords)
    last_word: tuple[str, ...] = ()
    channels: set[ch.Channel] = field(default_factory=set)

    def take(self, sample: Sample) -> None:
        self.counters[sample.key].take(sample)
        self.inventory.take(sample)
        row = ch.channel_of(sample.key)
        if row is not None and row[0] in (ch.END, ch.HEAD, ch.ROBOT_HEAD, ch.ROBOT_DONE, *_FINAL):
            self.channels.add(row[0])
        if row is None or row[0] not in (ch.TALLY, ch.STATUS):
            return
        try:
            message = opened(sample)[2]
        except WireError:
            return
        if isinstance(message, m.Status) and row[1] == "recorder":
            self.last_word = message.warnings
        elif isinstance(message, m.Status):
            self.last_words.take_status(row[1], sample)
        elif isinstance(message, m.Tally):
            self.last_words.take_tally(message)
            for key, count in zip(message.keys, message.counts, strict=True):
                self.totals[key][message.since_ns] = count

    def findings(self) -> Iterator[Finding]:
        """The findings by key; for a part of a log only the gaps between two messages of a
        publisher.
        """
        for key in sorted(self.counters.keys() | self.totals.keys()):
            row = ch.channel_of(key)
            if row is not None and (row[0] is ch.ALIVE or row[1] == "recorder"):
                continue
            if row is not None and not row[0].recorded:
                continue
            numbered = not self.part and row is not None and row[0] in _NUMBERED
            totals = tuple(self.totals.get(key, {}).values())
            for line in self.counters[key].findings(
                part=self.part, numbered=numbered, totals=totals
            ):
                yield Finding(key, line + (DRAWN if ch.VIEW.owner(key) is not None else ""))
        if self.repaired and not self.part and not self.channels & _FINAL:
            yield Finding(FILE, NO_FINAL)
        if not self.part:
            for key, line in (*self.inventory.findings(), *self.last_words.findings()):
                yield Finding(key, line)
            if self.channels & set(_OF_AN_END) and not self.channels & {
                ch.END,
                ch.HEAD,
                ch.ROBOT_HEAD,
            }:
                yield Finding(ch.END.key(), NO_END)
        for note in self.last_word:
            if note.startswith(MISSING):
                yield Finding("recorder", note)


_NUMBERED = (*ch.SENSORS, ch.SUBMAP)
_FINAL = {ch.FINAL_MAP, ch.TEAM_FINAL}
_OF_AN_END = {ch.ROBOT_DONE, ch.FINAL_MAP}
"""Channels whose publisher has received the end of the streams."""
NO_END = "missing: the number of measurements is unknown"
UNFINISHED = "its recorder did not finish it; `teamslam repair` completes it"
NO_FINAL = "repaired, and without a final map: messages after its recorder died are not in it"
DRAWN = "; `teamslam view LOG --export NEW` draws all views again"


def _of_file(log: Log) -> list[Finding]:
    found = [] if log.complete else [Finding(FILE, UNFINISHED)]
    for each in log.files:
        if each.complete:
            with each.path.open("rb") as file:
                damage = check_index(file)
            found += [] if damage is None else [Finding(FILE, damage)]
    return found


def _evidence(log: Log) -> _Evidence:
    return _Evidence(part=_noted(log, CUT), repaired=_noted(log, REPAIRED))


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
    """Whether the metadata has this note, for the log or for one that it was merged from."""
    return any(name.partition("@")[0] == note for name in log.metadata)
