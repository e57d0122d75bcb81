"""Classes of detections: from a table and a driver over the wire into the submap's landmarks."""

from pathlib import Path

import numpy as np
import pytest

from teamslam.sim.datasets.detections_table import detections_of
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import NO_LABEL
from teamslam.team import translate
from teamslam.team.driver import measured
from teamslam.team.driver.measured import MeasurementError
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import opened

TREES = np.array([[3.0, 1.0], [5.0, -2.0], [8.0, 2.0], [11.0, -1.0]])


def table(folder: Path, *classes: object) -> Path:
    folder.mkdir()
    rows = [f"{k},{2 + k},0.1,{name}" for k, name in enumerate(classes)]
    text = "\n".join(["t_s,range_m,bearing_rad,class", *rows])
    (folder / "detections.csv").write_text(text)
    return folder


def test_a_tables_class_is_a_column_of_the_confusion_matrix(tmp_path: Path) -> None:
    seen = detections_of(table(tmp_path / "r1", 2, 0), "r1")
    assert seen is not None
    assert seen.classes is not None
    assert np.allclose(np.exp(seen.classes), [[0.025, 0.025, 0.95], [0.95, 0.025, 0.025]])
    with pytest.raises(DatasetError, match=r"line 3.*class"):
        detections_of(table(tmp_path / "r2", 1, "2.5"), "r2")


def test_a_driver_gives_probabilities_and_a_wrong_shape_is_named() -> None:
    given = [[0.9, 0.1], [0.2, 0.8]]
    seen = measured.detections("r1", 0, ([1.0, 2.0], [0.0, 0.1]), None, given)
    assert np.allclose(np.exp(translate.classes_of(seen, 2)), given)
    with pytest.raises(MeasurementError, match="one row for each of 2"):
        measured.detections("r1", 0, ([1.0, 2.0], [0.0, 0.1]), None, given[:1])


def test_a_submaps_landmark_has_the_sum_of_its_detections(tmp_path: Path) -> None:
    kinds = [0, 1, 1, 0]
    robot = tmp_path / "set" / "r1"
    robot.mkdir(parents=True)
    times = np.arange(0, 21) * 0.5
    odometry = [f"{t},0.2,0.0" for t in times]
    (robot / "odometry.csv").write_text("\n".join(["t_s,forward_m_s,yaw_rate_rad_s", *odometry]))
    rows = []
    for t in times[1:-1]:
        for (x, y), kind in zip(TREES - [0.2 * t, 0.0], kinds, strict=True):
            rows.append(f"{t},{np.hypot(x, y)},{np.arctan2(y, x)},{kind}")
    (robot / "detections.csv").write_text("\n".join(["t_s,range_m,bearing_rad,class", *rows]))
    scenario = with_options(load("recorded"), dataset=tmp_path / "set")
    streams = streams_of(scenario)
    assert set(streams.streams[0].landmark_detections.ids.tolist()) == {NO_LABEL}
    submaps = [
        message
        for sample in run_team(scenario, streams)
        if isinstance(message := opened(sample)[2], m.Submap) and message.counts
    ]
    local = translate.local_map_of(submaps[0])
    assert len(local.ids) == len(TREES)
    near = np.argmin(np.linalg.norm(local.landmarks[:, None] - TREES, axis=2), axis=1)
    expected = np.log([[0.95, 0.05], [0.05, 0.95]])[[kinds[k] for k in near]]
    assert np.allclose(local.unnamed.classes, local.unnamed.counts[:, None] * expected)
