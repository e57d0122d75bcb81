"""A peer's set on disk: an append-only file, from which a robot continues after a restart.

After eight bytes that say what it is come records: length and CRC-32 of the body, four bytes each,
little-endian; the body is a MessagePack array [key, payload, signature]. A record that a crash has
truncated is cut off when the file is opened again: its member comes from other peers, or is
computed again. A record is in the hands of the operating system when `append` returns: a process
that is killed loses nothing, a computer without power the last seconds.
"""

import logging
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgpack

from team.peers.members import LARGEST_MEMBER, Member, member_of

MAGIC = b"tmsset1\n"
_HEAD = struct.Struct("<II")
_LOG = logging.getLogger("teamslam")
_LARGEST = LARGEST_MEMBER + 2**16


class StoreError(RuntimeError):
    """The file can not be used; the text says why and what to do."""


def record_of(member: Member) -> bytes:
    """The record of a member."""
    body: bytes = msgpack.packb([member.key, member.payload, member.signature], use_bin_type=True)
    return _HEAD.pack(len(body), zlib.crc32(body)) + body


def records_in(content: bytes) -> Iterator[tuple[int, Member]]:
    """The complete members of a file, each with the end of its record; stops at a truncated one."""
    at = len(MAGIC)
    while at + _HEAD.size <= len(content):
        length, crc = _HEAD.unpack_from(content, at)
        body = content[at + _HEAD.size : at + _HEAD.size + length]
        if length > _LARGEST or len(body) < length or zlib.crc32(body) != crc:
            return
        at += _HEAD.size + length
        try:
            key, payload, signature = msgpack.unpackb(body)
            yield at, member_of(key, payload, signature)
        except (ValueError, TypeError, msgpack.UnpackException):
            return


class Store:
    """The file of one peer; `members`: those in it when it was opened. Raises StoreError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            content = path.read_bytes() if path.exists() else b""
            if content and content[: len(MAGIC)] != MAGIC[: len(content)]:
                raise StoreError(f"{path} is no set of a peer: give --set another file")
            found = list(records_in(content))
            self.members = [member for _, member in found]
            whole = found[-1][0] if found else len(MAGIC)
            self._file = path.open("r+b" if content else "w+b", buffering=0)
            if len(content) < len(MAGIC):
                self._file.write(MAGIC)
            self.torn = max(len(content) - whole, 0)
            self._file.truncate(whole)
            self._file.seek(whole)
        except OSError as error:
            raise StoreError(f"{path} can not be written: {error}") from error

    def append(self, members: Iterable[Member]) -> None:
        """Append members. Raises StoreError."""
        records = b"".join(record_of(member) for member in members)
        if records:
            try:
                self._file.write(records)
            except OSError as error:
                raise StoreError(f"{self.path} can not be written: {error}") from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Keeper:
    """Keeps a set in its file as long as this can be written; without a path nowhere.

    members: those in it when it was opened. Raises StoreError where the file can not be used.
    """

    def __init__(self, path: Path | None) -> None:
        self._store = None if path is None else Store(path)
        self.members = [] if self._store is None else self._store.members

    def append(self, members: Sequence[Member]) -> None:
        """Append members; an error of the file is logged, and nothing more is kept."""
        if self._store is None or not members:
            return
        try:
            self._store.append(members)
        except StoreError as error:
            _LOG.error("the set is not kept any more: %s", error)
            self.close()

    def close(self) -> None:
        """Close the file."""
        if self._store is not None:
            self._store.close()
            self._store = None
