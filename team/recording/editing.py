"""Repair, summarise, cut and merge logs."""

import struct
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from teamslam.team.recording.reader import Log, LogError, open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import SENSORS, SIGHTING_FACTOR, SUBMAP, channel_of, row_of

REPAIRED = "repaired"  # metadata name that marks a repaired log, with the original


class Report(NamedTuple):
    """Messages copied, their newest team time [ns], and lost chunks."""

    messages: int
    until_ns: int | None
    damaged: tuple[str, ...]


def read_undamaged(log: Log, damaged: list[str]) -> Iterator[Sample]:
    """Yield the samples of undamaged chunks; add the damage of others to `damaged`."""
    try:
        for chunk in log.chunks():
            if isinstance(chunk, LogError):
                damaged.append(chunk.what)
            else:
                yield from chunk
    except LogError as error:  # nothing further can be located
        damaged.append(error.what)


def repair_log(path: str | Path, out: str | Path) -> Report:
    """Copy every undamaged chunk of a log to a new, complete log `out`.

    Raises `LogError` if `path` is no log, `RecorderError` if `out` exists.
    """
    log = open_log(path)
    messages, until_ns = 0, None
    damaged: list[str] = []
    note = {} if log.complete else {REPAIRED: log.path.name}
    with Recorder(out, log.team, {**log.metadata, **note}) as recorder:
        for sample in read_undamaged(log, damaged):
            recorder.write([sample])
            messages += 1
            until_ns = sample.stamp_ns if until_ns is None else max(until_ns, sample.stamp_ns)
    return Report(messages, until_ns, tuple(damaged))


_FAULTS = (McapError, ValueError, struct.error, RuntimeError, MemoryError, OverflowError)


def repair_bag(path: Path, out: Path) -> Report:
    """Copy the messages of an MCAP file's whole chunks to a new file with an index.

    Raises LogError, without a new file, if it has no whole message.
    """
    damaged: list[str] = []
    messages = 0
    schemas, channels = {0: 0}, dict[int, int]()
    try:
        with path.open("rb") as source, out.open("wb") as target:
            writer = Writer(target)
            has_started = False
            for record in _records(StreamReader(source, emit_chunks=True), damaged):
                if isinstance(record, Header):
                    writer.start(profile=record.profile)
                    has_started = True
                elif isinstance(record, Schema) and record.id not in schemas:
                    schemas[record.id] = writer.register_schema(
                        record.name, record.encoding, record.data
                    )
                elif isinstance(record, Channel) and record.id not in channels:
                    channels[record.id] = writer.register_channel(
                        record.topic,
                        record.message_encoding,
                        schemas.get(record.schema_id, 0),
                        record.metadata,
                    )
                elif isinstance(record, Message) and record.channel_id in channels:
                    messages += 1
                    writer.add_message(
                        channels[record.channel_id],
                        record.log_time,
                        record.data,
                        record.publish_time,
                        record.sequence,
                    )
            if has_started:
                writer.finish()  # type: ignore[no-untyped-call]  # mcap has no type here
    finally:
        if not messages:
            out.unlink(missing_ok=True)
    if not messages:
        raise LogError(path, "no MCAP file, or no whole message in it", "nothing can be repaired")
    return Report(messages, None, tuple(damaged))


def _records(reader: StreamReader, damaged: list[str]) -> Iterator[McapRecord]:
    records = reader.records
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except _FAULTS as error:
            damaged.append(f"the bytes behind the last whole chunk ({type(error).__name__})")
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            inner = breakup_chunk(record, validate_crc=True)
        except _FAULTS as error:
            damaged.append(
                f"a chunk from {record.message_start_time * 1e-9:.3f} to "
                f"{record.message_end_time * 1e-9:.3f} s ({type(error).__name__})"
            )
            continue
        yield from inner


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
        """Messages per second of team time, (n − 1) / (last − first), or None."""
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


CUT = "cut"  # metadata name that marks a cut, with the original log
STANDING = frozenset(
    channel.name
    for channel in (ch.ROBOT_CONFIG, ch.CENTRAL_CONFIG, ch.WORLD_CONFIG, ch.TRUTH_LANDMARKS)
)
"""Channels whose messages stay valid, so a cut includes earlier ones."""


