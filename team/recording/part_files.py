"""Files of a log: a restarted recorder writes a further part.

`log.part2.mcap` is the second part of `log.mcap`. Parts share a LOG_ID in their metadata. A joined
log names its last part in JOINED; leftover files up to that part are not read.
"""

import os
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Metadata
from mcap.writer import MCAP0_MAGIC

from teamslam.team.recording.recorder import METADATA
from teamslam.team.recording.records import FOOTER_SIZE, MALFORMED, LogError, read_frames

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
    """Return whether a part is of the first file's log; earlier versions' logs have no LOG_ID."""
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
