"""A process's own log: what it publishes and receives, whatever becomes of the team's recorder."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from team.recording.parts import join, next_part
from team.recording.provenance import provenance
from team.recording.recorder import RecorderError
from team.wire.bus import Sample

OWN = "own_log"
"""The metadata that says that a log is of what one process heard."""
_LOG = logging.getLogger("teamslam")


@contextmanager
def own_log(path: Path, team: str) -> Iterator[Callable[[list[Sample]], None]]:
    """What writes samples to the log; started again it goes on in a further part.

    A log that can not be written is named and left: the process goes on. Raises `RecorderError`
    where there can be none at `path`.
    """
    recorder, inventory = next_part(path, team, {**provenance(), OWN: path.name})
    failed = False

    def write(samples: list[Sample]) -> None:
        nonlocal failed
        if failed:
            return
        try:
            recorder.write([sample for sample in samples if inventory.is_new(sample)])
        except RecorderError as error:
            failed = True
            _LOG.error("its own log is not written any more: %s", error)

    try:
        yield write
    finally:
        if not failed:
            recorder.close()
            join(path)
