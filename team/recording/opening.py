"""Open one file of a log."""

import os
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Metadata
from mcap.writer import MCAP0_MAGIC

from teamslam.team.recording.recorder import METADATA
from teamslam.team.recording.records import FOOTER_SIZE, MALFORMED, LogError, read_frames


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
