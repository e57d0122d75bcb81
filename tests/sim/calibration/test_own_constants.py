from dataclasses import replace

import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import Path, on_circle
from teamslam.sim.calibration.data import Reference
from teamslam.sim.calibration.own import marker_spread, own_constants
from teamslam.sim.world.streams import Intervals, grouped
from tests.sim.calibration.test_calibrate import reference

PLACES = {i: (1.0 + 0.4 * i) * np.array([np.cos(a), np.sin(a)])
          for i, a in enumerate(np.linspace(-0.6, 0.6, 8), 1)}  # fmt: skip
CAMERAS = {"r1": (1.02, 0.05, 0.0), "r2": (1.05, 0.0, 0.01), "r3": (0.99, 0.1, -0.04)}
"""range_scale, range_offset [m], optical_axis [rad]."""
BENT = -0.05  # cubic error of the bearings


def looking(
    robot: str,
    world: int,
    camera: tuple[float, float, float],
    *,
    depth: bool = True,
    marker: float = 0.0,
) -> Reference:
    rng = np.random.default_rng([int(robot[1:]), world])
    scale, offset, axis = camera
    ids = np.repeat(np.array(list(PLACES), np.uint32), 300)
    places = np.repeat(np.array(list(PLACES.values())), 300, axis=0)
    bearings = np.arctan2(places[:, 1], places[:, 0])
    distances = np.hypot(*places.T) * (1.0 + 0.01 * rng.standard_normal(len(ids)))
    distances *= 1.0 + marker * np.random.default_rng(world).standard_normal(len(PLACES))[ids - 1]
    raw = bearings + 0.01
    for _ in range(20):
        raw = bearings + 0.01 + BENT * raw**3
    along = np.cos(raw - axis) if depth else 1.0
    read = on_circle(raw + 0.002 * rng.standard_normal(len(ids)))
    stamps = rng.permutation(len(ids)).astype(np.int64) * 100_000_000
    order = np.argsort(stamps)
    seen = grouped(
        stamps[order], ids[order], (scale * distances * along + offset)[order], read[order]
    )
    last = int(stamps.max())
    intervals = Intervals(np.array([last]), np.array([last]), np.zeros(1), np.zeros(1))
    path = Path(np.array([0, last]), np.zeros((2, 3)))
    label = f"{world} {robot}"
    return reference(
        label, intervals=intervals, seen=seen, path=path, gap_ns=last, landmarks=PLACES
    )


def team(cameras: dict[str, tuple[float, float, float]], *, depth: bool = True) -> list[Reference]:
    return [looking(r, w, camera, depth=depth) for w in (1, 2) for r, camera in cameras.items()]


def test_each_cameras_own_constants_come_out_where_they_differ():
    own = own_constants(team(CAMERAS), depth=True)
    assert list(own.robots) == list(CAMERAS)
    for robot, (scale, offset, axis) in CAMERAS.items():
        found = {figure.name: figure for figure in own.robots[robot]}
        assert found["range_scale"].value == pytest.approx(scale, abs=0.003)
        assert found["range_offset"].value == pytest.approx(offset, abs=0.006)
        assert found["bearing_lens.cubic"].value == pytest.approx(BENT, abs=0.01)
        assert found["optical_axis"].value == pytest.approx(axis, abs=0.003)
    assert {figure.name for figure in own.strays} == {
        "bias_sigma.bearing", "bias_sigma.range_offset", "bias_sigma.range_scale",
        "common_bias_sigma.range_scale",
    }  # fmt: skip
    assert max(f.value for f in own.strays if f.name.endswith("range_scale")) < 0.003


def test_a_camera_that_was_changed_between_worlds_does_not_widen_what_all_have():
    data = team(CAMERAS | {"r4": CAMERAS["r1"]})
    before = {figure.name: figure.value for figure in own_constants(data, depth=True).strays}
    data[-1] = replace(looking("r4", 2, (1.08, 0.0, 0.0)), name="2 r4")
    after = {figure.name: figure.value for figure in own_constants(data, depth=True).strays}
    assert after["bias_sigma.range_scale"] < 3.0 * before["bias_sigma.range_scale"] + 1e-3


def test_how_far_all_range_scales_stray_together_is_learnt_from_world_to_world():
    read = [
        looking(robot, world, (scale + by, *rest))
        for world, by in ((1, 0.02), (2, -0.02))
        for robot, (scale, *rest) in CAMERAS.items()
    ]
    found = {figure.name: figure.value for figure in own_constants(read, depth=True).strays}
    own = found["bias_sigma.range_scale"]
    together = np.sqrt((2.0 * own**2 + 2.0 * 0.02**2) / 3.0 * 1.5)
    assert found["common_bias_sigma.range_scale"] == pytest.approx(together, rel=0.1)


def test_how_far_markers_differ_comes_out_and_is_none_where_they_are_alike():
    """Six worlds of eight landmarks; the fitted constants absorb a part of the spread."""
    marked = [
        looking(r, world, camera, marker=0.02)
        for world in range(1, 7)
        for r, camera in CAMERAS.items()
    ]
    found = marker_spread(marked, depth=True)
    assert found.name == "common_bias_sigma.marker"
    assert found.value == pytest.approx(0.02, abs=3.0 * found.sigma)
    assert 0.0005 < found.sigma < 0.004
    assert marker_spread(team(CAMERAS), depth=True) is None
    assert marker_spread(marked[:1], depth=True) is None
