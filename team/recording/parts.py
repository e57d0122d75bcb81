"""A log in parts: a restarted recorder continues in a further file.

At the end of a run the parts are joined, unless the disk is full. The joined log replaces the first
part in one step, so a crash neither loses nor repeats samples.
"""

import logging
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from teamslam.team.recording.editing import read_undamaged
from teamslam.team.recording.inventory import Inventory
from teamslam.team.recording.provenance import provenance
from teamslam.team.recording.reader import (
    JOINED,
    LOG_ID,
    Log,
    LogError,
    LogFile,
    Parts,
    log_of,
    open_log,
    part_of,
    read_parts,
)
from teamslam.team.recording.recorder import Recorder, RecorderError
from teamslam.team.wall_clock import wall_clock, was_set_since
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import FINAL_MAP, Channel

LONGEST_AWAY_S = 3600.0  # age [s] beyond which a log belongs to another run
ROOM = 16 * 2**20  # bytes to keep free on the disk
JOINING = ".joining"
OWN = "own_log"  # metadata name that marks a single process's log
_LOG = logging.getLogger("teamslam")


def check_continues(
    path: Path,
    team: str,
    metadata: Mapping[str, str],
    *,
    same_run: bool = False,
    ends: Sequence[Channel] = (FINAL_MAP,),
) -> bool:
    """Return whether the run of the log continues; False: only joining remains.

    It has the same team and scenario and wrote within the hour (not asked of the same_run), or
    before the wall clock was set. ends: maps that end the team. Raises `LogError` for another log.
    """
    parts = read_parts(path)
    remedy = "choose another name or remove it"
    log: LogFile | None = None
    for part, opened in parts.opened.items():
        if part.is_file() and part.stat().st_size == 0:
            continue
        log = opened
        if log is None:
            raise LogError(part, "exists, and is no log of ours", remedy)
        if (log.team, log.metadata.get("scenario")) != (team, metadata.get("scenario")):
            raise LogError(part, "exists, of another team or scenario", remedy)
    away_s = time.time() - part.stat().st_mtime
    known = {} if log is None else log.metadata
    if not same_run and away_s > LONGEST_AWAY_S and not was_set_since(known):
        what = f"exists, and is from {away_s / 3600:.1f} hours ago"
        raise LogError(path, what, f"{remedy}; --resume if it is of this run")
    if log is None or not _is_over(open_log(path), ends):
        return True
    joining = path.with_name(path.name + JOINING).exists() or len(parts.opened) > 1
    if not (same_run or joining or parts.leftovers):
        raise LogError(path, "exists, with the final map of its run", remedy)
    return False


def _is_over(log: Log, ends: Sequence[Channel]) -> bool:
    with suppress(LogError):
        if log.complete:
            chunks = log.chunks(ends)
            return any(chunk for chunk in chunks if not isinstance(chunk, LogError))
    return False


def next_part(path: Path, team: str, metadata: Mapping[str, str]) -> tuple[Recorder, Inventory]:
    """Open a recorder for the next part; return it with the inventory of the earlier ones."""
    parts = _without_leftovers(path)
    earlier = list(parts.opened)
    if earlier and shutil.disk_usage(path.parent).free < ROOM:
        raise RecorderError(f"{path}: the disk is full; make room")
    before = next((log for log in parts.opened.values() if log is not None), None)
    log_id = os.urandom(8).hex() if before is None else before.metadata.get(LOG_ID)
    named = {} if log_id is None else {LOG_ID: log_id}
    part = part_of(path, parts.next_number)
    try:
        recorder = Recorder(part, team, {**metadata, **wall_clock(), **named})
    except RecorderError:
        if earlier:  # the name was free, so the log is ours
            part.unlink(missing_ok=True)
        raise
    inventory = Inventory(has_earlier_parts=bool(earlier))
    for file in parts.opened.values():
        for sample in () if file is None else read_undamaged(log_of([file]), []):
            inventory.remember(sample)
    return recorder, inventory


def _without_leftovers(path: Path) -> Parts:
    parts = read_parts(path)
    for each in parts.leftovers:
        each.unlink()
    return parts


def join_parts(path: Path) -> list[Path]:
    """Join a log's parts; return the remaining files, one on success."""
    found = _without_leftovers(path)
    whole = path.with_name(path.name + JOINING)
    whole.unlink(missing_ok=True)
    parts = list(found.opened)
    logs = [log for log in found.opened.values() if log is not None]
    unreadable = (part for part, log in found.opened.items() if log is None)
    if len(parts) < 2 or not logs or any(part.stat().st_size for part in unreadable):
        return parts
    size = sum(part.stat().st_size for part in parts)
    if shutil.disk_usage(path.parent).free < size + ROOM:
        return parts
    joined = {JOINED: str(found.next_number - 1)}
    try:
        with Recorder(whole, logs[0].team, {**logs[0].metadata, **joined}) as recorder:
            for log in logs:
                for sample in read_undamaged(log_of([log]), []):
                    recorder.write([sample])
    except RecorderError:
        whole.unlink(missing_ok=True)
        return parts
    _write_through(whole)
    whole.replace(path)
    _write_through(path.parent)
    for part in parts[1:]:
        part.unlink()
    return [path]


def _write_through(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class OwnLog:
    """Write samples once each, until a write fails, and list lost ones: a bus's `Tap`."""

    def __init__(self, recorder: Recorder, inventory: Inventory) -> None:
        self._recorder = recorder
        self._inventory = inventory
        self.failed = False

    def __call__(self, samples: list[Sample]) -> None:
        """Write the new samples."""
        if self.failed:
            return
        try:
            self._recorder.write([sample for sample in samples if self._inventory.is_new(sample)])
        except RecorderError as error:
            self.failed = True
            _LOG.error("its own log is not written any more: %s", error)

    def lost(self, robot: str) -> list[tuple[int, int, int]]:
        """Return the measurements that a killed process lost (incarnation, first, last)."""
        if self.failed:
            return []
        return [
            (stream.incarnation, first, last)
            for stream, found in self._inventory.streams.items()
            if stream.kind == "measurements" and stream.robot == robot
            for first, last in found.missing
        ]


@contextmanager
def own_log(path: Path, team: str) -> Iterator[OwnLog]:
    """Write samples to a log within a context; after a restart, to a further part.

    A write error is reported, and the process continues. Raises `RecorderError` without a log.
    """
    recorder, inventory = next_part(path, team, {**provenance(), OWN: path.name})
    own = OwnLog(recorder, inventory)
    try:
        yield own
    finally:
        if not own.failed:
            recorder.close()
            join_parts(path)
