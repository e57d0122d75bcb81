"""Follow a log while it is written, chunk by chunk."""

from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from mcap.opcode import Opcode

from teamslam.team.recording.reader import Channels, Log, LogError, open_log
from teamslam.team.recording.records import FRAME_SIZE, MALFORMED, read_frames
from teamslam.team.wire.bus import Sample

MOST = 20_000  # approximate limit on samples per call


@dataclass
class Tail:
    """Read a log that may grow or not exist yet; each sample is returned once.

    ended: finished and fully read. damaged: number of unreadable chunks.
    """

    path: Path
    log: Log | None = None
    ended: bool = False
    damaged: int = 0
    _offset: int | None = None
    _channels: Channels = field(default_factory=Channels)

    def more(self) -> list[Sample]:
        """Return newly written samples of whole chunks, about MOST at most. Raises `LogError`."""
        if self.ended or (self.log is None and not self._try_open()):
            return []
        assert self.log is not None
        found: list[Sample] = []
        with self.path.open("rb") as file:
            start = () if self._offset is None else (self._offset,)
            for frame in read_frames(file, self.path, *start):
                self._offset = frame.offset + FRAME_SIZE + len(frame.body)
                if frame.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    self.ended = True
                    break
                if frame.opcode != Opcode.CHUNK:
                    continue
                try:
                    found += self.log.samples_in(frame, self._channels)
                except (*MALFORMED, ValueError, zstandard.ZstdError):
                    self.damaged += 1
                if len(found) >= MOST:
                    break
        return found

    def _try_open(self) -> bool:
        if not self.path.exists() or self.path.stat().st_size == 0:
            return False
        try:
            self.log = open_log(self.path)
        except LogError:
            if self.path.stat().st_size > _HEAD:
                raise
            return False
        return True


_HEAD = 65_536  # file size [bytes] from which an invalid file cannot become a log
