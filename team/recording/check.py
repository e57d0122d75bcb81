"""Check that a log is whole, complete and valid."""

import json
from array import array
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from teamslam.team.recording.counters import LATEST_NS, Counters
from teamslam.team.recording.editing import CUT, REPAIRED, read_undamaged
from teamslam.team.recording.inventory import MISSING, Inventory
from teamslam.team.recording.reader import Log
from teamslam.team.recording.recorder import Declaration, schema_of
from teamslam.team.recording.records import check_index
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import NO_COUNTER, Sample, opened, try_open
from teamslam.team.wire.codec import WireError

FILE = "file"  # place of a finding without a key
MOST_HOLES = 5  # most gaps of a log that are printed; `teamslam log check` prints all


class Finding(NamedTuple):
    """Defect of a log and its place: a key, or `FILE`."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


def check_log(log: Log) -> list[Finding]:
    """Find all defects of file, schemas, counters and messages, in 16 bytes a message and one
    chunk.
    """
    found = [] if log.complete else [Finding(FILE, UNFINISHED)]
    for each in log.files:
        if each.complete:
            with each.path.open("rb") as file:
                damage = check_index(file)
            found += [] if damage is None else [Finding(FILE, damage)]
    evidence = _evidence(log)
    unsound: dict[str, tuple[int, str]] = {}
    damaged: list[str] = []
    for sample in read_undamaged(log, damaged):
        reason = _unsound(sample)
        if reason is not None:
            count, first = unsound.get(sample.key, (0, reason))
            unsound[sample.key] = (count + 1, first)
        evidence.take(sample)
    found += [Finding(FILE, what) for what in damaged]
    for key, declared in sorted(log.declared.items()):
        wrong = find_misdeclaration(key, declared)
        if wrong is not None:
            found.append(Finding(key, wrong))
    found += evidence.findings()
    for key, (count, first) in sorted(unsound.items()):
        found.append(Finding(key, f"{count} unsound, the first: {first}"))
    return found


def holes(log: Log) -> list[Finding]:
    """Find missing and duplicate messages, and an unfinished recording."""
    evidence = _evidence(log)
    damaged = [] if log.complete else [UNFINISHED]
    for sample in read_undamaged(log, damaged):
        evidence.take(sample)
    return [*(Finding(FILE, what) for what in damaged), *evidence.findings()]


@dataclass
class _Evidence:
    """Evidence about missing samples.

    totals: by key, each process's final number of publications, by its start. statuses: team times
    [ns] of the counted statuses of each node. channels: those of `_READ` in the log. plain: other
    keys.
    """

    part: bool
    repaired: bool
    inventory: Inventory = field(default_factory=Inventory)
    counters: dict[str, Counters] = field(default_factory=lambda: defaultdict(Counters))
    totals: dict[str, dict[int, int]] = field(default_factory=lambda: defaultdict(dict))
    statuses: dict[str, "array[int]"] = field(default_factory=lambda: defaultdict(_stamps))
    last_word: tuple[str, ...] = ()
    channels: set[ch.Channel] = field(default_factory=set)
    plain: set[str] = field(default_factory=set)

    def take(self, sample: Sample) -> None:
        self.counters[sample.key].take(sample)
        self.inventory.take(sample)
        if sample.key not in self.plain:
            self._read(sample)

    def _read(self, sample: Sample) -> None:
        row = ch.channel_of(sample.key)
        if row is None or row[0] not in _READ:
            self.plain.add(sample.key)
            return
        channel, node = row
        self.channels.add(channel)
        if channel is ch.STATUS and node != "recorder":
            if sample.counter != NO_COUNTER:
                self.statuses[sample.key].append(min(sample.stamp_ns, LATEST_NS))
        elif channel in (ch.TALLY, ch.STATUS):
            found = try_open(sample)
            match None if found is None else found[2]:
                case m.Status() as status:
                    self.last_word = status.warnings
                case m.Tally() as tally:
                    for key, count in zip(tally.keys, tally.counts, strict=True):
                        self.totals[key][tally.since_ns] = count

    def killed(self) -> Iterator[Finding]:
        """Yield processes that announced no totals, if any process did."""
        for key, stamps_ns in sorted(self.statuses.items()) if self.totals else ():
            node = key.removesuffix("/status")
            for last in self.counters[key].unannounced(tuple(self.totals[key].values())):
                yield Finding(
                    ch.TALLY.key(node),
                    f"the process with messages until {stamps_ns[last] * 1e-9:.1f} s announced no "
                    "totals: it was killed or cut off, and its later messages may be missing",
                )

    def findings(self) -> Iterator[Finding]:
        """Yield findings, each key's once, views last; of a cut only gaps within a publisher's
        messages.
        """
        found = [*self._gaps(), *self._other_findings()]
        yield from sorted(found, key=lambda each: ch.VIEW.owner(each.where) is not None)
        named = {each.where for each in found}
        for note in self.last_word:
            if note.startswith(MISSING) and _key_of_note(note) not in named:
                yield Finding("recorder", note)

    def _gaps(self) -> Iterator[Finding]:
        for key in sorted(self.counters.keys() | self.totals.keys()):
            row = ch.channel_of(key)
            if row is not None and (row[0] is ch.ALIVE or row[1] == "recorder"):
                continue
            if row is not None and not row[0].recorded:
                continue
            numbered = not self.part and row is not None and row[0] in _NUMBERED
            totals = tuple(self.totals.get(key, {}).values())
            lines = self.counters[key].findings(part=self.part, numbered=numbered, totals=totals)
            again = DRAWN if ch.VIEW.owner(key) is not None else ""
            yield from (Finding(key, line + again) for line in lines)

    def _other_findings(self) -> Iterator[Finding]:
        if self.repaired and not self.part and not self.channels & _FINAL:
            yield Finding(FILE, NO_FINAL)
        if not self.part:
            yield from (Finding(*found) for found in self.inventory.findings())
            yield from self.killed()
            if self.channels & _OF_AN_END and not self.channels & _TOTALS:
                yield Finding(ch.END.key(), NO_END)


def _key_of_note(note: str) -> str:
    """Key in a recorder's note `missing: view/map: 20–22`."""
    return note.removeprefix(MISSING).partition(": ")[0]


