from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import WorldStreams
from teamslam.team import core
from teamslam.team.config import MotionModel, MotionNoise, Sensor
from teamslam.team.core import Scan, predicted
from teamslam.team.estimation.models import Increment, increment_of, noise_of, unclaimed
from teamslam.team.estimation.se2 import compose
from tests.scenarios import with_world

SENSOR = Sensor(range_sigma=0.1, bearing_sigma=0.02)
MOTION = MotionModel(forward=MotionNoise(0.03), turn=MotionNoise(0.02), lateral=MotionNoise(0.01))
PLACES = np.array([[5.0, 4.0], [9.0, -3.0], [12.0, 6.0], [2.0, -5.0]])


@dataclass
class Drive:
    motions: list[Increment]
    keyframes: np.ndarray
    ids: np.ndarray
    measurements: np.ndarray

    def judged(self, by="confirmed", outlier_share: float = 0.3, own=None, sensor=SENSOR):
        own = unclaimed(len(self.ids)) if own is None else own
        consensus = core.Consensus(
            noise_of(sensor), sensor.max_range, sensor.field_of_view, outlier_share
        )
        for k, motion in enumerate(self.motions):
            at = self.keyframes == k
            ranges, bearings = self.measurements[at].T
            consensus.add(motion.keyframe(core.Scan(self.ids[at], ranges, bearings, own[at])))
        taken = np.zeros(len(self.ids), dtype=np.bool_)
        taken[np.argsort(self.keyframes, kind="stable")] = getattr(consensus, by)()
        return taken


def drive(seed: int, places: np.ndarray = PLACES) -> Drive:
    rng = np.random.default_rng(seed)
    motions, rows, pose = [], [], np.zeros(3)
    for k in range(10):
        true_step = increment_of(MOTION, 1.0, 1.0, 0.15)
        pose = compose(pose, true_step.mean)
        odometry = (1.0 + 0.03 * rng.normal(), 0.15 + 0.02 * rng.normal())
        motions.append(increment_of(MOTION, 1.0, *odometry))
        for i, place in enumerate(places):
            r, b = predicted(pose, place)
            rows.append((k, i + 1, r + 0.1 * rng.normal(), b + 0.02 * rng.normal()))
    table = np.array(rows)
    return Drive(
        motions, table[:, 0].astype(np.int64), table[:, 1].astype(np.uint32), table[:, 2:].copy()
    )


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000), spoilt=st.sets(st.integers(0, 39), max_size=14))
def test_spoilt_measurements_go_and_the_others_stay(seed, spoilt):
    window = drive(seed)
    rng = np.random.default_rng([seed, 1])
    bad = np.array(sorted(spoilt), dtype=np.int64)
    away = window.measurements[bad] + np.column_stack(
        (rng.choice([-1.0, 1.0], len(bad)) * 2.0, rng.choice([-1.0, 1.0], len(bad)) * 0.7)
    )
    window.measurements[bad] = np.abs(away)
    taken = window.judged()
    assert not taken[bad].any()
    assert np.count_nonzero(~np.delete(taken, bad)) <= 2, "3 sigma in one of 40 is nothing special"


def test_a_lone_measurement_of_another_landmark_is_not_taken_nor_are_two_that_disagree():
    window = drive(1)
    window.ids[3] = 99
    window.ids[[8, 21]] = 77
    taken = window.judged()
    assert not taken[[3, 8, 21]].any()
    assert np.delete(taken, [3, 8, 21]).all()


@pytest.mark.parametrize("points", [False, True])
def test_measurements_are_judged_by_the_covariances_that_they_claim(points):
    window = drive(3)
    few = np.arange(1, 40, 5)
    r, b = window.measurements.T
    r[few] += 1.5  # fifteen sigmas of the sensor
    sigmas = np.tile([0.1, 0.02], (40, 1))
    claims = {"those": sigmas.copy(), "narrow": sigmas}
    claims["those"][few] = [2.0, 0.2]
    taken = {}
    for name, each in claims.items():
        rr, bb = (each**2).T
        if points:
            c, s = np.cos(b), np.sin(b)
            across = bb * r * r
            C = np.column_stack(
                [rr * c * c + across * s * s, (rr - across) * c * s, rr * s * s + across * c * c]
            )
            places = np.column_stack([r * c, r * s])
            own = Scan.points(window.ids.tobytes(), places.tobytes(), C.tobytes()).own
        else:
            parts = window.ids, r, b, np.column_stack([rr, 0 * rr, bb])
            own = Scan.polar(*(part.tobytes() for part in parts)).own
        taken[name] = window.judged(own=own)
    assert taken["those"].all()
    assert not taken["narrow"][few].any()
    assert np.count_nonzero(~np.delete(taken["narrow"], few)) <= 2


