"""The member: windows that depend on their own measurements alone, and the thesis' running
state.
"""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.scenarios.scenario import load, with_options
from sim.scenarios.source import streams_of
from team import translate
from team.config import FrontEnd, MotionModel, MotionNoise, RobotConfig
from team.estimation.consistency import chi2_interval, nees
from team.estimation.gaussian import LandmarkGaussian
from team.estimation.odometry import OdometryInterval
from team.robot.estimator import InitialPose, estimator_of
from team.robot.hybrid import HybridEstimator
from team.wire import messages as m
from tests.teams import config, published, stream

MEASUREMENTS = published(stream("r1", 12, off_ns=300_000_000))


def fed(member, measurements):
    closed = []
    for measurement in measurements:
        if isinstance(member, HybridEstimator):
            member.consumed(measurement.number)
        if isinstance(measurement, m.Observations):
            member.observe(measurement.stamp_ns, translate.scan_of(measurement))
        if isinstance(measurement, m.Odometry):
            window = member.drive(
                OdometryInterval(
                    measurement.stamp_ns,
                    measurement.duration_ns,
                    measurement.forward,
                    measurement.yaw_rate,
                )
            ).closed
            closed += [] if window is None else [window]
    return closed


def fresh_estimator():
    return HybridEstimator(config(), 1)


def same(a, b):
    return (
        (a.sequence, a.first_measurement, a.last_measurement, a.start_ns, a.end_ns)
        == (b.sequence, b.first_measurement, b.last_measurement, b.start_ns, b.end_ns)
        and a.local.ids.tobytes() == b.local.ids.tobytes()
        and a.local.mean.tobytes() == b.local.mean.tobytes()
        and a.local.covariance.tobytes() == b.local.covariance.tobytes()
    )


def test_windows_are_contiguous_in_measurements_and_time():
    member = fresh_estimator()
    closed = fed(member, MEASUREMENTS)
    ended, uncovered = member.finish()
    assert uncovered == 0
    assert ended.closed is None, "the last window ended with the last odometry"
    assert [w.sequence for w in closed] == [0, 1, 2, 3]
    assert closed[0].first_measurement == 0
    assert closed[-1].last_measurement == len(MEASUREMENTS) - 1
    for before, after in pairwise(closed):
        assert after.first_measurement == before.last_measurement + 1
        assert after.start_ns == before.end_ns


@settings(deadline=None, max_examples=12)
@given(st.integers(0, 3), st.integers(1, 3))
def test_a_member_that_takes_over_earlier_windows_goes_on_byte_for_byte(taken, looks):
    whole = fed(fresh_estimator(), MEASUREMENTS)
    member = fresh_estimator()
    for closed in whole[:taken]:
        member.resume(closed)
    for _ in range(looks):
        member.open_window()
    first = whole[taken - 1].last_measurement + 1 if taken else 0
    again = fed(member, MEASUREMENTS[first:])
    assert len(again) == len(whole) - taken
    assert all(same(a, b) for a, b in zip(again, whole[taken:], strict=True))
    assert member.whole.mean.tobytes() == _whole_of(MEASUREMENTS).mean.tobytes()


def _whole_of(measurements):
    member = fresh_estimator()
    fed(member, measurements)
    return member.whole


def test_a_window_does_not_depend_on_what_was_read_before_it():
    other = [
        m.Odometry(
            stamp_ns=r.stamp_ns,
            robot=r.robot,
            incarnation=r.incarnation,
            number=r.number,
            duration_ns=r.duration_ns,
            forward=2 * r.forward,
            yaw_rate=0.5,
        )
        if isinstance(r, m.Odometry) and r.stamp_ns <= 3_000_000_000
        else r
        for r in MEASUREMENTS
    ]
    one, two = fed(fresh_estimator(), MEASUREMENTS), fed(fresh_estimator(), other)
    assert not same(one[0], two[0])
    assert all(same(a, b) for a, b in zip(one[1:], two[1:], strict=True))


@pytest.mark.parametrize("other", [config(seed=2), config("r2")])
def test_a_window_depends_on_its_seed_and_its_robot(other):
    assert not same(
        fed(HybridEstimator(other, 1), MEASUREMENTS)[0], fed(fresh_estimator(), MEASUREMENTS)[0]
    )


def test_a_window_depends_on_its_incarnation():
    assert not same(
        fed(HybridEstimator(config(), 2), MEASUREMENTS)[0], fed(fresh_estimator(), MEASUREMENTS)[0]
    )


