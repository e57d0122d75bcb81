"""Run a team on a data set in memory; the run is read like a log."""

from collections.abc import Collection, Iterator
from pathlib import Path

from teamslam.sim.in_memory.team import run_team
from teamslam.sim.recorded.world import Samples
from teamslam.sim.scenarios.source import open_data_set
from teamslam.team.recording.reader import open_log
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import Channel, channel_of


class DataSetRun:
    """All messages of a team on a data set, with the data set's own scenario.

    Raises DatasetError, ScenarioError.
    """

    def __init__(self, path: Path) -> None:
        streams, scenario, _ = open_data_set(path)
        self.path = path
        self._samples = list(run_team(scenario, streams))

    def samples(self, channels: Collection[Channel] | None = None) -> Iterator[Sample]:
        """Samples of these channels; None: all."""
        for sample in self._samples:
            found = channel_of(sample.key)
            if channels is None or (found is not None and found[0] in channels):
                yield sample


def log_or_run(path: Path) -> Samples:
    """A log, or the run on a data set; raises LogError, DatasetError, ScenarioError."""
    if path.suffix == ".mcap" or (path.is_file() and path.suffix != ".zip"):
        return open_log(path)
    return DataSetRun(path)