_NUMBERED = (*ch.SENSORS, ch.SUBMAP)
_FINAL = {ch.FINAL_MAP, ch.TEAM_FINAL}
_OF_AN_END = {ch.ROBOT_DONE, ch.FINAL_MAP}  # channels published after the end of the streams
_TOTALS = {ch.END, ch.HEAD, ch.ROBOT_HEAD}
_READ = {*_TOTALS, ch.ROBOT_DONE, *_FINAL, ch.TALLY, ch.STATUS}
"""Channels whose presence or content is evidence beyond their counters."""
NO_END = "missing: the number of measurements is unknown"
UNFINISHED = "its recorder did not finish it; `teamslam repair` completes it"
NO_FINAL = "repaired, and without a final map: messages after its recorder died are not in it"
DRAWN = "; `teamslam view LOG --export NEW` draws all views again"


def _stamps() -> "array[int]":
    return array("q")


def _evidence(log: Log) -> _Evidence:
    return _Evidence(part=_has_note(log, CUT), repaired=_has_note(log, REPAIRED))


def _unsound(sample: Sample) -> str | None:
    if ch.channel_of(sample.key) is None:
        return None  # a viewer's, or reported by `find_misdeclaration`
    try:
        message = opened(sample)[2]
    except WireError as error:
        return f"message {sample.counter}: {error}"
    if message.stamp_ns != sample.stamp_ns:
        return f"message {sample.counter}: logged at {sample.stamp_ns} ns, of {message.stamp_ns} ns"
    return None


def find_misdeclaration(key: str, of: Declaration) -> str | None:
    """Return the defect of a key's declaration, or None; later versions may append fields."""
    row = ch.channel_of(key)
    if row is None:
        return None if ch.VIEW.owner(key) is not None else "no channel has this key"
    kind = row[0].kind_of(of.schema)
    if (of.encoding, of.schema) != ("msgpack", m.tag_of(kind)):
        stated = f"{of.encoding or 'no encoding'}, {of.schema or 'no schema'}"
        return f"declared as {stated}; its messages are msgpack, {m.tag_of(kind)}"
    ours, theirs = _fields(schema_of(kind), kind), _fields(of.text, kind)
    shared = min(len(ours), len(theirs))
    if not theirs or ours[:shared] != theirs[:shared]:
        return f"its schema is not that of {m.tag_of(kind)}"
    return None


def _fields(text: bytes, kind: type[m.Message]) -> list[Any]:
    try:
        fields = json.loads(text)["$defs"][kind.__name__]["prefixItems"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return []
    return fields if isinstance(fields, list) else []


def _has_note(log: Log, note: str) -> bool:
    return any(name.partition("@")[0] == note for name in log.metadata)