def test_what_no_odometry_covers_is_counted_at_the_end():
    measurements = published(stream("r1", 4, beyond=3))
    member = fresh_estimator()
    closed = fed(member, measurements)
    ended, uncovered = member.finish()
    assert uncovered == 3
    assert ended.closed.last_measurement == measurements[-1].number
    assert ended.closed.first_measurement == closed[-1].last_measurement + 1
    assert ended.closed.end_ns == 4_000_000_000


def test_a_member_without_odometry_has_no_window_and_covers_nothing():
    measurements = published(stream("r1", 4, drives=False))
    member = fresh_estimator()
    assert fed(member, measurements) == []
    ended, uncovered = member.finish()
    assert ended.closed is None
    assert uncovered == sum(isinstance(r, m.Observations) for r in measurements)


def test_the_thesis_member_starts_where_it_is_told_and_replaces_what_it_absorbs():
    robot = config(estimator="hybrid-thesis", fusion="kalman-per-axis")
    member = estimator_of(robot, 1, InitialPose(np.array([1.0, 2.0, 0.5]), None))
    np.testing.assert_array_equal(member.own_pose().mean, [1.0, 2.0, 0.5])
    fed(member, MEASUREMENTS[1:])
    assert member.sequence == sum(isinstance(r, m.Observations) for r in MEASUREMENTS)
    before = member.own_map()
    assert len(before.ids) > 0
    told = LandmarkGaussian(before.ids[:1], np.array([[50.0, 60.0]]), 4.0 * np.eye(2))
    member.absorb(told)
    after = member.own_map()
    np.testing.assert_array_equal(after.means, [[50.0, 60.0], *before.means[1:]])
    np.testing.assert_array_equal(after.covariance[:2, :2], 4.0 * np.eye(2))


def test_over_a_whole_run_the_own_map_is_over_confident_in_some_runs_by_nature():
    """Submaps joined one by one are linearised once: a bad heading stays in the covariance.

    Measured on seeds 1 to 7 of the accurate sensor: NEES/dof 16, 1.6, 1.0, 1.9, 0.9, 1.0 and 1.9;
    joined by least squares the same submaps of a team give about 1.
    """
    ratios = []
    for seed in (1, 2, 3):
        scenario = with_options(load("thesis-b"), seed=seed)
        streams = streams_of(scenario)
        first = streams.streams[0]
        member = HybridEstimator(scenario.robots[0], 1, InitialPose(first.start.pose, None))
        fed(member, published(first))
        own = member.own_map()
        error = (own.means - streams.landmarks[own.ids.astype(int) - 1]).ravel()
        ratios.append(nees(error, own.covariance) / len(error))
    assert np.mean(ratios) > 2.0 > chi2_interval(36, 0.999, len(ratios))[1]
    assert np.median(ratios) < 2.0


def standing(window_m):
    """A member that stands for 45 s, then drives for 15 s, in odometry intervals of a second."""
    front_end = FrontEnd(particles=8, window_s=10.0, window_m=window_m, standing_s=30.0, node_s=5.0)
    member = HybridEstimator(RobotConfig("r1", motion=NOISY, front_end=front_end), 1)
    closed = []
    for second in range(1, 61):
        looks = ("r2",), np.array([2.0]), np.array([0.1])
        if second % 5 == 0:
            assert member.sight(second * 10**9 - 1, second, looks) is None
        driven = member.drive(
            OdometryInterval(second * 10**9, 10**9, 0.1 if second > 45 else 0.0, 0.0)
        )
        closed += [] if driven.closed is None else [driven.closed]
    return closed


NOISY = MotionModel(forward=MotionNoise(per_s=0.01), turn=MotionNoise(per_s=0.01))


def test_the_window_of_a_standing_robot_goes_on_until_it_moves_or_has_lasted_long_enough():
    assert [w.end_ns // 10**9 for w in standing(0.0)] == [10, 20, 30, 40, 50, 60]
    # 30 s is as long as one may stand; then at 46 s it moves, and by 56 s the next ten are over.
    assert [w.end_ns // 10**9 for w in standing(0.05)] == [30, 46, 56]


def test_a_long_window_has_all_its_nodes_and_loses_no_sighting():
    for window_m in (0.0, 0.05):
        closed = standing(window_m)
        nodes = [t // 10**9 for w in closed for t in w.local.node_stamps.tolist()]
        assert nodes == list(range(5, 5 + 5 * len(nodes), 5))
        assert [s.stamp_ns // 10**9 for w in closed for s in w.sightings] == nodes
        assert nodes[-1] >= 55
