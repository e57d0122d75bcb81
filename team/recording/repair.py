"""Copy the undamaged chunks of a damaged or unfinished log to a complete one."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from teamslam.team.recording.reader import Log, LogError, open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire.bus import Sample

REPAIRED = "repaired"
"""Metadata name that marks a repaired log, with the original."""


class Report(NamedTuple):
    """Messages copied, their newest team time [ns], and lost chunks."""

    messages: int
    until_ns: int | None
    damaged: tuple[str, ...]


def read_undamaged(log: Log) -> Iterator[list[Sample] | LogError]:
    """Samples of every undamaged chunk; a damaged one yields its error."""
    try:
        yield from log.chunks()
    except LogError as error:  # nothing further can be located
        yield error


def repair_log(path: str | Path, out: str | Path) -> Report:
    """Copy every undamaged chunk of a log to a new, complete log `out`.

    Metadata is copied, with a note for an unfinished log. Raises `LogError` if `path` is no log,
    `RecorderError` if `out` exists.
    """
    log = open_log(path)
    messages, until_ns = 0, None
    damaged: list[str] = []
    note = {} if log.complete else {REPAIRED: log.path.name}
    with Recorder(out, log.team, {**log.metadata, **note}) as recorder:
        for chunk in read_undamaged(log):
            if isinstance(chunk, LogError):
                damaged.append(chunk.what)
                continue
            recorder.write(chunk)
            messages += len(chunk)
            for sample in chunk:
                until_ns = sample.stamp_ns if until_ns is None else max(until_ns, sample.stamp_ns)
    return Report(messages, until_ns, tuple(damaged))
