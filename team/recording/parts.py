"""A log in parts: a restarted recorder continues in a further file.

`log.mcap` is the first part, `log.part2.mcap` the second; readers take them as one log
(`team.recording.reader`). When the run has ended they are joined, in the order of arrival, and
`log.mcap` is the complete log; where the disk has no room for that the parts remain. The joined log
is written under another name and takes the place of the first part in one step, so that a crash at
any moment loses nothing and adds nothing, and joining can be begun again.
"""

import os
import secrets
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from team.recording.inventory import Inventory
from team.recording.opening import LogFile
from team.recording.part_files import (
    JOINED,
    LOG_ID,
    joined_leftovers,
    next_number,
    open_part,
    part_of,
    parts_of,
)
from team.recording.reader import Log, LogError, log_of, open_log
from team.recording.recorder import Recorder, RecorderError
from team.recording.repair import read_undamaged
from team.wall_clock import wall_clock, was_set_since
from team.wire.channels import FINAL_MAP, TEAM_FINAL

LONGEST_AWAY_S = 3600.0
"""Time [s] after which a recorder does not continue a log: it is then taken for another run's."""
ROOM = 16 * 2**20
"""Bytes that must remain free on the disk."""
JOINING = ".joining"


def check_continues(
    path: Path, team: str, metadata: Mapping[str, str], *, same_run: bool = False
) -> bool:
    """Whether the run of the log at `path` goes on; False: it has ended, and only `join` is left.

    The same run has the same team and scenario, and wrote to the log's last part within the hour,
    or before the wall clock was set. same_run: it is this run's, however old. Raises `LogError` for
    any other log, and for one that is finished and joined, unless it is of this run.
    """
    parts = parts_of(path)
    remedy = "choose another name or remove it"
    log: LogFile | None = None
    for part in parts:
        if part.is_file() and part.stat().st_size == 0:
            continue
        log = open_part(part)
        if log is None:
            raise LogError(part, "exists, and is no log of ours", remedy)
        if (log.team, log.metadata.get("scenario")) != (team, metadata.get("scenario")):
            raise LogError(part, "exists, of another team or scenario", remedy)
    away_s = time.time() - parts[-1].stat().st_mtime
    if (
        not same_run
        and away_s > LONGEST_AWAY_S
        and not was_set_since({} if log is None else log.metadata)
    ):
        what = f"exists, and is from {away_s / 3600:.1f} hours ago"
        raise LogError(path, what, f"{remedy}; --resume if it is of this run")
    if log is None or not _is_over(open_log(path)):
        return True
    joining = path.with_name(path.name + JOINING).exists() or len(parts) > 1
    if not (same_run or joining or joined_leftovers(path)):
        raise LogError(path, "exists, with the final map of its run", remedy)
    return False


def _is_over(log: Log) -> bool:
    """Whether a log was finished behind the final map."""
    with suppress(LogError):
        if log.complete:
            chunks = log.chunks([FINAL_MAP, TEAM_FINAL])
            return any(chunk for chunk in chunks if not isinstance(chunk, LogError))
    return False


def next_part(path: Path, team: str, metadata: Mapping[str, str]) -> tuple[Recorder, Inventory]:
    """A recorder for the next part, and the inventory of the earlier ones.

    Raises `RecorderError` where the disk is full or the file can not be created.
    """
    for each in joined_leftovers(path):
        each.unlink()
    earlier = parts_of(path)
    if earlier and shutil.disk_usage(path.parent).free < ROOM:
        raise RecorderError(f"{path}: the disk is full; make room")
    before = next((log for log in map(open_part, earlier) if log is not None), None)
    log_id = secrets.token_hex(8) if before is None else before.metadata.get(LOG_ID)
    named = {} if log_id is None else {LOG_ID: log_id}
    part = part_of(path, next_number(path))
    try:
        recorder = Recorder(part, team, {**metadata, **wall_clock(), **named})
    except RecorderError:
        if earlier:  # not a log of somebody else: the name was free
            part.unlink(missing_ok=True)
        raise
    return recorder, inventory_of(earlier)


def inventory_of(parts: Sequence[Path]) -> Inventory:
    """The inventory of these parts; damaged chunks are left out."""
    inventory = Inventory(has_earlier_parts=bool(parts))
    for part in parts:
        file = open_part(part)
        for chunk in () if file is None else read_undamaged(log_of([file])):
            if not isinstance(chunk, LogError):
                for sample in chunk:
                    inventory.remember(sample)
    return inventory


def join(path: Path) -> list[Path]:
    """Join the parts of a log to one; returns the parts that remain, a single one on success.

    Their undamaged chunks are copied in the order of arrival. Where the disk is full nothing
    changes. To be called again after a crash: what is joined already is not joined twice.
    """
    for each in joined_leftovers(path):
        each.unlink()
    whole = path.with_name(path.name + JOINING)
    whole.unlink(missing_ok=True)
    parts = parts_of(path)
    opened = [open_part(part) for part in parts]
    logs = [log for log in opened if log is not None]
    unreadable = (p for p, log in zip(parts, opened, strict=True) if log is None)
    if len(parts) < 2 or not logs or any(part.stat().st_size for part in unreadable):
        return parts
    size = sum(part.stat().st_size for part in parts)
    if shutil.disk_usage(path.parent).free < size + ROOM:
        return parts
    joined = {JOINED: str(next_number(path) - 1)}
    try:
        with Recorder(whole, logs[0].team, {**logs[0].metadata, **joined}) as recorder:
            for log in logs:
                for chunk in read_undamaged(log_of([log])):
                    if not isinstance(chunk, LogError):
                        recorder.write(chunk)
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
    """Wait until a file, or the names in a folder, are on the disk: power may fail."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
