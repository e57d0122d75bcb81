"""Read the samples of a log, in parts, from a killed recorder, or while it is written.

`log.part2.mcap` is the second part of `log.mcap`. Parts share a LOG_ID in their metadata. A joined
log names its last part in JOINED; leftover files up to that part are not read.
"""

import os
import struct
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import msgpack
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as LogChannel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from teamslam.team.recording.recorder import METADATA, Declaration
from teamslam.team.recording.records import (
    FOOTER_SIZE,
    FRAME_SIZE,
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
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import Channel, row_of

__all__ = ["LARGEST_CHUNK", "DamagedChunkError", "LogError"]  # of `records`

LOG_ID = "log_id"
JOINED = "joined"


@dataclass(frozen=True)
class LogFile:
    """One file of a log; `complete`: it has its index."""

    path: Path
    team: str
    complete: bool
    metadata: dict[str, str] = field(repr=False)


def open_file(path: Path) -> LogFile:
    """Open one file, without further parts; raises `LogError`."""
    try:
        with path.open("rb") as file:
            return _open_stream(file, path)
    except FileNotFoundError:
        what = "give the path of a log that was recorded, or of the folder of its run"
        raise LogError(path, "not found", what) from None
    except OSError as error:
        raise LogError(path, str(error.strerror), "give the path of a readable file") from error


def _open_stream(file: IO[bytes], path: Path) -> LogFile:
    size = os.fstat(file.fileno()).st_size
    if size == 0:
        raise LogError(path, "empty file", "its recorder was stopped before it began")
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise LogError(path, "not an MCAP file", "give a log that `teamslam record` wrote")
    complete = False
    if size > FOOTER_SIZE + 2 * len(MCAP0_MAGIC):
        file.seek(-FOOTER_SIZE - len(MCAP0_MAGIC), os.SEEK_END)
        tail = file.read()
        complete = tail[0] == Opcode.FOOTER and tail.endswith(MCAP0_MAGIC)
    metadata = _metadata(file, path)
    team = metadata.pop("team", "")
    return LogFile(path, team, complete, metadata)


def _metadata(file: IO[bytes], path: Path) -> dict[str, str]:
    for frame in read_frames(file, path):
        if frame.opcode == Opcode.METADATA:
            try:
                record = Metadata.read(ReadDataStream(BytesIO(frame.body)))
            except MALFORMED as error:
                raise LogError(path, f"damaged metadata: {error}", "nothing can be read") from None
            if record.name == METADATA:
                return dict(record.metadata)
        elif frame.opcode != Opcode.HEADER:
            break
    raise LogError(
        path,
        "an MCAP file of another program, or cut off at its very beginning",
        f"a log of ours begins with metadata {METADATA!r}; `teamslam import` makes a data set of a "
        "ROS 2 bag",
    )


def part_of(path: Path, number: int) -> Path:
    """Return the path of a part; the first is the log itself."""
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}{path.suffix}")


class Parts(NamedTuple):
    """A log's files, opened if they are logs, leftovers of joined parts, and the next number."""

    opened: dict[Path, LogFile | None]
    leftovers: list[Path]
    next_number: int


def read_parts(path: Path) -> Parts:
    """Open the files of a log in order, without joined parts and parts of another log."""
    numbered = _numbered_parts(path)
    opened = {number: open_part(part) for number, part in numbered.items()}
    first = next((log for log in opened.values() if log is not None), None)
    joined = _last_joined(opened.get(1))
    own = [n for n, part in numbered.items() if n == 1 or _is_of(first, opened[n], part)]
    return Parts(
        {numbered[n]: opened[n] for n in own if n == 1 or n > joined},
        [numbered[n] for n in own if 1 < n <= joined],
        max(joined, *numbered) + 1 if numbered else 1,
    )


def parts_of(path: Path) -> list[Path]:
    """Return the files of a log in order."""
    return list(read_parts(path).opened)


def _numbered_parts(path: Path) -> dict[int, Path]:
    """List a log's files by number; none without a first file: they belong to a moved log."""
    if not path.exists():
        return {}
    found = {1: path}
    begin = f"{path.stem}.part"
    for each in path.parent.iterdir():
        number = each.name.removeprefix(begin).removesuffix(path.suffix)
        if number.isascii() and number.isdigit() and each == part_of(path, int(number)):
            found[int(number)] = each
    return dict(sorted(found.items()))


def _last_joined(log: LogFile | None) -> int:
    number = "" if log is None else log.metadata.get(JOINED, "")
    return int(number) if number.isascii() and number.isdigit() else 1


def _is_of(first: LogFile | None, log: LogFile | None, path: Path) -> bool:
    """Whether a part is of the first file's log; earlier versions' logs have no LOG_ID."""
    if first is None or log is None:
        return path.stat().st_size == 0
    same = LOG_ID, "scenario"
    return first.team == log.team and all(
        first.metadata.get(name) == log.metadata.get(name) for name in same
    )


def open_part(path: Path) -> LogFile | None:
    """Open one file as a log; None if invalid, as after an early end of its recorder."""
    with suppress(LogError):
        return open_file(path)
    return None


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
    """Keys and schemas that a file has declared so far; names: channels to read; None: all."""

    names: set[str] | None = None
    keys: dict[int, str | None] = field(default_factory=dict)
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=lambda: {0: NO_SCHEMA})


@dataclass(frozen=True)
class Log:
    """A log on disk, read up to its last whole chunk.

    complete: its last recorder finished. metadata: provenance. files: consecutive parts. declared:
    the last declaration of each key. reading: receives the share read in every pass.
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
        """Count messages and payload bytes of each key."""
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
    """Stamp of a message logged at zero, since MCAP times cannot be negative."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(payload[:128])  # tag and stamp are within
    try:
        unpacker.read_array_header()
        unpacker.skip()
        stamp = unpacker.unpack()
    except (ValueError, msgpack.UnpackException):
        return 0  # a foreign message without stamp
    return stamp if isinstance(stamp, int) else 0


MOST = 20_000  # approximate limit on samples per call
_HEAD = 65_536  # file size [bytes] from which an invalid file cannot become a log


@dataclass
class Tail:
    """Read a log that may grow or not exist yet; each sample is returned once.

    ended: finished and fully read. damaged: number of unreadable chunks.
    """

    path: Path
    log: Log | None = None
    ended: bool = False
    damaged: int = 0
    _offset: int | None = None
    _channels: Channels = field(default_factory=Channels)

    def more(self) -> list[Sample]:
        """Return newly written samples of whole chunks, about MOST at most; raises `LogError`."""
        if self.ended or (self.log is None and not self._try_open()):
            return []
        assert self.log is not None
        found: list[Sample] = []
        with self.path.open("rb") as file:
            start = () if self._offset is None else (self._offset,)
            for frame in read_frames(file, self.path, *start):
                self._offset = frame.offset + FRAME_SIZE + len(frame.body)
                if frame.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    self.ended = True
                    break
                if frame.opcode != Opcode.CHUNK:
                    continue
                try:
                    found += self.log.samples_in(frame, self._channels)
                except (*MALFORMED, ValueError, zstandard.ZstdError):
                    self.damaged += 1
                if len(found) >= MOST:
                    break
        return found

    def _try_open(self) -> bool:
        if not self.path.exists() or self.path.stat().st_size == 0:
            return False
        try:
            self.log = open_log(self.path)
        except LogError:
            if self.path.stat().st_size > _HEAD:
                raise
            return False
        return True
