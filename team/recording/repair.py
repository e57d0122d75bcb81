"""Repair a log: copies the undamaged chunks of a damaged or unfinished log to a new, complete
one.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from team.recording.reader import Log, LogError, open_log
from team.recording.recorder import Recorder
from team.wire.bus import Sample

REPAIRED = "repaired"
"""Name of the metadata that marks a log as made of an unfinished one, and names that one."""


class Report(NamedTuple):
    """The result of a repair: messages copied, newest team time among them [ns], chunks that were
    lost.
    """

    messages: int
    until_ns: int | None
    damaged: tuple[str, ...]


def read_undamaged(log: Log) -> Iterator[list[Sample] | LogError]:
    """The samples of every undamaged chunk; in the place of a damaged one its error, which is not
    raised.
    """
    try:
        yield from log.chunks()
    except LogError as error:  # nothing behind this place can be found any more
        yield error


def repair_log(path: str | Path, out: str | Path) -> Report:
    """Copy every undamaged chunk of the log at `path` to a new, complete log `out`.

    The metadata is copied; of a log that its recorder did not finish with a note. Raises `LogError`
    when `path` is no log, `RecorderError` when `out` exists.
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
