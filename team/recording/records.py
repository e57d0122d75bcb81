"""Read an MCAP file's records as untrusted input: lengths and CRCs are checked before use."""

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple, cast

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC

from teamslam.team.wire.codec import LARGEST_PAYLOAD

LARGEST_CHUNK = LARGEST_PAYLOAD + 2 * 2**20
"""Largest expanded chunk [bytes]: the largest message behind an almost full chunk."""
LARGEST_RATIO = 10_000
"""Largest expansion ratio; a map of zeros reaches 1,000, a decompression bomb tens of thousands."""
MOST_RECORDS = 250_000
"""Most records of a chunk: a recorder's 1 MiB chunk has 34 000 of the smallest messages."""
_FRAME = struct.Struct("<BQ")
_BLOCK = 2**20
_AHEAD = 4096
_OPCODES = frozenset((*range(Opcode.HEADER, Opcode.DATA_END + 1), *range(0x80, 0x100)))
_LENGTHS = {int(Opcode.DATA_END): 4, int(Opcode.FOOTER): 20}
"""Record sizes at a file's end: a flipped bit can turn a chunk's opcode into one of them."""
_COMPRESSION = b"\x04\0\0\0zstd"  # bytes in the head of each chunk of our recorder …
_TO_COMPRESSION = _FRAME.size + 28
"""… and their offset: opcode, length, two times, size and checksum."""
FRAME_SIZE = _FRAME.size
FOOTER_SIZE = FRAME_SIZE + 20
MALFORMED = (McapError, UnicodeDecodeError, OverflowError, struct.error)
"""mcap's exceptions for a record that does not fit its opcode."""
REPAIR = "`teamslam repair` saves the rest"


class LogError(ValueError):
    """A foreign or damaged file; the text has file, defect and remedy."""

    def __init__(self, path: Path, what: str, remedy: str) -> None:
        super().__init__(f"{path}: {what}; {remedy}")
        self.path = path
        self.what = what
        self.remedy = remedy


class DamagedChunkError(LogError):
    """Unreadable chunk; `Log.chunks` continues after it."""


class Frame(NamedTuple):
    """Record: position, opcode, bytes."""

    offset: int
    opcode: int
    body: bytes


def read_index(file: IO[bytes], path: Path) -> Iterator[Frame]:
    """Yield the records of the summary section, located by the footer (0: none)."""
    file.seek(_FRAME.size - FOOTER_SIZE - len(MCAP0_MAGIC), os.SEEK_END)
    (start,) = struct.unpack("<Q", file.read(8))
    return read_frames(file, path, start) if start else iter(())


def check_index(file: IO[bytes]) -> str | None:
    """Return the defect of a complete file's index, or None.

    The CRC spans the summary section and the footer up to the CRC itself.
    """
    end = file.seek(-FOOTER_SIZE - len(MCAP0_MAGIC), os.SEEK_END)
    footer = file.read(FOOTER_SIZE)
    start, _, crc = struct.unpack_from("<QQI", footer, _FRAME.size)
    if start > end:
        return f"its index claims to start at {start} of {end} bytes"
    file.seek(start or end)
    found, left = 0, end - file.tell()
    while left:
        block = file.read(min(left, _BLOCK))
        found, left = zlib.crc32(block, found), left - len(block)
    if crc and zlib.crc32(footer[:-4], found) != crc:
        return "the CRC of its index does not match"
    return None


def read_frames(file: IO[bytes], path: Path, start: int = len(MCAP0_MAGIC)) -> Iterator[Frame]:
    """Yield whole records of the file from `start`, behind invalid bytes from the next chunk on."""
    size = os.fstat(file.fileno()).st_size
    if start > size:
        raise LogError(path, f"its index claims to start at {start} of {size} bytes", REPAIR)
    offset = before = file.seek(start)
    while len(head := file.read(_FRAME.size)) == _FRAME.size:
        opcode, length = _FRAME.unpack(head)
        none = opcode not in _OPCODES or _LENGTHS.get(opcode, length) != length
        if none or offset + _FRAME.size + length > size:
            # Damage; zeros or half a record, as after a power failure.
            following = _next_chunk(file, before + 1, size)
            if following is None:
                return
            offset = before = file.seek(following)
            continue
        if length > LARGEST_CHUNK:
            what = f"record of {length} bytes at offset {offset}, {LARGEST_CHUNK} at most"
            raise LogError(path, what, REPAIR)
        yield Frame(offset, opcode, file.read(length))
        before, offset = offset, offset + _FRAME.size + length
        file.seek(offset)


def _next_chunk(file: IO[bytes], start: int, size: int) -> int | None:
    file.seek(start)
    tail, begin, ahead = b"", start, _AHEAD
    while block := file.read(ahead):
        ahead = min(2 * ahead, _BLOCK)
        data = tail + block
        at = data.find(_COMPRESSION)
        while at >= 0:
            found = begin + at - _TO_COMPRESSION
            if found >= start and at >= _TO_COMPRESSION:
                opcode, length = _FRAME.unpack_from(data, at - _TO_COMPRESSION)
                if opcode == Opcode.CHUNK and found + _FRAME.size + length <= size:
                    return found
            at = data.find(_COMPRESSION, at + 1)
        tail = data[-_TO_COMPRESSION - len(_COMPRESSION) :]
        begin += len(data) - len(tail)
    return None


def locate_records(data: bytes) -> list[tuple[int, int, int]]:
    """Return opcode, first and last byte of each record of an expanded chunk; raises ValueError."""
    found: list[tuple[int, int, int]] = []
    offset, size, head = 0, len(data), _FRAME.size
    unpack, most = _FRAME.unpack_from, MOST_RECORDS
    while offset < size:
        if len(found) == most:
            raise ValueError(f"more than {most} records, which no recorder writes")
        opcode, length = unpack(data, offset)
        start = offset + head
        offset = start + length
        found.append((opcode, start, offset))
    if offset > size:
        raise ValueError("a record ends beyond its chunk")
    return found


def expand_chunk(body: bytes) -> bytes:
    """Expand a chunk record's body.

    Raises ValueError, before expansion, for a body that our recorder cannot have written; one of
    `MALFORMED` if it is no chunk; `ZstdError` if damaged.
    """
    chunk = cast(Chunk, Chunk.read(ReadDataStream(BytesIO(body))))
    size, packed = chunk.uncompressed_size, len(chunk.data)
    if size > min(LARGEST_CHUNK, LARGEST_RATIO * packed):
        raise ValueError(f"{packed} bytes claim to expand to {size}, which no recorder writes")
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) != size:
            raise ValueError("two different sizes are claimed")
        data = zstandard.decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"compression {chunk.compression!r}, which no recorder of ours writes")
    if len(data) != size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise ValueError("the CRC does not match")
    return data
