"""Reads the samples of a log, also of one whose recorder was killed."""

import os
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

import msgpack
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as LogChannel
from mcap.records import Metadata
from mcap.writer import MCAP0_MAGIC

from team.recording.recorder import METADATA, Count
from team.recording.records import (
    FOOTER_SIZE,
    LARGEST_CHUNK,
    MALFORMED,
    REPAIR,
    DamagedChunkError,
    Frame,
    LogError,
    expanded,
    frames,
    index,
    places,
)
from team.wire.bus import Sample
from team.wire.channels import VIEW, Channel, channel_of

__all__ = ["LARGEST_CHUNK", "DamagedChunkError", "Log", "LogError", "log_file", "open_log"]

IN_FOLDER = "log.mcap"
"""The log in the folder of a run."""
_MESSAGE = struct.Struct("<HIQQ")
_OF_MESSAGE = int(Opcode.MESSAGE)
"""As a plain number: to compare with an enum's member takes a tenth of the time of reading."""


@dataclass(frozen=True)
class Log:
    """A log on disk. `complete` is False when its recorder did not finish it.

    `metadata` is its provenance, `team` the team's name. An incomplete log is read up to its last
    whole chunk. `reading` is told by every pass over the log which share of it is read.
    """

    path: Path
    team: str
    complete: bool
    metadata: dict[str, str] = field(repr=False)
    reading: Callable[[float], None] = field(default=lambda _: None, repr=False, compare=False)

    def samples(self, channels: Collection[Channel] | None = None) -> Iterator[Sample]:
        """The samples of the given channels (None: all) in the order of the file; raises
        `LogError`.

        A counter is returned modulo 2³², a stamp before zero with its true value.
        """
        for chunk in self.chunks(channels):
            if isinstance(chunk, DamagedChunkError):
                raise chunk
            yield from chunk

    def in_time_order(self, channels: Collection[Channel] | None = None) -> list[Sample]:
        """The samples in the order of team time, equal stamps in that of the file; all in
        memory.
        """
        return sorted(self.samples(channels), key=lambda sample: sample.stamp_ns)

    def counts(self) -> dict[str, Count]:
        """Messages and payload bytes of each key, by reading the whole log."""
        counts: dict[str, Count] = {}
        for sample in self.samples():
            messages, size = counts.get(sample.key, Count(0, 0))
            counts[sample.key] = Count(messages + 1, size + len(sample.payload))
        return counts

    def chunks(
        self, channels: Collection[Channel] | None = None
    ) -> Iterator[list[Sample] | DamagedChunkError]:
        """The samples chunk by chunk; in the place of a damaged chunk, its error."""
        names = None if channels is None else {channel.name for channel in channels}
        size = max(self.path.stat().st_size, 1)
        with self.path.open("rb") as file:
            # The index repeats the channels: a chunk that introduced one may be damaged.
            keys = self._indexed(file, names) if self.complete else {}
            for frame in frames(file, self.path):
                if frame.opcode == Opcode.CHUNK:
                    self.reading(frame.offset / size)
                    try:
                        yield self.samples_in(frame, keys, names)
                    except (*MALFORMED, ValueError, zstandard.ZstdError) as error:
                        what = f"damaged chunk at offset {frame.offset}: {error}"
                        yield DamagedChunkError(self.path, what, REPAIR)
                elif frame.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    return
        if self.complete:
            raise LogError(self.path, "ends before its own index", REPAIR)

    def _indexed(self, file: IO[bytes], names: set[str] | None) -> dict[int, str | None]:
        keys: dict[int, str | None] = {}
        with suppress(LogError, *MALFORMED):  # whole chunks introduce their channels themselves
            for frame in index(file, self.path):
                if frame.opcode == Opcode.CHANNEL:
                    self._introduce(frame.body, names, keys)
        return keys

    def _introduce(self, body: bytes, names: set[str] | None, keys: dict[int, str | None]) -> None:
        channel = LogChannel.read(ReadDataStream(BytesIO(body)))
        keys[channel.id] = self._key(channel.topic, names)

    def samples_in(
        self, frame: Frame, keys: dict[int, str | None], names: set[str] | None = None
    ) -> list[Sample]:
        """The samples of a chunk, on channels of these names; channels that it declares are added
        to `keys`.
        """
        samples, data, size = [], expanded(frame.body), _MESSAGE.size
        unpack = _MESSAGE.unpack_from
        for opcode, start, end in places(data):
            if opcode == _OF_MESSAGE:
                if start + size > end:
                    raise ValueError("a message without its times")
                number, sequence, log_time, wall_ns = unpack(data, start)
                if number not in keys:
                    raise ValueError(f"message on channel {number}, which nothing describes")
                if (key := keys[number]) is not None:
                    payload = data[start + size : end]
                    stamp_ns = log_time or _stamp_in(payload)
                    samples.append(Sample(key, payload, stamp_ns, wall_ns, sequence))
            elif opcode == Opcode.CHANNEL:
                self._introduce(data[start:end], names, keys)
        return samples

    def _key(self, topic: str, names: set[str] | None) -> str | None:
        key = topic.removeprefix(f"team/{self.team}/")
        if names is None:
            return key
        found = channel_of(key)
        row = found[0] if found is not None else VIEW if VIEW.owner(key) is not None else None
        return key if row is not None and row.name in names else None


def log_file(path: Path) -> Path:
    """The path of a log; of a run's folder, that of the log in it."""
    return path / IN_FOLDER if path.is_dir() else path


def open_log(path: str | Path) -> Log:
    """The log at `path`, or in the run's folder there; raises `LogError` when there is none."""
    path = log_file(Path(path))
    try:
        with path.open("rb") as file:
            return _opened(file, path)
    except FileNotFoundError:
        what = "give the path of a log that was recorded, or of the folder of its run"
        raise LogError(path, "not found", what) from None
    except OSError as error:
        raise LogError(path, str(error.strerror), "give the path of a readable file") from error


def _opened(file: IO[bytes], path: Path) -> Log:
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
    return Log(path, metadata.pop("team", ""), complete, metadata)


def _metadata(file: IO[bytes], path: Path) -> dict[str, str]:
    for frame in frames(file, path):
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


def _stamp_in(payload: bytes) -> int:
    """The stamp in a message whose log time is zero: MCAP's times can not be negative."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(payload[:128])  # the tag and the stamp are within
    try:
        unpacker.read_array_header()
        unpacker.skip()
        stamp = unpacker.unpack()
    except (ValueError, msgpack.UnpackException):
        return 0  # not a message of ours: there is no stamp to restore
    return stamp if isinstance(stamp, int) else 0
