"""A process's own log: what it publishes and receives, whatever becomes of the team's recorder."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from team.recording.inventory import Inventory
from team.recording.parts import join, next_part
from team.recording.provenance import provenance
from team.recording.recorder import Recorder, RecorderError
from team.wire.bus import Sample

OWN = "own_log"
"""The metadata that says that a log is of what one process heard."""
_LOG = logging.getLogger("teamslam")


class OwnLog:
    """Writes samples to a log, each once, and knows what a death has cost it: a bus's `Tap`.

    failed: it can not be written any more, which was said.
    """

    def __init__(self, recorder: Recorder, inventory: Inventory) -> None:
        self._recorder = recorder
        self._inventory = inventory
        self.failed = False

    def __call__(self, samples: list[Sample]) -> None:
        """Write what of these is new."""
        if self.failed:
            return
        try:
            self._recorder.write([sample for sample in samples if self._inventory.is_new(sample)])
        except RecorderError as error:
            self.failed = True
            _LOG.error("its own log is not written any more: %s", error)

    def lost(self, robot: str) -> list[tuple[int, int, int]]:
        """Measurements of a robot that are known of and not in the log: incarnation, first, last.

        What a killed process had not flushed; its robot may have used it, and not ask for it again.
        """
        if self.failed:
            return []
        return [
            (stream.incarnation, first, last)
            for stream, found in self._inventory.streams.items()
            if stream.kind == "measurements" and stream.robot == robot
            for first, last in found.missing
        ]


@contextmanager
def own_log(path: Path, team: str) -> Iterator[OwnLog]:
    """What writes samples to the log; started again it goes on in a further part.

    A log that can not be written is named and left: the process goes on. Raises `RecorderError`
    where there can be none at `path`.
    """
    recorder, inventory = next_part(path, team, {**provenance(), OWN: path.name})
    own = OwnLog(recorder, inventory)
    try:
        yield own
    finally:
        if not own.failed:
            recorder.close()
            join(path)
