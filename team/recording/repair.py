"""Repair: what is whole in a damaged or unfinished log, in a new and complete one."""

from pathlib import Path
from typing import NamedTuple

from team.recording.reader import DamagedChunkError, LogError, open_log
from team.recording.recorder import Recorder


class Report(NamedTuple):
    """What was saved: messages, the newest team time among them [ns], chunks that were not."""

    messages: int
    until_ns: int | None
    damaged: tuple[str, ...]


def repaired(path: str | Path, out: str | Path) -> Report:
    """Copy every whole chunk of the log at `path` to a new, complete log `out`.

    The metadata is kept. Raises `LogError` when `path` is no log, `RecorderError` when `out`
    exists.
    """
    log = open_log(path)
    messages, until_ns = 0, None
    damaged: list[str] = []
    with Recorder(out, log.team, log.metadata) as recorder:
        try:
            for chunk in log.chunks():
                if isinstance(chunk, DamagedChunkError):
                    damaged.append(chunk.what)
                    continue
                recorder.write(chunk)
                messages += len(chunk)
                for sample in chunk:
                    until_ns = (
                        sample.stamp_ns if until_ns is None else max(until_ns, sample.stamp_ns)
                    )
        except LogError as error:  # nothing behind this place can be found any more
            damaged.append(error.what)
    return Report(messages, until_ns, tuple(damaged))
