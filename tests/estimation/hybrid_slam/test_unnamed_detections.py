"""Association of a window's detections without identities when it closes."""

import numpy as np

from teamslam.team.config import UNNAMED, AssociationSettings, Sensor
from teamslam.team.estimation.hybrid_slam.keyframes import Keyframe
from teamslam.team.estimation.hybrid_slam.reduction import KeyframeScan
from teamslam.team.estimation.hybrid_slam.unnamed_detections import associate_keyframes
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.scans import unclaimed

SECOND = 10**9
FORWARD = Increment(np.array([1.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-5]))


def keyframe(k: int, ranges: list[float]) -> Keyframe:
    bearings = np.linspace(-1.0, 1.0, len(ranges)) if ranges else np.empty(0)
    ids = (UNNAMED + np.arange(len(ranges))).astype(np.uint32)
    own, still = unclaimed(len(ranges)), Increment.identity()
    at = k * SECOND
    look = KeyframeScan(at, ids, np.array(ranges), bearings, own, at_ns=at, motion=FORWARD)
    looks, rest = ((look,), still) if ranges else ((), None)
    none = np.empty(0)
    return Keyframe(
        at, FORWARD, np.empty(0, np.uint32), none, none, unclaimed(0), looks=looks, rest=rest
    )


def test_a_window_that_confirms_no_detection_has_none() -> None:
    window = [keyframe(0, [3.0]), keyframe(1, []), keyframe(2, [30.0])]
    found = associate_keyframes(window, AssociationSettings(least_seen=2), Sensor(), 100)
    assert [len(each.ids) for each in found.keyframes] == [0, 0, 0]
    assert (found.gated, len(found.became.silent)) == (2, 2)
    assert len(found.unnamed.counts) == 0
    assert found.became is not None
    assert found.became.landmarks.tolist() == [0, 0]
