"""Read a log's samples, also in parts or from a killed recorder."""

import struct
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import msgpack
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as LogChannel
from mcap.records import Schema

from teamslam.team.recording.part_files import LogFile, open_file, open_part, parts_of
from teamslam.team.recording.records import (
    LARGEST_CHUNK,
    MALFORMED,
    REPAIR,
    DamagedChunkError,
    Frame,
    LogError,
    expand_chunk,
    locate_records,
    read_frames,
    read_index,
)
from teamslam.team.recording.schemas import Declaration
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import Channel, row_of

__all__ = ["LARGEST_CHUNK", "DamagedChunkError", "Log", "LogError", "log_file", "open_log"]

IN_FOLDER = "log.mcap"
NO_SCHEMA = ("", "", b"")
_MESSAGE = struct.Struct("<HIQQ")
_OF_MESSAGE = int(Opcode.MESSAGE)
"""Plain number: comparing enum members takes a tenth of the reading time."""


class Count(NamedTuple):
    """Number and bytes of a key's messages."""

    messages: int
    bytes: int


@dataclass
class Channels:
    """Keys and schemas that one file has declared so far; names: of the channels to read; None:
    all.
    """

    names: set[str] | None = None
    keys: dict[int, str | None] = field(default_factory=dict)
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=lambda: {0: NO_SCHEMA})


@dataclass(frozen=True)
class Log:
    """A log on disk.

    complete: its last recorder finished; else it is read up to its last whole chunk. metadata:
    provenance. files: consecutive parts. declared: the last declaration of each key. reading:
    receives the share read in every pass.
    """

    path: Path
    team: str
    complete: bool
    metadata: dict[str, str] = field(repr=False)
    files: tuple[LogFile, ...] = field(repr=False)
    declared: dict[str, Declaration] = field(default_factory=dict, repr=False, compare=False)
    reading: Callable[[float], None] = field(default=lambda _: None, repr=False, compare=False)

    def samples(self, channels: Collection[Channel] | None = None) -> Iterator[Sample]:
        """Yield the samples of the channels (None: all) in file order; raises `LogError`.

        Counters are modulo 2³²; stamps before zero have their true value.
        """
        for chunk in self.chunks(channels):
            if isinstance(chunk, DamagedChunkError):
                raise chunk
            yield from chunk

    def counts(self) -> dict[str, Count]:
        """Count messages and payload bytes of each key by reading the whole log."""
        counts: dict[str, Count] = {}
        for sample in self.samples():
            messages, size = counts.get(sample.key, Count(0, 0))
            counts[sample.key] = Count(messages + 1, size + len(sample.payload))
        return counts

    def chunks(
        self, channels: Collection[Channel] | None = None
    ) -> Iterator[list[Sample] | DamagedChunkError]:
        """Yield the samples chunk by chunk, with an error in place of a damaged chunk."""
        names = None if channels is None else {channel.name for channel in channels}
        sizes = [each.path.stat().st_size for each in self.files]
        before, whole = 0, max(sum(sizes), 1)
        for each, size in zip(self.files, sizes, strict=True):
            yield from self._chunks_of(each, names, before, whole)
            before += size

    def _chunks_of(
        self, part: LogFile, names: set[str] | None, before: int, whole: int
    ) -> Iterator[list[Sample] | DamagedChunkError]:
        with part.path.open("rb") as file:
            channels = Channels(names)
            # The index repeats the channels, since a chunk that introduced one may be damaged.
            if part.complete:
                with suppress(LogError, *MALFORMED):  # whole chunks introduce their channels
                    for frame in read_index(file, part.path):
                        self._introduce(frame.opcode, frame.body, channels)
            for frame in read_frames(file, part.path):
                if frame.opcode == Opcode.CHUNK:
                    self.reading((before + frame.offset) / whole)
                    try:
                        yield self.samples_in(frame, channels)
                    except (*MALFORMED, ValueError, zstandard.ZstdError) as error:
                        what = f"damaged chunk at offset {frame.offset}: {error}"
                        yield DamagedChunkError(part.path, what, REPAIR)
                elif frame.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    return
        if part.complete:
            raise LogError(part.path, "ends before its own index", REPAIR)

    def _introduce(self, opcode: int, body: bytes, channels: Channels) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(body)))
            channels.schemas[schema.id] = schema.name, schema.encoding, schema.data
        elif opcode == Opcode.CHANNEL:
            channel = LogChannel.read(ReadDataStream(BytesIO(body)))
            key = channel.topic.removeprefix(f"team/{self.team}/")
            schema = channels.schemas.get(channel.schema_id, NO_SCHEMA)
            self.declared[key] = Declaration(channel.message_encoding, *schema)
            row = None if channels.names is None else row_of(key)
            is_read = channels.names is None or (row is not None and row.name in channels.names)
            channels.keys[channel.id] = key if is_read else None

    def samples_in(self, frame: Frame, channels: Channels) -> list[Sample]:
        """Return the samples of a chunk on these channels; add its declarations to them."""
        samples, data, size = [], expand_chunk(frame.body), _MESSAGE.size
        unpack, keys = _MESSAGE.unpack_from, channels.keys
        for opcode, start, end in locate_records(data):
            if opcode == _OF_MESSAGE:
                if start + size > end:
                    raise ValueError("a message without its times")
                number, sequence, log_time, wall_ns = unpack(data, start)
                if number not in keys:
                    raise ValueError(f"message on undeclared channel {number}")
                if (key := keys[number]) is not None:
                    payload = data[start + size : end]
                    stamp_ns = log_time or _stamp_in(payload)
                    samples.append(Sample(key, payload, stamp_ns, wall_ns, sequence))
            else:
                self._introduce(opcode, data[start:end], channels)
        return samples


def log_file(path: Path) -> Path:
    """Return the path of a log, or of the log in a run's folder."""
    return path / IN_FOLDER if path.is_dir() else path


def open_log(path: str | Path) -> Log:
    """Open the log at `path` or in that run's folder, with all parts; raises `LogError`."""
    path = log_file(Path(path))
    opened = [file for part in parts_of(path)[1:] if (file := open_part(part)) is not None]
    try:
        opened.insert(0, open_file(path))
    except LogError:
        is_empty = path.is_file() and path.stat().st_size == 0  # its recorder died at once
        if not (opened and is_empty):
            raise
    return log_of(opened)


def log_of(files: Sequence[LogFile]) -> Log:
    """Return the log of consecutive files."""
    first, last = files[0], files[-1]
    return Log(first.path, first.team, last.complete, first.metadata, tuple(files))


def _stamp_in(payload: bytes) -> int:
    """Return the stamp of a message logged at zero: MCAP times cannot be negative."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(payload[:128])  # tag and stamp are within
    try:
        unpacker.read_array_header()
        unpacker.skip()
        stamp = unpacker.unpack()
    except (ValueError, msgpack.UnpackException):
        return 0  # a foreign message without stamp
    return stamp if isinstance(stamp, int) else 0
