"""A driver's file of all measurements, in order of arrival, written before they are published.

A head (MessagePack), then records: `<IBq` (payload length, kind, stamp [ns]), the payload (a
measurement with number 0) and its CRC-32. An incomplete last record is removed.
"""

import fcntl
import os
import shutil
import struct
import threading
import time
import zlib
from array import array
from contextlib import suppress
from dataclasses import dataclass, field
from heapq import heappop, heappush
from pathlib import Path
from typing import Any, Literal

import msgpack
import msgspec

from teamslam.team.driver.source import FIRST_INCARNATION
from teamslam.team.wall_clock import wall_clock, was_set_since
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import decoded

Place = tuple[int, int]
"""(stamp [ns], kind): at equal stamps smaller kinds come first, odometry last."""


class Sorter:
    """Sort items by their places: each is held until one newer by `latency_ns` has arrived."""

    def __init__(self, latency_ns: int) -> None:
        self.latency_ns = latency_ns
        self._waiting: list[tuple[Place, int, int]] = []
        self._arrived = 0
        self._newest_ns: int | None = None
        self.released: Place | None = None
        """Place of the last returned item; earlier places are closed."""

    def put(self, place: Place, item: int) -> list[int]:
        """Add an item; return those whose place is now final."""
        heappush(self._waiting, (place, self._arrived, item))
        self._arrived += 1
        newest_ns = place[0] if self._newest_ns is None else max(self._newest_ns, place[0])
        self._newest_ns = newest_ns
        return self._until(newest_ns - self.latency_ns)

    def flush(self) -> list[int]:
        """Return all waiting items."""
        return [] if self._newest_ns is None else self._until(self._newest_ns + 1)

    def _until(self, until_ns: int) -> list[int]:
        out = []
        while self._waiting and self._waiting[0][0][0] < until_ns:
            self.released, _, item = heappop(self._waiting)
            out.append(item)
        return out


START, OBSERVATIONS, SIGHTINGS, ODOMETRY, MARK, POSE = range(6)
"""Kinds of records, in their order at equal stamps. MARK: state of the stream. POSE: a pose in the
odometry's frame, three floats.
"""
State = Literal["open", "left", "ended"]
MAGIC = b"teamslam stream 1\n"
OLD_S = 86_400.0
"""An undelivered stream without measurements for this long [s] is set aside, since its next
odometry would be refused; not if the wall clock was set meanwhile.
"""
_HEAD = struct.Struct("<IBq")
_CHECK = struct.Struct("<I")
_POSE = struct.Struct("<3d")
_LONGEST = 9  # length of the longest number in a head [bytes]


Start = tuple[bytes, bytes]  # pose and covariance of an `InitialPose`; empty: unknown


class JournalError(RuntimeError):
    """A driver's file cannot be used; the text has file, reason and remedy."""


