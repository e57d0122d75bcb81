"""Copy the undamaged chunks of a damaged or unfinished log, or of a ROS 2 bag, to a new one."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from teamslam.team.recording.reader import Log, LogError, open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire.bus import Sample

REPAIRED = "repaired"  # metadata name that marks a repaired log, with the original


class Report(NamedTuple):
    """Messages copied, their newest team time [ns], and lost chunks."""

    messages: int
    until_ns: int | None
    damaged: tuple[str, ...]


def read_undamaged(log: Log, damaged: list[str]) -> Iterator[Sample]:
    """Yield the samples of every undamaged chunk; add the damage of others to `damaged`."""
    try:
        for chunk in log.chunks():
            if isinstance(chunk, LogError):
                damaged.append(chunk.what)
            else:
                yield from chunk
    except LogError as error:  # nothing further can be located
        damaged.append(error.what)


def repair_log(path: str | Path, out: str | Path) -> Report:
    """Copy every undamaged chunk of a log to a new, complete log `out`, noted if it was unfinished.

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


class BagReport(NamedTuple):
    """Number of messages copied, and the damage as text."""

    messages: int
    damaged: tuple[str, ...]


def repair_bag(path: Path, out: Path) -> BagReport:
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
    return BagReport(messages, tuple(damaged))


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
