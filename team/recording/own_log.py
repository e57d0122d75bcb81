"""A process's own log of sent and received samples, independent of the recorder."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from teamslam.team.recording.inventory import Inventory
from teamslam.team.recording.parts import join_parts, next_part
from teamslam.team.recording.provenance import provenance
from teamslam.team.recording.recorder import Recorder, RecorderError
from teamslam.team.wire.bus import Sample

OWN = "own_log"
"""Metadata name that marks a single process's log."""
_LOG = logging.getLogger("teamslam")


class OwnLog:
    """Write samples once each, until a write fails, and list lost ones: a bus's `Tap`."""

    def __init__(self, recorder: Recorder, inventory: Inventory) -> None:
        self._recorder = recorder
        self._inventory = inventory
        self.failed = False

    def __call__(self, samples: list[Sample]) -> None:
        """Write the new samples."""
        if self.failed:
            return
        try:
            self._recorder.write([sample for sample in samples if self._inventory.is_new(sample)])
        except RecorderError as error:
            self.failed = True
            _LOG.error("its own log is not written any more: %s", error)

    def lost(self, robot: str) -> list[tuple[int, int, int]]:
        """Return the missing intervals of a robot's measurements (incarnation, first, last).

        A killed process loses unflushed measurements, which its robot will not request again.
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
    """Write samples to a log within a context; after a restart, to a further part.

    A write error is reported, and the process continues. Raises `RecorderError` if no log can be
    created.
    """
    recorder, inventory = next_part(path, team, {**provenance(), OWN: path.name})
    own = OwnLog(recorder, inventory)
    try:
        yield own
    finally:
        if not own.failed:
            recorder.close()
            join_parts(path)
