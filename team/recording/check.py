"""Check that a log is whole, complete and valid.

A publisher counts its publications on a key from 0. A life is the publications of one process.
"""

import json
from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from teamslam.team.recording.editing import CUT, REPAIRED, read_undamaged
from teamslam.team.recording.inventory import MISSING, NUMBERED, Inventory
from teamslam.team.recording.reader import Log
from teamslam.team.recording.recorder import Declaration, schema_of
from teamslam.team.recording.records import check_index
from teamslam.team.shapes import Int64
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import NO_COUNTER, Sample, opened, try_open
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.intervals import Interval, IntervalSet, describe_intervals

Life = Int64[np.ndarray, "_"]  # positions of one life's publications, by counter
LATEST_NS = 2**63 - 1  # largest wall clock [ns]; later ones are from damaged or hostile logs


class Counters:
    """Counters and wall clocks [ns] of one key's samples in file order."""

    def __init__(self) -> None:
        self._counters = array("q")
        self._walls = array("q")
        self._replies = 0

    def take(self, sample: Sample) -> None:
        """Add a sample's counter."""
        if sample.counter == NO_COUNTER:
            self._replies += 1
            return
        self._counters.append(sample.counter)
        self._walls.append(min(sample.wall_ns, LATEST_NS))

    def findings(
        self, *, part: bool, numbered: bool = False, totals: Sequence[int] = ()
    ) -> list[str]:
        """Find defects, one line each.

        part: of a cut, earlier publications are not missing. numbered: messages have own numbers.
        totals: publishers' final counts.
        """
        counters, walls = self._arrays()
        order = np.lexsort((walls, counters))
        again = np.zeros(len(order), np.bool_)
        again[1:] = (np.diff(counters[order]) == 0) & (np.diff(walls[order]) == 0)
        found = []
        if again.any():
            first = counters[order][again][0]
            found.append(f"{_messages(int(again.sum()))} twice, the first is {first}")
        if numbered:
            return found
        once = np.sort(order[~again])
        lives = [counters[once][life] for life in split_lives(counters[once], walls[once])]
        gaps = [gap for life in lives for gap in _gaps(life, part=part)]
        if not part:
            published = [int(life[-1]) + 1 for life in lives]
            for total, life in match_totals(published, totals):
                behind = 0 if life is None else published[life]
                gaps += [(behind, total - 1)] if behind < total else []
        lost = sum(last - first + 1 for first, last in gaps)
        if lost > self._replies:
            found.append(f"{_messages(lost)} missing: {describe_intervals(gaps)}")
        return found

    def _arrays(self) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        return np.frombuffer(self._counters, np.int64), np.frombuffer(self._walls, np.int64)

    def unannounced(self, totals: Sequence[int]) -> list[int]:
        """Return the position of the last publication of each life without a total."""
        counters, walls = self._arrays()
        lives = split_lives(counters, walls)
        published = [int(counters[life[-1]]) + 1 for life in lives]
        ended = {life for _, life in match_totals(published, totals)}
        return [int(life[-1]) for k, life in enumerate(lives) if k not in ended]


def split_lives(counters: Int64[np.ndarray, " n"], walls: Int64[np.ndarray, " n"]) -> list[Life]:
    """Split publications, in order of arrival, into lives of their publisher.

    A life ends where the counters, by wall clock or by arrival, do not ascend. The order with fewer
    lives is used, then with fewer gaps: a set clock adds to the first, late arrivals to the second.
    """
    if not len(counters):
        return []
    order = np.lexsort((counters, walls))
    by_wall = np.split(order, np.flatnonzero(np.diff(counters[order]) <= 0) + 1)
    if len(by_wall) == 1:
        return by_wall
    by_arrival = _by_arrival(counters)

    def defects(lives: list[Life]) -> tuple[int, int]:
        return len(lives), sum(int(counters[life[-1]]) + 1 - len(life) for life in lives)

    return min(by_wall, by_arrival, key=defects)


