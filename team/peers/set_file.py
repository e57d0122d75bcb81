"""A set on disk: an append-only file, loaded after a restart.

Records follow eight bytes that identify the file: length and CRC-32 of the body, four bytes each,
little-endian; the body is a MessagePack array [key, payload, signature]. A truncated last record is
cut off; a damaged one is skipped, reported and removed. A killed process loses nothing, a power
failure the last seconds.
"""

import logging
import os
import struct
import time
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import NamedTuple

import msgpack

from teamslam.team.peers.members import LARGEST_MEMBER, Member, member_of
from teamslam.team.wire import messages as m
from teamslam.team.wire.intervals import IntervalSet, describe_intervals

MAGIC = b"tmsset1\n"
RETRY_S = 5.0  # interval [s] between attempts to write after an error
_HEAD = struct.Struct("<II")
_BODY = b"\x93"  # first byte of each body: an array of three
_LEAST = 4  # fewest bytes of a body: the array and three empty values
_LOG = logging.getLogger("teamslam")
_LARGEST = LARGEST_MEMBER + 2**16


class SetFileError(RuntimeError):
    """An unusable file; the text gives the reason and the remedy."""


class Record(NamedTuple):
    """The place of an intact record, and its member; None for another version's."""

    begin: int
    end: int
    member: Member | None


def record_of(member: Member) -> bytes:
    """Encode a member as a record."""
    body: bytes = msgpack.packb([member.key, member.payload, member.signature], use_bin_type=True)
    return _HEAD.pack(len(body), zlib.crc32(body)) + body


def records_in(content: bytes) -> Iterator[Record]:
    """Yield the intact records of a file, also those after damaged ones."""
    at = len(MAGIC)
    while (begin := _next_record(content, at)) is not None:
        length, _ = _HEAD.unpack_from(content, begin)
        at = begin + _HEAD.size + length
        yield Record(begin, at, _member_in(content[begin + _HEAD.size : at]))


def _next_record(content: bytes, at: int) -> int | None:
    """Find the first intact record from `at` on, behind damaged ones and any forged in these."""
    while at + _HEAD.size <= len(content) and not _is_intact(content, at):
        following = at + _HEAD.size + _HEAD.unpack_from(content, at)[0]
        if not _is_intact(content, following):
            break
        at = following
    while at + _HEAD.size < len(content):
        if _is_intact(content, at):
            return at
        body = content.find(_BODY, at + 1 + _HEAD.size)
        at = len(content) if body < 0 else body - _HEAD.size
    return None


def _is_intact(content: bytes, at: int) -> bool:
    begin = at + _HEAD.size
    if content[begin : begin + 1] != _BODY:
        return False
    length, crc = _HEAD.unpack_from(content, at)
    if not _LEAST <= length <= min(_LARGEST, len(content) - begin):
        return False
    return zlib.crc32(memoryview(content)[begin : begin + length]) == int(crc)


def _member_in(body: bytes) -> Member | None:
    with suppress(ValueError, TypeError, msgpack.UnpackException):
        key, payload, signature = msgpack.unpackb(body)
        return member_of(key, payload, signature)
    return None


def missing_in(members: Iterable[Member]) -> list[str]:
    """Describe the submaps that a set lacks before the last one of each stream."""
    found: defaultdict[tuple[str, int], IntervalSet] = defaultdict(IntervalSet)
    for member in members:
        message = member.message
        if isinstance(message, m.Submap):
            stream = found[message.robot, message.incarnation]
            stream.add(message.sequence, message.sequence)
    return [
        f"submaps {describe_intervals(gaps)} of {robot}, incarnation {incarnation}"
        for (robot, incarnation), numbers in sorted(found.items())
        if (gaps := numbers.gaps(0, numbers.last))
    ]


