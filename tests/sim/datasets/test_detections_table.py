"""A simulated world with hidden identities, written as a folder and read again: every bit stays."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.scenarios.toml import folder_scenario


def written(place: Path, tagged: float) -> tuple:
    scenario = with_options(load("thesis-b"), robots=2, identities="hidden")
    world = msgspec.structs.replace(
        scenario.world, steps=12, clutter=0.3, missed=0.1, tagged=tagged
    )
    scenario = msgspec.structs.replace(scenario, world=world)
    streams = streams_of(scenario)
    write_folder(streams, place)
    (place / "scenario.toml").write_text(folder_scenario(scenario))
    return streams, load(place / "scenario.toml")


@pytest.mark.parametrize("tagged", [0.0, 0.5])
def test_what_is_written_is_read_as_it_was(tmp_path, tagged):
    streams, scenario = written(tmp_path / "set", tagged)
    again = streams_of(scenario)
    assert scenario.central.association.slack > 0.03, "the thresholds in the sensor's lengths"
    for one, two in zip(streams.streams, again.streams, strict=True):
        told, read = one.landmark_detections, two.landmark_detections
        full = np.flatnonzero(np.diff(told.offsets))
        assert (told.stamps_ns[full] == read.stamps_ns[np.flatnonzero(np.diff(read.offsets))]).all()
        for name in ("ids", "ranges", "bearings"):
            assert np.array_equal(getattr(told, name), getattr(read, name))
        hidden = np.repeat(told.hidden, np.diff(told.offsets))
        assert np.array_equal(hidden, np.repeat(read.hidden, np.diff(read.offsets)))
        assert hidden.any()
        assert (tagged > 0.0) == (not hidden.all())


def test_labels_that_are_not_row_by_row_are_refused(tmp_path):
    _, scenario = written(tmp_path / "set", 0.0)
    labels = tmp_path / "set" / "r1" / "labels.csv"
    labels.write_text("landmark\n1\n")
    with pytest.raises(DatasetError, match=r"r1/labels\.csv.*1 rows"):
        streams_of(scenario)