def test_a_landmark_under_another_ones_name_is_not_taken():
    window = drive(2)
    window.ids[[4, 12]] = 50  # landmark 1 in the second and in the fourth step
    assert window.judged("agreeing")[[4, 12]].all(), "they agree with each other"
    taken = window.judged()
    assert not taken[[4, 12]].any()
    assert np.delete(taken, [4, 12]).all()


def test_the_order_of_measurements_and_the_names_of_landmarks_do_not_matter():
    window = drive(4)
    window.measurements[[5, 17, 30]] += [1.5, 0.4]
    taken = window.judged()
    order = np.random.default_rng(0).permutation(len(taken))
    names = np.array([0, 40, 7, 9, 3], dtype=np.uint32)
    other = Drive(
        window.motions,
        window.keyframes[order],
        names[window.ids[order]],
        window.measurements[order],
    )
    np.testing.assert_array_equal(other.judged(), taken[order])


@cache
def world_of(name: str, kind: str, outlier_share: float) -> WorldStreams:
    scenario = load(name)
    return streams_of(with_world(scenario, outlier_share=outlier_share, outlier_kind=kind))


def rates(name: str, kind: str, by="confirmed") -> tuple[float, float]:
    """Shares of inliers kept and of outliers accepted, in windows of 12 s."""
    robots = load(name).robots
    kept, passed = [], []
    clean, spoilt = world_of(name, kind, 0.0), world_of(name, kind, 0.3)
    for robot, a, b in zip(robots, clean.streams, spoilt.streams, strict=True):
        seen, before = b.landmark_detections, a.landmark_detections
        bad = (seen.ids != before.ids) | (seen.ranges != before.ranges)
        measurements = np.column_stack((seen.ranges, seen.bearings))
        for first in range(0, 480, 12):
            rows = slice(int(seen.offsets[first]), int(seen.offsets[first + 12]))
            keyframes = np.repeat(np.arange(12), np.diff(seen.offsets[first : first + 13]))
            odometry = zip(
                b.intervals.forward[first : first + 12].tolist(),
                b.intervals.yaw_rate[first : first + 12].tolist(),
                strict=True,
            )
            motions = [increment_of(robot.motion, 1.0, *each) for each in odometry]
            window = Drive(motions, keyframes, seen.ids[rows], measurements[rows])
            taken = window.judged(by, sensor=robot.sensor)
            kept.append(taken[~bad[rows]])
            passed.append(taken[bad[rows]])
    return float(np.concatenate(kept).mean()), float(np.concatenate(passed).mean())


@pytest.mark.parametrize(
    ("name", "kind", "least_kept", "most_passed"),
    [
        ("thesis", "measurement", 0.94, 0.14),
        ("thesis", "identity", 0.94, 0.04),
        ("thesis-b", "measurement", 0.97, 0.02),
        ("thesis-b", "identity", 0.97, 0.02),
    ],
)
def test_of_three_tenths_outliers_few_pass_and_good_measurements_are_kept(
    name, kind, least_kept, most_passed
):
    kept, passed = rates(name, kind)
    assert kept > least_kept
    assert passed < most_passed
    if (name, kind) == ("thesis-b", "measurement"):
        assert rates(name, kind, "agreeing")[1] > 2.0 * passed, "the smoother finds the rest"


@pytest.mark.parametrize("exactly", [False, True])
def test_where_the_smoother_has_no_solution_the_pairs_alone_decide(exactly):
    window = drive(0)
    if exactly:
        pose = np.zeros(3)
        for k, motion in enumerate(window.motions):
            pose = compose(pose, motion.mean)
            for i in np.flatnonzero(window.keyframes == k):
                window.measurements[i] = predicted(pose, PLACES[window.ids[i] - 1])
    sensor = Sensor(range_sigma=1e-160, bearing_sigma=0.01 if exactly else 1e-3)
    agreeing = window.judged("agreeing", sensor=sensor)
    assert agreeing.any()
    np.testing.assert_array_equal(window.judged(sensor=sensor), agreeing)