class SetFile:
    """The file of one set; None: in memory only. Raises SetFileError.

    torn: bytes of an incomplete last record. lost: other damage, in words. Members that cannot be
    written are reported and written later.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.members: list[Member] = []
        self.torn, self.lost = 0, ""
        self._file: FileIO | None = None
        self._pending: list[Member] = []
        self._failure = ""
        self._retry_s = 0.0
        if path is None:
            return
        try:
            content = path.read_bytes() if path.exists() else b""
            found = list(records_in(content))
            if _is_foreign(content) and not found:
                raise SetFileError(f"{path} is not a peer's set: give --set another file")
            self.members = [each.member for each in found if each.member is not None]
            self._open(path, content, found)
        except OSError as error:
            raise SetFileError(f"{path} can not be written: {error}") from error

    def _open(self, path: Path, content: bytes, found: Sequence[Record]) -> None:
        begins = [*(each.begin for each in found), len(content)]
        ends = [min(len(MAGIC), len(content)), *(each.end for each in found)]
        *inner, last = [begin - end for begin, end in zip(begins, ends, strict=True)]
        if _is_cut_off(content, ends[-1]):
            self.torn, last = last, 0
            _LOG.info("%s: a record that was cut off, %d bytes", path, self.torn)
        holes = [size for size in (*inner, last) if size]
        self._size = max(ends[-1], len(MAGIC))
        if holes or content[: len(MAGIC)] != MAGIC[: len(content)]:
            self.lost = _describe_damage(path, holes, self.members)
            _LOG.warning("%s", self.lost)
            intact = b"".join(content[each.begin : each.end] for each in found)
            with suppress(OSError):  # without room the damage stays, and is skipped each time
                _replace(path, MAGIC + intact)
                self._size = len(MAGIC) + len(intact)
        self._file = path.open("r+b" if path.exists() else "w+b", buffering=0)
        self._file.truncate(self._size)
        if len(content) < len(MAGIC):
            self._write(self._file, MAGIC, 0)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Members missing in the file."""
        failure = self._failure and f"{self._failure}: {len(self._pending)} members are not stored"
        return tuple(text for text in (failure, self.lost) if text)

    def append(self, members: Iterable[Member]) -> None:
        """Append members, and those that an error kept back."""
        if self._file is not None:
            self._pending += members
            if self._pending and time.monotonic() >= self._retry_s:
                self._append_pending(self._file)

    def _append_pending(self, file: FileIO) -> None:
        records = b"".join(map(record_of, self._pending))
        try:
            self._write(file, records, self._size)
        except OSError as error:
            failure = f"{self.path} can not be written: {error}"
            if not self._failure:
                _LOG.error("the set is not stored: %s; trying again every %g s", failure, RETRY_S)
            self._failure = failure
            self._retry_s = time.monotonic() + RETRY_S
            return
        self._size += len(records)
        if self._failure:
            _LOG.warning("the set is stored again, with %d members", len(self._pending))
        self._pending, self._failure, self._retry_s = [], "", 0.0

    def _write(self, file: FileIO, data: bytes, at: int) -> None:
        """Write all bytes, or none after an error."""
        done = 0
        try:
            while done < len(data):
                # A disk that becomes full takes a part without an error and refuses the next one.
                done += os.pwrite(file.fileno(), data[done:], at + done)
        except OSError:
            file.truncate(at)
            raise

    def close(self) -> None:
        """Write the pending members, and close the file."""
        if self._file is not None:
            self._append_pending(self._file)
            if self._pending:
                _LOG.error("%d members of the set are not stored", len(self._pending))
            self._file.close()
            self._file = None


def _is_cut_off(content: bytes, at: int) -> bool:
    if at + _HEAD.size > len(content):
        return any(content[at:]) or at >= len(content)
    length, _ = _HEAD.unpack_from(content, at)
    return len(content) - at - _HEAD.size < int(length) <= _LARGEST


def _is_foreign(content: bytes) -> bool:
    """Whether a file's beginning is not ours; zeros remain after a power failure."""
    begin = content[: len(MAGIC)]
    ours = all(here in (0, there) for here, there in zip(begin, MAGIC, strict=False))
    return any(content) and not (ours and any(begin))


def _replace(path: Path, content: bytes) -> None:
    fresh = path.with_name(path.name + ".new")
    with fresh.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)


def _describe_damage(path: Path, holes: Sequence[int], members: Sequence[Member]) -> str:
    places, damaged = max(len(holes), 1), sum(holes)
    lacks = missing_in(members)
    missing = f"; it lacks {', '.join(lacks)}, as far as known" if lacks else ""
    return (
        f"{path} was damaged in {places} place{'s' * (places != 1)}: {damaged} bytes are lost, "
        f"{len(members)} members are intact{missing}; the rest of the set is requested again"
    )