@dataclass
class Journal:
    """One robot's file, open for appending (`open_journal`). Any thread may read.

    incarnation: in progress; 0: none. delivered: every receiver has all of it. calls: offsets of
    all records but marks. driven_ns, pose: end of the last odometry interval, and the odometry pose
    there. cut: bytes behind the last whole record; is_damaged: they are no incomplete record.
    clock: the wall clock at the last mark. team, run: "": unknown.
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
    is_damaged: bool = False
    clock: dict[str, str] = field(default_factory=dict)
    team: str = ""
    start: Start = (b"", b"")
    run: str = ""
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
        """Incarnations in the file, ascending."""
        with self._lock:
            return sorted(self._numbered)

    def count(self, incarnation: int) -> int:
        """Count the numbered measurements of an incarnation."""
        with self._lock:
            return len(self._numbered.get(incarnation, ()))

    def message(self, incarnation: int, number: int) -> m.Measurement:
        """Return a numbered measurement."""
        with self._lock:
            at = self._numbered[incarnation][number]
        message: m.Message = decoded(self.payload(at))
        assert isinstance(message, m.Measurement)
        return msgspec.structs.replace(message, number=number)

    def payload(self, at: int) -> bytes:
        """Return the payload of the record at this offset."""
        length = _HEAD.unpack(os.pread(self._file, _HEAD.size, at))[0]
        return os.pread(self._file, length, at + _HEAD.size)

    @property
    def latency_ns(self) -> int:
        """Longest delay of a measurement behind newer ones [ns]."""
        return self._sorter.latency_ns

    def too_late(self, stamp_ns: int, kind: int) -> bool:
        """Whether a measurement of a later place already has its number."""
        released = self._sorter.released
        return released is not None and (stamp_ns, kind) < released

    def append(self, kind: int, stamp_ns: int, payload: bytes) -> None:
        """Append a record, then number the measurements whose order is final."""
        record = _HEAD.pack(len(payload), kind, stamp_ns) + payload
        record += _CHECK.pack(zlib.crc32(record))
        at = self._size
        self._write(record, at)
        self._size += len(record)
        self._take(at, kind, stamp_ns, payload)

    def _write(self, data: bytes, at: int) -> None:
        try:
            written = os.pwrite(self._file, data, at)
        except OSError as error:
            raise JournalError(
                f"{self.path}: {error.strerror}; make room and start again"
            ) from None
        if written != len(data):
            raise JournalError(f"{self.path}: the disk is full; make room and start again")

    def mark(
        self,
        state: State,
        *,
        latency_ns: int | None = None,
        incarnation: int | None = None,
        delivered: bool = False,
    ) -> None:
        """Append the stream's state, and number all waiting measurements.

        incarnation: the first one of an empty file.
        """
        said = {
            "state": state,
            "latency_ns": latency_ns,
            "incarnation": incarnation,
            "delivered": delivered,
            "clock": wall_clock(),
            "team": self.team,
            "start": self.start,
        }
        self.append(MARK, 0, msgpack.packb(said))

    def mark_run(self, run: str) -> None:
        """Append the run that receives the stream; waiting measurements stay so."""
        self.append(MARK, 0, msgpack.packb({"run": run}))

    def _take(self, at: int, kind: int, stamp_ns: int, payload: bytes) -> None:
        with self._lock:
            if kind == MARK:
                said = msgpack.unpackb(payload)
                if "run" in said:
                    self.run = said["run"]
                    return
                if "team" in said:
                    self.team, self.start = said["team"], tuple(said["start"])
                self.state, self.delivered = said["state"], said["delivered"]
                self.clock = said.get("clock", {})
                self._number_all()
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
                self._number_all()
                self.incarnation = self.next_incarnation
                self._sorter = Sorter(self._sorter.latency_ns)
                self._sorter.released = (stamp_ns, START)
                self._numbered[self.incarnation] = array("q", [at])
                self.newest_ns, self.driven_ns, self.pose = stamp_ns, stamp_ns, None
                return
            self._numbered[self.incarnation].extend(self._sorter.put((stamp_ns, kind), at))
            self.newest_ns = max(self.newest_ns, stamp_ns)

    def _number_all(self) -> None:
        if self.incarnation:
            self._numbered[self.incarnation].extend(self._sorter.flush())

    @property
    def next_incarnation(self) -> int:
        """Number of the next incarnation."""
        return self.incarnation + 1 if self.incarnation else self.first_incarnation

    def read(self) -> None:
        """Read the records up to the first incomplete or damaged one."""
        at, end = self._size, os.fstat(self._file).st_size
        while at + _HEAD.size <= end:
            head = os.pread(self._file, _HEAD.size, at)
            length, kind, stamp_ns = _HEAD.unpack(head)
            rest = os.pread(self._file, length + _CHECK.size, at + _HEAD.size)
            self.is_damaged = whole = len(rest) == length + _CHECK.size
            if not whole or _CHECK.unpack(rest[length:])[0] != zlib.crc32(head + rest[:length]):
                break
            self.is_damaged = False
            self._take(at, kind, stamp_ns, rest[:length])
            at += _HEAD.size + len(rest)
        self.cut, self._size = end - at, at

    def cut_off(self) -> str:
        """Remove the bytes behind the last whole record, a damaged end with a copy; describe it."""
        if not self.cut:
            return ""
        said = f"; {self.cut} bytes of a record that was cut off are left out"
        if self.is_damaged:
            copy = self.path.with_name(f"{self.path.name}.damaged")
            said = f"; {self.cut} bytes behind a damaged record are left out"
            with suppress(OSError):
                shutil.copyfile(self.path, copy)
                said += f": {copy} has them"
        os.ftruncate(self._file, self._size)
        return said


def pose_payload(pose: tuple[float, float, float]) -> bytes:
    """Encode a pose in the odometry's frame."""
    return _POSE.pack(*pose)


