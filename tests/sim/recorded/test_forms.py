from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import pytest

from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.publisher.source import Source
from teamslam.sim.recorded.streams import recorded_streams
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.codec import encoded
from tests import build
from tests.sim.datasets.test_folder import read

SECOND = 10**9
THIRD = 1.0 / 3.0
CLAIM = from_floats(np.array([[0.5, 0.1, 0.0], [0.1, THIRD, 0.0], [0.0, 0.0, 0.2]]))
OWN = from_floats(np.array([[0.01, 1e-3, THIRD], [0.02, 0.0, 0.1]]))
TWO = from_ids(np.array([4, 9], dtype=np.uint32))
SEEN = {"ids": TWO, "ranges": from_floats(np.array([2.0, THIRD])),
        "bearings": from_floats(np.array([0.1, -3.0]))}  # fmt: skip
AHEAD = {"ids": TWO, "positions": from_floats(np.array([2.0, THIRD, -1.0, 0.7]))}
UNNAMED = {name: SEEN[name] for name in ("ranges", "bearings")}


def moving(k: int, **fields: Any) -> m.Measurement:
    kind = m.Increment if "increment" in fields else m.Odometry
    return seeing(k, kind, duration_ns=SECOND, **fields)


def seeing(at_s: float, kind: type[m.Measurement], **fields: Any) -> m.Measurement:
    return kind(stamp_ns=round(at_s * SECOND), robot="r1", incarnation=1, number=0, **fields)


def stream(measurements: Sequence[m.Measurement]) -> list[m.Message]:
    begin = build.initial_pose()
    kinds = m.AnyOdometry
    ordered = sorted(measurements, key=lambda each: (each.stamp_ns, isinstance(each, kinds)))
    fields = [{name: getattr(each, name) for name in each.__struct_fields__} for each in ordered]
    return [begin, *(type(each)(**f | {"number": k + 1})
                     for k, (each, f) in enumerate(zip(ordered, fields, strict=True)))]  # fmt: skip


STEP = from_floats(np.array([THIRD, 0.01, -0.02]))
MIXED = stream(
    [
        moving(1, forward=THIRD, yaw_rate=0.1),
        moving(2, increment=STEP, covariance=CLAIM),  # as a driver bridges a gap
        moving(3, increment=STEP),
        moving(4, forward=0.0, yaw_rate=-0.0),
        seeing(0.5, m.Observations, **SEEN),
        seeing(1.5, m.Observations, **SEEN, covariances=OWN),
        seeing(2.0, m.Points, **AHEAD),
        seeing(2.5, m.Points, **AHEAD, covariances=OWN),
        seeing(3.5, m.Points, ids=b"", positions=b""),
    ]
)
HIDDEN = stream(
    [
        moving(1, forward=THIRD, yaw_rate=0.1),
        moving(2, forward=1.0, yaw_rate=0.1),
        seeing(0.5, m.Points, **AHEAD, covariances=OWN),
        seeing(1.0, m.Detections, **UNNAMED),
        seeing(1.5, m.Detections, **UNNAMED, covariances=OWN),
    ]
)


def published(world: WorldStreams) -> list[m.Measurement]:
    (robot,) = world.streams
    return [Source(robot).message(k) for k in range(len(robot))]


@pytest.mark.parametrize("messages", [MIXED, HIDDEN], ids=["named", "hidden"])
def test_a_mixed_stream_comes_out_of_tables_as_it_was(messages, tmp_path):
    labels = from_ids(np.array([7, 2**32 - 1] * 2, dtype=np.uint32))
    stamps = from_stamps(np.array([SECOND, 3 * SECOND // 2]))
    counts = from_ids(np.array([2, 2], dtype=np.uint32))
    told = m.TruthLabels(stamp_ns=0, robot="r1", stamps=stamps, counts=counts, labels=labels)
    world = recorded_streams([*messages, told], "a log")
    assert list(map(encoded, published(world))) == list(map(encoded, messages))
    assert any("each stays in its own form" in note for note in world.streams[0].notes)
    write_folder(world, tmp_path)
    again = read(tmp_path, "r1")
    assert list(map(encoded, published(again))) == list(map(encoded, messages))
    if messages is HIDDEN:
        assert (tmp_path / "r1" / "labels.csv").read_text().split() == [
            "landmark",
            *(["7", "-1"] * 2),
        ]
    else:
        assert "without a covariance, as others have" in "".join(again.streams[0].notes)


def test_later_incarnations_are_left_out_and_counted():
    begin = build.initial_pose(stamp_ns=9 * SECOND, incarnation=2)
    later = [begin, seeing(9.5, m.Points, **AHEAD)]
    later[1] = msgspec.structs.replace(later[1], incarnation=2, number=1)
    world = recorded_streams([*MIXED, *later], "a log")
    assert world.notes == (
        "r1: 2 measurements left out: its stream began anew, and a data set has one stream of each "
        "robot",
    )