def cut(
    log: Log,
    out: str | Path,
    from_s: float | None = None,
    to_s: float | None = None,
    channels: Collection[ch.Channel] | None = None,
) -> int:
    """Write the samples of [from_s, to_s) on these channels to a new log; return their number.

    Times are seconds since the first measurement; None: no bound. Earlier messages of `STANDING`
    channels are included. Raises `LogError`, before creating `out`, if it is empty or damaged.
    """
    summary = summarise_log(log)
    if summary.damaged:
        raise LogError(log.path, summary.damaged[0], "`teamslam log repair` saves the rest")
    span = summary.span_ns()
    if span is None:
        raise LogError(log.path, "no message in it", "give a log that has some")
    begin, end = (None if s is None else span[0] + round(s * 1e9) for s in (from_s, to_s))
    beyond = (begin is not None and begin > span[1]) or (end is not None and end <= span[0])
    if beyond or not any(True for _ in _within(log, begin, end, channels)):
        seconds = (span[1] - span[0]) * 1e-9
        remedy = (
            f"its measurements are from 0 to {seconds:.3f} s; `teamslam log info` has its channels"
        )
        raise LogError(log.path, "nothing of it is in this cut", remedy)
    note = _note(log.path.name, span[0], from_s, to_s, channels)
    notes = "; ".join(filter(None, (log.metadata.get(CUT), note)))
    count = 0
    with Recorder(out, log.team, {**log.metadata, CUT: notes}) as recorder:
        for sample in _within(log, begin, end, channels):
            recorder.write([sample])
            count += 1
    return count


def _within(
    log: Log, begin_ns: int | None, end_ns: int | None, channels: Collection[ch.Channel] | None
) -> Iterator[Sample]:
    for sample in log.samples(channels):
        if end_ns is not None and sample.stamp_ns >= end_ns:
            continue
        row = ch.row_of(sample.key)
        stands = row is not None and row.name in STANDING
        if begin_ns is None or sample.stamp_ns >= begin_ns or stands:
            yield sample


def _note(
    name: str,
    start_ns: int,
    from_s: float | None,
    to_s: float | None,
    channels: Collection[ch.Channel] | None,
) -> str:
    begin, end = ("" if s is None else f"{s:g}" for s in (from_s, to_s))
    names = "all channels" if channels is None else ", ".join(each.name for each in channels)
    return f"{name}: [{begin}, {end}) s since {start_ns} ns, {names}"


_BY_CONTENT = (*SENSORS, SUBMAP, SIGHTING_FACTOR)
MERGED = "merged"  # metadata name that lists the merged logs


class Merged(NamedTuple):
    """Numbers of written messages and of omitted duplicates."""

    messages: int
    duplicates: int


def merge(logs: Sequence[Log], out: str | Path) -> Merged:
    """Write each sample once to a new log `out`, in order of team time, all in memory at once.

    Equal key, counter, wall clock and payload are one publication; measurements, submaps and
    inter-robot measurements are compared by content. Raises `LogError`, before creating `out`, for
    logs of different teams or a damaged one.
    """
    first = logs[0]
    for log in logs[1:]:
        if log.team != first.team:
            what = f"a log of team {log.team!r}, not {first.team!r} as {first.path} is"
            raise LogError(log.path, what, "merge the logs of one team")
    read = list(chain.from_iterable(log.samples() for log in logs))
    once = sorted(_once(read), key=lambda sample: sample.stamp_ns)
    with Recorder(out, first.team, merged_metadata(logs)) as recorder:
        recorder.write(once)
    return Merged(len(once), len(read) - len(once))


def merged_metadata(logs: Sequence[Log]) -> dict[str, str]:
    """Merge metadata: entries on which all logs agree, others as `name@file`, `name@1:file`."""
    files = [log.path.name for log in logs]
    if len(set(files)) < len(files):
        files = [f"{i}:{file}" for i, file in enumerate(files, 1)]
    named = dict(zip(files, (log.metadata for log in logs), strict=True))
    merged: dict[str, str] = {}
    for name in dict.fromkeys(chain.from_iterable(named.values())):
        values = {f"{name}@{file}": own[name] for file, own in named.items() if name in own}
        distinct = set(values.values())
        merged |= values if len(distinct) > 1 else {name: distinct.pop()}
    return {**merged, MERGED: ", ".join(files)}


def _once(samples: Sequence[Sample]) -> Iterator[Sample]:
    seen: set[tuple[object, ...]] = set()
    for sample in samples:
        row = channel_of(sample.key)
        by_content = row is not None and row[0] in _BY_CONTENT
        published = () if by_content else (sample.counter, sample.wall_ns)
        name = (sample.key, sample.payload, *published)
        if name not in seen:
            seen.add(name)
            yield sample