def open_journal(
    path: Path, robot: str, latency_ns: int, team: str = "", start: Start = (b"", b"")
) -> tuple[Journal, str, str]:
    """Open a robot's journal; describe the stream that it continues or has delivered, and one that
    is set aside undelivered: old by OLD_S, or of another team or start.

    Raises JournalError for a file of another robot, of no driver, or in use.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    journal = _lock_file(path, robot)
    written_s = os.fstat(journal._file).st_mtime
    age_s = time.time() - written_s
    try:
        if not _read_whole(journal):
            left = f"{path}: {journal.cut} bytes of a beginning are left out" * bool(journal.cut)
            journal.first_incarnation = _first_after(_aside(path)[0], robot)
            return _begin_file(journal, latency_ns, team, start), left, ""
        is_old = age_s >= OLD_S and not was_set_since(journal.clock)
        why = _why_not_continued(journal, team, start, age_s if is_old else 0.0)
        if not why:
            left = journal.cut_off()
            is_other = (journal.team, journal.start) != (team, start)
            journal.team, journal.start = team, start
            if is_other or journal.latency_ns != latency_ns or journal.state == "left":
                journal.mark("open", latency_ns=latency_ns)
            said = ""
            if journal.calls:
                said = (
                    f"continues {path} of {time.strftime('%H:%M', time.localtime(written_s))}, "
                    f"{journal.count(journal.incarnation)} measurements, {_name_start(start)}{left}"
                )
            return journal, said, ""
    except BaseException:
        journal.close()
        raise
    delivered = journal.delivered
    fresh, said = replace_journal(journal, why, latency_ns, team, start)
    return (fresh, said, "") if delivered else (fresh, "", said)


def _why_not_continued(journal: Journal, team: str, start: Start, age_s: float) -> str:
    """Reason not to continue an open file's stream, too old by its age [s]; empty: continue."""
    if journal.delivered:
        return "has ended"
    if age_s:
        return f"is {age_s / 3600.0:.1f} h old, and not delivered"
    if not (journal.calls and journal.team):
        return ""
    if journal.team != team:
        return f"is of team {journal.team}, and this driver of team {team}"
    if journal.start != start:
        return (
            f"begins with {_name_start(journal.start)}, and this driver with {_name_start(start)}"
        )
    return ""


def replace_journal(
    journal: Journal, why: str, latency_ns: int, team: str, start: Start
) -> tuple[Journal, str]:
    """Rename an open journal's file, and begin an empty one, with a description."""
    journal.close()
    _, aside = _aside(journal.path)
    journal.path.rename(aside)
    fresh = _lock_file(journal.path, journal.robot)
    fresh.first_incarnation = journal.next_incarnation
    said = f"{journal.path}: its stream {why}: it is now {aside}, and a new one begins"
    return _begin_file(fresh, latency_ns, team, start), said


def _name_start(start: Start) -> str:
    if not start[0]:
        return "no start"
    pose = ", ".join(f"{value:g}" for value in _POSE.unpack(start[0]))
    return f"start ({pose})" + " and a covariance" * bool(start[1])


def _read_whole(journal: Journal) -> bool:
    found = _head_of(journal)
    if found is not None:
        journal.first_incarnation, journal._size = found
        journal.read()
    return found is not None


def _first_after(aside: Path | None, robot: str) -> int:
    if aside is not None:
        with suppress(JournalError, OSError):
            earlier = _lock_file(aside, robot)
            try:
                if _read_whole(earlier):
                    return earlier.next_incarnation
            finally:
                earlier.close()
    return FIRST_INCARNATION


def _begin_file(journal: Journal, latency_ns: int, team: str, start: Start) -> Journal:
    head = MAGIC + msgpack.packb({"robot": journal.robot, "incarnation": journal.first_incarnation})
    os.ftruncate(journal._file, 0)
    journal._write(head, 0)
    journal._size = len(head)
    journal.team, journal.start = team, start
    journal.mark("open", latency_ns=latency_ns)
    return journal


def _lock_file(path: Path, robot: str) -> Journal:
    journal = Journal(path, robot)
    journal._file = os.open(journal.path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(journal._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(journal._file)
        raise JournalError(
            f"{journal.path}: another driver has it open: end that one, or give another file"
        ) from None
    return journal


def _head_of(journal: Journal) -> tuple[int, int] | None:
    """Return a file's first incarnation, and the head's length; None: an empty file, or one with a
    part of the head and zeros, as after a crash.
    """
    begin = os.pread(journal._file, 4096, 0)
    unpacker = msgpack.Unpacker()
    unpacker.feed(begin[len(MAGIC) :])
    head: dict[str, Any] = {}
    if begin.startswith(MAGIC):
        with suppress(ValueError, msgpack.UnpackException):
            read = unpacker.unpack()
            head = read if isinstance(read, dict) else {}
    first = head.get("incarnation")
    if head.get("robot") == journal.robot and isinstance(first, int) and first > 0:
        return first, len(MAGIC) + unpacker.tell()
    beginning = MAGIC + msgpack.packb({"robot": journal.robot, "incarnation": 0})[:-1]
    there = begin.rstrip(b"\0")
    is_begun = beginning.startswith(there[: len(beginning)])
    is_short = len(there) < len(beginning) + _LONGEST
    size = os.fstat(journal._file).st_size
    if is_begun and is_short and not any(os.pread(journal._file, size, len(begin))):
        journal.cut = size
        return None
    whose = f"of {head['robot']}" if "robot" in head else "no driver's"
    raise JournalError(f"{journal.path}: a file {whose}, not of {journal.robot}: give another file")


def _aside(path: Path) -> tuple[Path | None, Path]:
    """Newest file that was set aside, and the name of the next one."""
    newest, number = None, 1
    while (aside := path.with_name(f"{path.name}.{number}")).exists():
        newest, number = aside, number + 1
    return newest, aside