def _by_arrival(counters: Int64[np.ndarray, " n"]) -> list[Life]:
    """Split by arrival: a repeated counter belongs to the latest life that lacks it."""
    present = [IntervalSet()]
    places: list[list[int]] = [[]]
    for place, counter in enumerate(counters.tolist()):
        at = len(present) - 1
        if counter in present[at]:
            earlier = ((k, present[k]) for k in reversed(range(at)))
            at = next((k for k, x in earlier if counter < x.last and counter not in x), at + 1)
        if at == len(present):
            present.append(IntervalSet())
            places.append([])
        present[at].add(counter, counter)
        places[at].append(place)
    arrays = [np.array(each, np.int64) for each in places]
    return [each[np.argsort(counters[each], kind="stable")] for each in arrays]


def match_totals(published: Sequence[int], totals: Sequence[int]) -> list[tuple[int, int | None]]:
    """Match each process's total to a life: equal numbers first, then the largest life with fewer.

    None: without a life. A life without total is of a killed process.
    """
    free = dict(enumerate(published))
    found: list[tuple[int, int | None]] = []
    rest = []
    for total in totals:
        life = next((k for k, count in free.items() if count == total), None)
        if life is None:
            rest.append(total)
        else:
            del free[life]
            found.append((total, life))
    for total in rest:
        fewer = [k for k, count in free.items() if count < total]
        life = max(fewer, key=free.__getitem__, default=None)
        if life is not None:
            del free[life]
        found.append((total, life))
    return found


def _gaps(counters: Int64[np.ndarray, " n"], *, part: bool) -> list[Interval]:
    before = np.concatenate([counters[:1] - 1 if part else [-1], counters[:-1]])
    missing = counters > before + 1
    pairs = zip(before[missing] + 1, counters[missing] - 1, strict=True)
    return [(int(first), int(last)) for first, last in pairs]


def _messages(count: int) -> str:
    return f"{count} message" if count == 1 else f"{count} messages"


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
    found = Holes(log)
    damaged: list[str] = []
    for _ in found.through(read_undamaged(log, damaged)):
        pass
    return [*(Finding(FILE, what) for what in damaged), *found.findings()]


class Holes:
    """Missing and duplicate messages of a log that another reader reads."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._evidence = _evidence(log)

    def through(self, samples: Iterable[Sample]) -> Iterator[Sample]:
        """Yield the samples of the log."""
        for sample in samples:
            self._evidence.take(sample)
            yield sample

    def findings(self) -> list[Finding]:
        """Findings after the last sample, first an unfinished recording."""
        unfinished = [] if self._log.complete else [Finding(FILE, UNFINISHED)]
        return [*unfinished, *self._evidence.findings()]


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
    statuses: dict[str, "array[int]"] = field(
        default_factory=lambda: defaultdict(lambda: array("q"))
    )
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
        for note in self.last_word:  # as `missing: view/map: 20–22`
            key = note.removeprefix(MISSING).partition(": ")[0]
            if note.startswith(MISSING) and key not in named:
                yield Finding("recorder", note)

    def _gaps(self) -> Iterator[Finding]:
        for key in sorted(self.counters.keys() | self.totals.keys()):
            row = ch.channel_of(key)
            if row is not None and (row[0] is ch.ALIVE or row[1] == "recorder"):
                continue
            if row is not None and not row[0].recorded:
                continue
            numbered = not self.part and row is not None and row[0] in NUMBERED
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


_FINAL = {ch.FINAL_MAP, ch.TEAM_FINAL}
_OF_AN_END = {ch.ROBOT_DONE, ch.FINAL_MAP}  # channels published after the end of the streams
_TOTALS = {ch.END, ch.HEAD, ch.ROBOT_HEAD}
_READ = {*_TOTALS, ch.ROBOT_DONE, *_FINAL, ch.TALLY, ch.STATUS}
"""Channels whose presence or content is evidence beyond their counters."""
NO_END = "missing: the number of measurements is unknown"
UNFINISHED = "its recorder did not finish it; `teamslam repair` completes it"
NO_FINAL = "repaired, and without a final map: messages after its recorder died are not in it"
DRAWN = "; `teamslam view LOG --export NEW` draws all views again"


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
