"""A driver's file: holds every measurement, in order of arrival, before it is published.

The file only grows. It begins with a head (MessagePack); a record is `<IBq`: the payload's length,
its kind, its stamp [ns]; then the payload, an encoded measurement with number 0, and its CRC-32.
A record that a crash has cut off is left out. The numbers follow from the records by `Sorter`, so a
driver that is started again goes on where it was.
"""

import fcntl
import os
import struct
import threading
import time
import zlib
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgpack
import msgspec

from team.driver.order import Sorter
from team.driver.source import FIRST_INCARNATION
from team.wire import messages as m
from team.wire.codec import decoded

START, OBSERVATIONS, SIGHTINGS, ODOMETRY, MARK, POSE = range(6)
"""Kinds of records; of equal stamps the smaller one comes first. The last two are no measurements:
whether the stream goes on, and a pose in the odometry's frame, three floats.
"""
State = Literal["open", "left", "ended"]
MAGIC = b"teamslam stream 1\n"
OLD_S = 3600.0
"""A stream that was not ended and has not grown for this long [s] is set aside as an old one."""
_HEAD = struct.Struct("<IBq")
_CHECK = struct.Struct("<I")
_POSE = struct.Struct("<3d")


class JournalError(RuntimeError):
    """A driver's file can not be used; the text says which, why and what to do."""


@dataclass
class Journal:
    """One robot's file, open for appending; `opened` makes it. Any thread may read.

    incarnation: the one in progress; 0 before anything was measured. state: of the stream, as in
    its head. delivered: every receiver has all of it. calls: the offsets of all records but marks,
    in order of arrival. driven_ns, pose: end of the last odometry interval, and the odometry pose.
    """

    path: Path
    robot: str
    first_incarnation: int = FIRST_INCARNATION
    incarnation: int = 0
    state: State = "open"
    delivered: bool = False
    newest_ns: int = -(2**62)
    driven_ns: int | None = None
    pose: tuple[float, float, float] | None = None
    calls: "array[int]" = field(default_factory=lambda: array("q"))
    cut: int = 0
    _numbered: dict[int, "array[int]"] = field(default_factory=dict)
    _sorter: Sorter = field(default_factory=lambda: Sorter(0))
    _file: int = -1
    _size: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def close(self) -> None:
        """Close the file and release its lock."""
        os.close(self._file)

    @property
    def incarnations(self) -> list[int]:
        """The incarnations in the file, in order."""
        with self._lock:
            return sorted(self._numbered)

    def count(self, incarnation: int) -> int:
        """Number of measurements of an incarnation that are numbered."""
        with self._lock:
            return len(self._numbered.get(incarnation, ()))

    def message(self, incarnation: int, number: int) -> m.Measurement:
        """A numbered measurement."""
        with self._lock:
            at = self._numbered[incarnation][number]
        message: m.Message = decoded(self.payload(at))
        assert isinstance(message, m.Measurement)
        return msgspec.structs.replace(message, number=number)

    def payload(self, at: int) -> bytes:
        """The payload of the record at this offset."""
        length = _HEAD.unpack(os.pread(self._file, _HEAD.size, at))[0]
        return os.pread(self._file, length, at + _HEAD.size)

    def too_late(self, stamp_ns: int, kind: int) -> bool:
        """Whether a measurement behind this place has been numbered already."""
        released = self._sorter.released
        return released is not None and (stamp_ns, kind) < released

    def append(self, kind: int, stamp_ns: int, payload: bytes) -> None:
        """Write a record to the file, then number the measurements whose order is settled."""
        record = _HEAD.pack(len(payload), kind, stamp_ns) + payload
        record += _CHECK.pack(zlib.crc32(record))
        at = self._size
        try:
            written = os.pwrite(self._file, record, at)
        except OSError as error:
            raise JournalError(
                f"{self.path}: {error.strerror}; make room and start again"
            ) from None
        if written != len(record):
            raise JournalError(f"{self.path}: the disk is full; make room and start again")
        self._size += written
        self._take(at, kind, stamp_ns, payload)

    def mark(
        self,
        state: State,
        *,
        latency_ns: int | None = None,
        incarnation: int | None = None,
        delivered: bool = False,
    ) -> None:
        """Record the stream's state; all measurements that wait for their order are numbered.

        incarnation: number of the first incarnation of an empty file. delivered: every receiver has
        all of the stream.
        """
        said = {
            "state": state,
            "latency_ns": latency_ns,
            "incarnation": incarnation,
            "delivered": delivered,
        }
        self.append(MARK, 0, msgpack.packb(said))

    def _take(self, at: int, kind: int, stamp_ns: int, payload: bytes) -> None:
        with self._lock:
            if kind == MARK:
                said = msgpack.unpackb(payload)
                self.state, self.delivered = said["state"], said["delivered"]
                if self.incarnation:
                    self._numbered[self.incarnation].extend(self._sorter.flush())
                if said["latency_ns"] is not None:
                    self._sorter.latency_ns = said["latency_ns"]
                if said["incarnation"] is not None and not self.incarnation:
                    self.first_incarnation = said["incarnation"]
                return
            self.calls.append(at)
            if kind == POSE:
                self.driven_ns, self.pose = stamp_ns, _POSE.unpack(payload)
                return
            if kind == ODOMETRY and stamp_ns != self.driven_ns:
                self.driven_ns, self.pose = stamp_ns, None
            if kind == START:
                if self.incarnation:
                    self._numbered[self.incarnation].extend(self._sorter.flush())
                self.incarnation = self.next_incarnation
                self._sorter = Sorter(self._sorter.latency_ns)
                self._sorter.released = (stamp_ns, START)
                self._numbered[self.incarnation] = array("q", [at])
                self.newest_ns, self.driven_ns, self.pose = stamp_ns, stamp_ns, None
                return
            self._numbered[self.incarnation].extend(self._sorter.put((stamp_ns, kind), at))
            self.newest_ns = max(self.newest_ns, stamp_ns)

    @property
    def next_incarnation(self) -> int:
        """The number of the incarnation that begins next."""
        return self.incarnation + 1 if self.incarnation else self.first_incarnation

    def read(self) -> None:
        """Read the records of the file; a record cut off by a crash will be overwritten."""
        at, end = self._size, os.fstat(self._file).st_size
        while at + _HEAD.size <= end:
            head = os.pread(self._file, _HEAD.size, at)
            length, kind, stamp_ns = _HEAD.unpack(head)
            rest = os.pread(self._file, length + _CHECK.size, at + _HEAD.size)
            whole = len(rest) == length + _CHECK.size
            if not whole or _CHECK.unpack(rest[length:])[0] != zlib.crc32(head + rest[:length]):
                break
            self._take(at, kind, stamp_ns, rest[:length])
            at += _HEAD.size + len(rest)
        self.cut, self._size = end - at, at
        os.ftruncate(self._file, at)


