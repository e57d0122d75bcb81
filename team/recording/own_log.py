"""A process' own log: its publications and received samples, independent of the team's recorder."""

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
"""Name of the metadata that marks a log as the samples of a single process."""
_LOG = logging.getLogger("teamslam")


class OwnLog:
    """Write samples to a log, each once, and list the messages lost in a crash: a bus's `Tap`.

    failed: whether the log could not be written any more, which was reported.
    """

    def __init__(self, recorder: Recorder, inventory: Inventory) -> None:
        self._recorder = recorder
        self._inventory = inventory
        self.failed = False

    def __call__(self, samples: list[Sample]) -> None:
        """Write those samples that are new."""
        if self.failed:
            return
        try:
            self._recorder.write([sample for sample in samples if self._inventory.is_new(sample)])
        except RecorderError as error:
            self.failed = True
            _LOG.error("its own log is not written any more: %s", error)

    def lost(self, robot: str) -> list[tuple[int, int, int]]:
        """Measurements of a robot that are known and not in the log: incarnation, first, last
        number.

        A killed process loses what it had not flushed; its robot may have used these measurements,
        and then does not request them again.
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
    """A context that writes samples to the log; after a restart it continues in a further part.

    A log that can not be written any more is reported and abandoned: the process goes on. Raises
    `RecorderError` where no log can be created at `path`.
    """
    recorder, inventory = next_part(path, team, {**provenance(), OWN: path.name})
    own = OwnLog(recorder, inventory)
    try:
        yield own
    finally:
        if not own.failed:
            recorder.close()
            join(path)
