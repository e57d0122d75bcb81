"""Repair: what is whole in a damaged or unfinished log, in a new and complete one."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from team.recording.reader import Log, LogError, open_log
from team.recording.recorder import Recorder
from team.wire.bus import Sample


class Report(NamedTuple):
    """What was saved: messages, the newest team time among them [ns], chunks that were not."""

    messages: int
    until_ns: int | None
    damaged: tuple[str, ...]


def salvaged(log: Log) -> Iterator[list[Sample] | LogError]:
    """Every whole chunk's samples; in the place of what is damaged, its error. Never raises it."""
    try:
        yield from log.chunks()
    except LogError as error:  # nothing behind this place can be found any more
        yield error


def repaired(path: str | Path, out: str | Path) -> Report:
    """Copy every whole chunk of the log at `path` to a new, complete log `out`.

    The metadata is kept. Raises `LogError` when `path` is no log, `RecorderError` when `out`
    exists.
    """
    log = open_log(path)
    messages, until_ns = 0, None
    damaged: list[str] = []
    with Recorder(out, log.team, log.metadata) as recorder:
        for chunk in salvaged(log):
            if isinstance(chunk, LogError):
                damaged.append(chunk.what)
                continue
            recorder.write(chunk)
            messages += len(chunk)
            for sample in chunk:
                until_ns = sample.stamp_ns if until_ns is None else max(until_ns, sample.stamp_ns)
    return Report(messages, until_ns, tuple(damaged))
