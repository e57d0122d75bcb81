"""A log in parts: a restarted recorder continues in a further file.

`log.mcap` is the first part, `log.part2.mcap` the second. When the run has ended they are joined,
in the order of arrival, and `log.mcap` is the complete log; where the disk has no room for that the
parts remain, and `teamslam log merge` joins them elsewhere.
"""

import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from team.recording.inventory import Inventory
from team.recording.reader import Log, LogError, open_log
from team.recording.recorder import Recorder, RecorderError
from team.recording.repair import salvaged
from team.wire.channels import FINAL_MAP, TEAM_FINAL

LONGEST_AWAY_S = 3600.0
"""Time [s] after which a recorder does not continue a log: it is then taken for another run's."""
ROOM = 16 * 2**20
"""Bytes that must remain free on the disk."""
JOINING = ".joining"


def part_of(path: Path, number: int) -> Path:
    """The path of a part of the log at `path`; the first is the log itself."""
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """The existing parts of a log."""
    found = []
    number = 1
    while (part := part_of(path, number)).exists():
        found.append(part)
        number += 1
    return found


def check_continues(path: Path, team: str, metadata: Mapping[str, str]) -> None:
    """Raises `LogError` unless the log at `path` is of this same run and not finished.

    The same run has the same team and scenario, and wrote to the log's last part within the hour.
    """
    parts = parts_of(path)
    away_s = time.time() - parts[-1].stat().st_mtime
    remedy = "choose another name or remove it"
    if away_s > LONGEST_AWAY_S:
        raise LogError(path, f"exists, and is from {away_s / 3600:.1f} hours ago", remedy)
    for part in parts:
        if part.is_file() and part.stat().st_size == 0:
            continue
        log = _opened(part)
        if log is None:
            raise LogError(part, "exists, and is no log of ours", remedy)
        if (log.team, log.metadata.get("scenario")) != (team, metadata.get("scenario")):
            raise LogError(part, "exists, of another team or scenario", remedy)
        if log.complete and any(True for _ in log.samples([FINAL_MAP, TEAM_FINAL])):
            raise LogError(part, "exists, with the final map of its run", remedy)


def next_part(path: Path, team: str, metadata: Mapping[str, str]) -> tuple[Recorder, Inventory]:
    """A recorder for the next part, and the inventory of the earlier ones.

    Raises `RecorderError` where the disk is full or the file can not be created.
    """
    earlier = parts_of(path)
    if earlier and shutil.disk_usage(path.parent).free < ROOM:
        raise RecorderError(f"{path}: the disk is full; make room")
    part = part_of(path, len(earlier) + 1)
    try:
        recorder = Recorder(part, team, metadata)
    except RecorderError:
        if earlier:  # not a log of somebody else: the name was free
            part.unlink(missing_ok=True)
        raise
    return recorder, inventory_of(earlier)


def inventory_of(parts: Sequence[Path]) -> Inventory:
    """The inventory of these parts; damaged chunks are left out."""
    inventory = Inventory(has_earlier_parts=bool(parts))
    for part in parts:
        log = _opened(part)
        for chunk in () if log is None else salvaged(log):
            if not isinstance(chunk, LogError):
                for sample in chunk:
                    inventory.remember(sample)
    return inventory


def join(path: Path) -> list[Path]:
    """Joins the parts of a log to one; returns the parts that remain, a single one on success.

    Their undamaged chunks are copied in the order of arrival. Where the disk is full nothing
    changes.
    """
    parts = parts_of(path)
    logs = [log for log in map(_opened, parts) if log is not None]
    if len(parts) < 2 or not logs:
        return parts
    size = sum(part.stat().st_size for part in parts)
    if shutil.disk_usage(path.parent).free < size + ROOM:
        return parts
    whole = path.with_name(path.name + JOINING)
    whole.unlink(missing_ok=True)
    try:
        with Recorder(whole, logs[0].team, logs[0].metadata) as recorder:
            for log in logs:
                for chunk in salvaged(log):
                    if not isinstance(chunk, LogError):
                        recorder.write(chunk)
    except RecorderError:
        whole.unlink(missing_ok=True)
        return parts
    whole.replace(path)
    for part in parts[1:]:
        part.unlink()
    return [path]


def _opened(path: Path) -> Log | None:
    """Opens a part; None where its recorder ended before it had begun."""
    with suppress(LogError):
        return open_log(path)
    return None
