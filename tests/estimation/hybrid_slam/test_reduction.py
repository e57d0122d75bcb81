import numpy as np
import pytest

from teamslam.team.config import UNNAMED, AssociationSettings, MotionModel, MotionNoise, Sensor
from teamslam.team.core import Keyframe, Scan, TimedScan
from teamslam.team.estimation.hybrid_slam.unnamed_detections import associate_keyframes, events_of
from teamslam.team.estimation.models import segmenter_of

TICK = 10**8
LANDMARKS = np.array([[3.0, 0.5], [3.0, -1.5], [5.0, 1.0]])
NAMES = np.array([8, 3, 5], np.uint32)
MOTION = MotionModel(forward=MotionNoise(per_m=0.05), turn=MotionNoise(per_rad=0.1))
SENSOR = Sensor(range_sigma=0.02, bearing_sigma=0.01)


def keyframes(keyframe_s: float, *, hidden: bool, tagged: int = 0) -> list[Keyframe]:
    """A second of driving on an arc; each scan sees two of the three, in random order.

    tagged: number of landmarks whose identities are sent in a message of their own.
    """
    rng = np.random.default_rng(0)
    segmenter = segmenter_of(MOTION, SENSOR, keyframe_s)
    segmenter.begin(0)
    pose = np.zeros(3)
    for tick in range(1, 11):
        heading = pose[2] + 0.5 * 0.04
        pose = pose + np.array([0.02 * np.cos(heading), 0.02 * np.sin(heading), 0.04])
        seen = rng.permutation(3)[:2]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        at = (LANDMARKS[seen] - pose[:2]) @ np.array([[c, -s], [s, c]])
        ranges = np.hypot(*at.T) + 0.02 * rng.normal(size=2)
        bearings = np.arctan2(at[:, 1], at[:, 0]) + 0.01 * rng.normal(size=2)
        ids = (UNNAMED + np.arange(2)).astype(np.uint32) if hidden else NAMES[seen]
        named = seen < tagged if hidden else np.ones(2, np.bool_)
        for chosen, called in ((named, NAMES[seen]), (~named, ids)):
            if chosen.any():
                scan = Scan(called[chosen], ranges[chosen], bearings[chosen])
                segmenter.observe(tick * TICK - 1, scan)
        for end in (2 * tick - 1, 2 * tick):  # odometry comes more often than scans
            segmenter.drive(end * TICK // 2, TICK // 2, 0.2, 0.4)
    segmenter.cut(10 * TICK)
    return segmenter.take_keyframes()


@pytest.mark.parametrize("keyframe_s", [0.0, 0.5])
@pytest.mark.parametrize("tagged", [0, 1])
def test_detections_that_are_associated_rightly_give_the_numbers_that_names_give(
    keyframe_s, tagged
):
    named = keyframes(keyframe_s, hidden=False)
    raw = keyframes(keyframe_s, hidden=True, tagged=tagged)
    found = associate_keyframes(raw, AssociationSettings(certain=0.0), SENSOR, 100)
    assert len(found.unnamed.counts) == 3 - tagged
    merged: dict[int, list[Keyframe]] = {}
    for each in found.keyframes:
        merged.setdefault(each.stamp_ns, []).append(each)
    for one in {each.stamp_ns for each in named}:
        told = np.sort(np.concatenate([e.scan.ranges for e in named if e.stamp_ns == one]))
        assert (np.sort(np.concatenate([e.scan.ranges for e in merged[one]])) == told).all()
    motions = [sum(e.motion[0] for e in each) for each in (named, raw)]
    assert np.allclose(*motions)


def test_the_events_of_a_window_are_its_whole_motion_and_every_detection_once():
    raw = keyframes(0.5, hidden=True, tagged=1)
    events = events_of(raw)
    assert [e.at_ns for e in events] == sorted(e.at_ns for e in events)
    turned = sum(event.motion.mean[2] for event in events)
    assert turned == pytest.approx(sum(each.motion[0][2] for each in raw))
    spread = sum(event.motion.covariance[2, 2] for event in events)
    assert spread == pytest.approx(sum(each.motion[1][2, 2] for each in raw))
    assert sum(len(e.scan) for e in events if e.look is not None) == sum(
        len(look.scan) for each in raw for look in each.looks
    )


SECOND = 10**9
FORWARD = np.array([1.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-5])
STILL = np.zeros(3), np.zeros((3, 3))


def keyframe(k: int, ranges: list[float]) -> Keyframe:
    bearings = np.linspace(-1.0, 1.0, len(ranges)) if ranges else np.empty(0)
    ids = (UNNAMED + np.arange(len(ranges))).astype(np.uint32)
    at = k * SECOND
    look = TimedScan(at, Scan(ids, np.array(ranges), bearings), at, FORWARD)
    looks, rest = ([look], STILL) if ranges else ([], None)
    return Keyframe(at, FORWARD, looks=looks, rest=rest)


def test_a_window_that_confirms_no_detection_has_none():
    window = [keyframe(0, [3.0]), keyframe(1, []), keyframe(2, [30.0])]
    found = associate_keyframes(window, AssociationSettings(least_seen=2), Sensor(), 100)
    assert [len(each.scan) for each in found.keyframes] == [0, 0, 0]
    assert (found.gated, len(found.became.silent)) == (2, 2)
    assert len(found.unnamed.counts) == 0
    assert found.became.landmarks.tolist() == [0, 0]