def pose_payload(pose: tuple[float, float, float]) -> bytes:
    """The payload of a pose in the odometry's frame."""
    return _POSE.pack(*pose)


def opened(path: Path, robot: str, latency_ns: int) -> tuple[Journal, str]:
    """The robot's journal, opened for appending, and a description of what it contains.

    A stream that has ended and is delivered, or that has not grown for OLD_S, is moved aside; the
    new one begins with the next incarnation number, so that the two are not confused. Raises
    JournalError for a file of another robot or of no driver, or one that another driver has open.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    found = path.stat() if path.exists() else None
    journal = _existing(path, robot) if found is not None and found.st_size else None
    said = ""
    first = FIRST_INCARNATION
    if journal is not None and found is not None:
        age_s = time.time() - found.st_mtime
        if not journal.delivered and age_s < OLD_S:
            other = journal._sorter.latency_ns != latency_ns
            if other or journal.state == "left":
                journal.mark("open", latency_ns=latency_ns)
            count = journal.count(journal.incarnation)
            said = f"{path}: goes on after measurement {count - 1}, {age_s:.0f} s old"
            said += f"; {journal.cut} bytes of a record that was cut off are left out" * bool(
                journal.cut
            )
            return journal, said
        first = journal.next_incarnation
        journal.close()
        aside = _set_aside(path)
        why = "has ended" if journal.delivered else f"is {age_s / 3600.0:.1f} h old"
        said = f"{path}: its stream {why}: it is now {aside}, and a new one begins"
    journal = Journal(path, robot, first)
    _open(journal, os.O_CREAT | os.O_EXCL)
    head = {"robot": robot, "incarnation": first}
    journal._size = os.write(journal._file, MAGIC + msgpack.packb(head))
    journal.mark("open", latency_ns=latency_ns)
    return journal, said


def _open(journal: Journal, flags: int) -> None:
    try:
        journal._file = os.open(journal.path, os.O_RDWR | flags, 0o644)
        fcntl.flock(journal._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(journal._file)
        raise JournalError(
            f"{journal.path}: another driver has it open: end that one, or give another file"
        ) from None


def _existing(path: Path, robot: str) -> Journal:
    journal = Journal(path, robot)
    _open(journal, 0)
    begin = os.pread(journal._file, 4096, 0)
    unpacker = msgpack.Unpacker()
    unpacker.feed(begin[len(MAGIC) :])
    try:
        head: dict[str, Any] = unpacker.unpack() if begin.startswith(MAGIC) else {}
    except (ValueError, msgpack.UnpackException):
        head = {}
    if head.get("robot") != robot:
        journal.close()
        whose = f"of {head['robot']}" if "robot" in head else "no driver's"
        raise JournalError(f"{path}: a file {whose}, not of {robot}: give another file")
    journal.first_incarnation = int(head["incarnation"])
    journal._size = len(MAGIC) + unpacker.tell()
    journal.read()
    return journal


def _set_aside(path: Path) -> Path:
    number = 1
    while (aside := path.with_name(f"{path.name}.{number}")).exists():
        number += 1
    path.rename(aside)
    return aside
